"""A video file that browsers play: WebM with VP8, by the FFmpeg that OpenCV carries.

H.264 would be smaller, but its encoder is GPL code and not in there. VP8 at FFmpeg's own settings, which
OpenCV does not let one change, costs about 40 ms of one core for a noisy 640x480 frame and less for a quiet
one; VP9 five times that.
"""

from __future__ import annotations

import os
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from vision.sources.opencv import quiet_opencv

_FOURCC = cv2.VideoWriter.fourcc(*"VP80")
_HARMLESS = b"is not supported with codec id"  # said of every WebM, which has no such tags at all
_standard_error_lock = threading.Lock()


class VideoWriterError(Exception):
    """A video that cannot be written. The text is one line that names the file."""


class VideoWriter:
    """Writes frames at a constant rate so that playing time equals real time.

    Each image belongs to the slot of the film nearest to its capture stamp. A slot nobody filled repeats
    the image before it; of two images for one slot the first stays. `close` completes the file; use it as a
    context manager.

    Args:
        path: ends in `.webm`; its folder is made if it is missing, a file already there is replaced.
        width, height: pixels of every image.
        rate_hz: frames a second of the film.

    Attributes:
        frames: in the film so far.
        repeated: of those, the ones that repeat the image before them.
        dropped: images for which there was no slot.

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
        self._image: NDArray[np.uint8] | None = None
        self._closed = False
        if self.path.suffix.lower() != ".webm":
            raise VideoWriterError(f"{self.path}: the name of a video must end in .webm")
        if not (1 <= width <= 16383 and 1 <= height <= 16383):
            raise VideoWriterError(f"{self.path}: VP8 takes 1..16383 pixels a side, got {width}x{height}")
        if not 0.1 <= rate_hz <= 240.0:
            raise VideoWriterError(f"{self.path}: rate_hz must be 0.1..240, got {rate_hz}")
        quiet_opencv()
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self.path.open("wb"):
                pass
        except OSError as error:
            raise VideoWriterError(f"{self.path}: cannot be written: {error.strerror}") from error
        with _without_harmless_lines():
            self._writer = cv2.VideoWriter(str(self.path), cv2.CAP_FFMPEG, _FOURCC, rate_hz, (width, height))
        if not self._writer.isOpened():
            raise VideoWriterError(
                f"{self.path}: OpenCV's FFmpeg could not begin a VP8 video of {width}x{height} "
                f"at {rate_hz:g} Hz"
            )

    def write(self, image: NDArray[np.uint8], captured_ns: int) -> int:
        """Add one image, (height, width, 3) uint8 BGR, captured at `captured_ns` (monotonic nanoseconds).

        Returns how many frames the film grew by: 0 if the image came too soon after the one before (or is
            older),
        more than 1 if it came late and frames were repeated to keep the film in step.
        """
        if self._closed:
            raise ValueError(f"{self.path}: written to after close")
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
        before = self.frames
        while self.frames < slot and self._image is not None:
            self._writer.write(self._image)
            self.frames += 1
            self.repeated += 1
        self._image = np.array(image, order="C")  # the caller may draw on his own again
        self._writer.write(self._image)
        self.frames += 1
        return self.frames - before

    @property
    def duration_s(self) -> float:
        """Playing time so far, seconds."""
        return self.frames / self.rate_hz

    def close(self) -> None:
        """Complete the file and look whether it holds what was written. A second call does nothing.

        Raises:
            VideoWriterError: it does not: most likely the disk is full.
        """
        if self._closed:
            return
        self._closed = True
        self._writer.release()
        if self.frames == 0:
            return
        # OpenCV's write reports no failure, so the file itself has to be asked.
        capture = cv2.VideoCapture(str(self.path), cv2.CAP_FFMPEG)
        readable = capture.isOpened() and capture.grab()
        held = round(capture.get(cv2.CAP_PROP_FRAME_COUNT)) if readable else 0
        capture.release()
        if held < self.frames - 2:
            raise VideoWriterError(
                f"{self.path}: the file holds {max(held, 0)} of {self.frames} frames; is the disk full?"
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()


@contextmanager
def _without_harmless_lines() -> Iterator[None]:
    """Keep one harmless line of OpenCV's C code off standard error; pass on whatever else is said."""
    with _standard_error_lock, tempfile.TemporaryFile() as said:
        sys.stderr.flush()
        kept = os.dup(2)
        os.dup2(said.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            said.seek(0)
            for line in said.read().splitlines(keepends=True):
                if _HARMLESS not in line:
                    os.write(2, line)
