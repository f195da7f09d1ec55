"""Video files that browsers play: WebM with VP8. H.264 would be smaller; its free encoder is GPL code.

PyAV encodes where it is installed, else the FFmpeg of OpenCV. PyAV can set a realtime deadline, and leaves
empty slots empty. OpenCV passes no options to an encoder (its issue 24570): it takes five times as long per
image and twice the bytes, and each empty slot has to be encoded as a repeat of the previous image.
"""

from __future__ import annotations

import logging
import os
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from vision.sources.opencv import quiet_opencv

logger = logging.getLogger(__name__)

_FOURCC = cv2.VideoWriter.fourcc(*"VP80")
_HARMLESS = b"is not supported with codec id"  # logged for every WebM, which has no such tags
_standard_error_lock = threading.Lock()

# WebM counts milliseconds.
_CLOCK_HZ = 1000
_KEY_FRAME_S = 5.0
# Constant quality (0..63, less is better), and no frame is dropped.
_OPTIONS = {"deadline": "realtime", "cpu-used": "8", "crf": "20", "drop-threshold": "0"}
# Upper bound: 4 Mbit/s at 640x480 and 10 Hz. Below the minimum libvpx rounds the rate to 0.
_MOST_BITS_PER_PIXEL = 1.3
_LEAST_BITS_PER_S = 200_000


class Encoder(Protocol):
    """Encodes the images of a video, (height, width, 3) uint8 BGR, in ascending slots."""

    def put(self, image: NDArray[np.uint8], slot: int) -> None:
        """Add an image, which may be modified afterwards. Raises OSError."""

    def close(self) -> int:
        """Complete the file; returns the slots up to its last image. Raises OSError."""


def has_pyav() -> bool:
    """Whether videos are encoded by PyAV, which is several times faster."""
    return _pyav() is not None


def open_encoder(path: Path, width: int, height: int, rate_hz: float) -> Encoder:
    """Open the best available encoder. Raises OSError if it cannot start."""
    av = _pyav()
    if av is None:
        return OpenCvEncoder(path, width, height, rate_hz)
    return AvEncoder(av, path, width, height, rate_hz)


def _url(path: Path) -> str:
    """A `file:` URL: otherwise FFmpeg takes a prefix before a colon for a protocol."""
    return f"file:{path}"


@cache
def _pyav() -> Any:
    if find_spec("av") is None:
        return None
    try:
        import av
    except ImportError as error:
        problem = str(error)
    else:
        if "libvpx" in av.codecs_available:
            return av
        problem = "it was built without libvpx"
    logger.warning("PyAV is installed but unusable (%s): videos are encoded by OpenCV, slowly", problem)
    return None


class AvEncoder:
    """libvpx with a realtime deadline, by PyAV, on one thread."""

    def __init__(self, av: Any, path: Path, width: int, height: int, rate_hz: float) -> None:
        self._av = av
        self._url = _url(path)
        self._rate_hz = rate_hz
        self._empty = True
        with self._plain_errors():
            self._container = av.open(self._url, "w", format="webm")
            try:
                self._stream = self._container.add_stream(
                    "libvpx", rate=Fraction(rate_hz).limit_denominator(1001)
                )
                self._stream.width, self._stream.height, self._stream.pix_fmt = width, height, "yuv420p"
                bits_per_s = round(_MOST_BITS_PER_PIXEL * width * height * rate_hz)
                self._stream.bit_rate = max(_LEAST_BITS_PER_S, bits_per_s)
                self._stream.options = _OPTIONS
                codec = self._stream.codec_context
                codec.time_base = Fraction(1, _CLOCK_HZ)
                codec.gop_size = max(1, round(rate_hz * _KEY_FRAME_S))
                codec.thread_count = 1
                self._container.start_encoding()  # what cannot be written or encoded fails here
            except BaseException:
                self._container.close()
                raise

    def put(self, image: NDArray[np.uint8], slot: int) -> None:
        with self._plain_errors():
            frame = self._av.VideoFrame.from_ndarray(image, format="bgr24").reformat(format="yuv420p")
            frame.pts, frame.time_base = round(slot * _CLOCK_HZ / self._rate_hz), Fraction(1, _CLOCK_HZ)
            self._empty = False
            self._container.mux(self._stream.encode(frame))

    def close(self) -> int:
        with self._plain_errors():
            try:
                if not self._empty:
                    self._container.mux(self._stream.encode(None))
            finally:
                self._container.close()
            return 0 if self._empty else self._slots_in_file()

    def _slots_in_file(self) -> int:
        with self._av.open(self._url) as video:
            if video.duration:
                video.seek(video.duration)  # the last packets are enough: an hour of video is not read again
            stamps = [packet.pts * packet.time_base for packet in video.demux() if packet.pts is not None]
        return round(float(max(stamps)) * self._rate_hz) + 1 if stamps else 0

    @contextmanager
    def _plain_errors(self) -> Iterator[None]:
        try:
            yield
        except self._av.FFmpegError as error:  # not all of them are OSErrors
            raise OSError(error.errno, error.strerror) from error


class OpenCvEncoder:
    """VP8 with FFmpeg's default settings."""

    def __init__(self, path: Path, width: int, height: int, rate_hz: float) -> None:
        self._url = _url(path)
        self._slots = 0
        self._image: NDArray[np.uint8] | None = None
        quiet_opencv()
        with _without_harmless_lines():
            self._writer = cv2.VideoWriter(self._url, cv2.CAP_FFMPEG, _FOURCC, rate_hz, (width, height))
        if not self._writer.isOpened():
            raise OSError(
                0, f"OpenCV's FFmpeg does not begin a VP8 video of {width}x{height} at {rate_hz:g} Hz"
            )

    def put(self, image: NDArray[np.uint8], slot: int) -> None:
        while self._slots < slot and self._image is not None:
            self._writer.write(self._image)
            self._slots += 1
        self._image = np.array(image, order="C")
        self._writer.write(self._image)
        self._slots += 1

    def close(self) -> int:
        self._writer.release()
        # OpenCV's write reports no failure, so the file itself is checked.
        capture = cv2.VideoCapture(self._url, cv2.CAP_FFMPEG)
        readable = capture.isOpened() and capture.grab()
        held = round(capture.get(cv2.CAP_PROP_FRAME_COUNT)) if readable else 0
        capture.release()
        return max(held, 0)


@contextmanager
def _without_harmless_lines() -> Iterator[None]:
    """Keep one harmless line of OpenCV's C code off standard error; pass on everything else."""
    with _standard_error_lock, tempfile.TemporaryFile() as captured:
        sys.stderr.flush()
        kept = os.dup(2)
        os.dup2(captured.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            captured.seek(0)
            for line in captured.read().splitlines(keepends=True):
                if _HARMLESS not in line:
                    os.write(2, line)


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
            # Readable by its owner alone; the encoder opens it again. An older file keeps its mode.
            os.close(os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o600))
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

    def __exit__(self, *exception: object) -> None:
        self.close()
