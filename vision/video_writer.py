"""Video files that browsers play: WebM with VP8. H.264 would be smaller; its free encoder is GPL code."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from vision.video_encoders import open_encoder


class VideoWriterError(Exception):
    """A video that cannot be written. The text is one line that names the file."""


class VideoWriter:
    """Writes frames at a constant rate so that playing time equals real time.

    Each image goes to the slot of the video nearest to its capture stamp. An empty slot repeats the previous
    image; of two images for one slot the first is kept. `close` completes the file; use it as a context
    manager.

    Args:
        path: ends in `.webm`; its folder is created if missing, an existing file is replaced.
        width, height: pixels of every image.
        rate_hz: frames per second of the video.

    Attributes:
        frames: slots of the video so far.
        repeated: slots that repeat the previous image.
        dropped: images without a free slot.

    Raises:
        VideoWriterError: the file cannot be written.
    """

    def __init__(self, path: Path | str, width: int, height: int, rate_hz: float) -> None:
        self.path = Path(path)
        self.width = width
        self.height = height
        self.rate_hz = rate_hz
        self.frames = 0
        self.repeated = 0
        self.dropped = 0
        self._start_ns: int | None = None
        self._closed = False
        if self.path.suffix.lower() != ".webm":
            raise VideoWriterError(f"{self.path}: the name of a video must end in .webm")
        if not (1 <= width <= 16383 and 1 <= height <= 16383):
            raise VideoWriterError(f"{self.path}: VP8 needs 1..16383 pixels per side, got {width}x{height}")
        if not 0.1 <= rate_hz <= 240.0:
            raise VideoWriterError(f"{self.path}: rate_hz must be 0.1..240, got {rate_hz}")
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self.path.open("wb"):
                pass
            self._encoder = open_encoder(self.path, width, height, rate_hz)
        except OSError as error:
            raise self._write_error(error) from error

    def write(self, image: NDArray[np.uint8], captured_ns: int) -> int:
        """Add one image, (height, width, 3) uint8 BGR, captured at `captured_ns` (monotonic nanoseconds).

        Returns the number of slots added: 0 if the image is too early or out of order, more than 1 if it is
        late.

        Raises:
            VideoWriterError: the file can no longer be written.
        """
        if self._closed:
            raise ValueError(f"{self.path}: write after close")
        if image.shape != (self.height, self.width, 3) or image.dtype != np.uint8:
            raise ValueError(
                f"{self.path}: images must be ({self.height}, {self.width}, 3) uint8, "
                f"got {image.shape} {image.dtype}"
            )
        if self._start_ns is None:
            self._start_ns = captured_ns
        slot = round((captured_ns - self._start_ns) * 1e-9 * self.rate_hz)
        if slot < self.frames:
            self.dropped += 1
            return 0
        try:
            self._encoder.put(image, slot)
        except OSError as error:
            raise self._write_error(error) from error
        added = slot + 1 - self.frames
        self.repeated += added - 1
        self.frames += added
        return added

    @property
    def duration_s(self) -> float:
        """Playing time so far, seconds."""
        return self.frames / self.rate_hz

    def close(self) -> None:
        """Complete the file and check that it holds all frames. A second call does nothing.

        Raises:
            VideoWriterError: frames are missing; most likely the disk is full.
        """
        if self._closed:
            return
        self._closed = True
        try:
            held = self._encoder.close()
        except OSError as error:
            raise self._write_error(error) from error
        if held < self.frames - 2:
            raise VideoWriterError(
                f"{self.path}: the file holds {held} of {self.frames} frames; is the disk full?"
            )

    def _write_error(self, error: OSError) -> VideoWriterError:
        return VideoWriterError(f"{self.path}: cannot be written: {error.strerror}")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()
