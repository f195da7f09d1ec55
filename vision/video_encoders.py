"""What encodes a film, VP8 in WebM: PyAV where it is installed, else the FFmpeg that OpenCV carries.

PyAV can tell the encoder to be done in time, and leaves the slots of a film that nobody filled empty. OpenCV
hands an encoder no options (its issue 24570): it takes five times as long for a picture and twice the bytes,
and each empty slot has to be encoded as a repeat of the picture before it.
"""

from __future__ import annotations

import os
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from vision.sources.opencv import quiet_opencv

_FOURCC = cv2.VideoWriter.fourcc(*"VP80")
_HARMLESS = b"is not supported with codec id"  # said of every WebM, which has no such tags at all
_standard_error_lock = threading.Lock()

# WebM counts milliseconds.
_CLOCK_HZ = 1000
_KEY_FRAME_S = 5.0
# Constant quality (0..63, less is better), and the most that it may cost: 4 Mbit/s at 640x480 and 10 Hz.
_QUALITY = 20
_MOST_BITS_PER_PIXEL = 1.3
_LEAST_BIT_RATE = 200_000
_OPTIONS = {"deadline": "realtime", "cpu-used": "8", "crf": str(_QUALITY), "drop-threshold": "0"}


class Encoder(Protocol):
    """Takes the pictures of a film, (height, width, 3) uint8 BGR, each for a slot after the one before."""

    def put(self, image: NDArray[np.uint8], slot: int) -> None:
        """Add a picture, which may be drawn on again afterwards. Raises OSError."""

    def close(self) -> int:
        """Complete the file; how many slots it holds. Raises OSError."""


def keeps_up() -> bool:
    """Whether films are encoded at the pace of a camera here: with PyAV."""
    return _pyav() is not None


def open_encoder(path: Path, width: int, height: int, rate_hz: float) -> Encoder:
    """The best that there is. Raises OSError if it cannot begin."""
    av = _pyav()
    if av is None:
        return OpenCvEncoder(path, width, height, rate_hz)
    return AvEncoder(av, path, width, height, rate_hz)


def _pyav() -> Any:
    try:
        import av
    except ModuleNotFoundError:
        return None
    return av if "libvpx" in av.codecs_available else None


class AvEncoder:
    """libvpx at its pace for live pictures, by PyAV, on one thread."""

    def __init__(self, av: Any, path: Path, width: int, height: int, rate_hz: float) -> None:
        self._av = av
        self._path = path
        self._rate_hz = rate_hz
        self._begun = False
        with self._plain_errors():
            self._container = av.open(str(path), "w", format="webm")
            stream = self._container.add_stream("libvpx", rate=Fraction(rate_hz).limit_denominator(1001))
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.bit_rate = max(_LEAST_BIT_RATE, round(_MOST_BITS_PER_PIXEL * width * height * rate_hz))
        stream.options = {
            "deadline": "realtime",
            "cpu-used": "8",
            "crf": str(_QUALITY),
            "drop-threshold": "0",
        }
        stream.codec_context.time_base = Fraction(1, _CLOCK_HZ)
        stream.codec_context.gop_size = max(1, round(rate_hz * _KEY_FRAME_S))
        stream.codec_context.thread_count = 1
        self._stream = stream

    def put(self, image: NDArray[np.uint8], slot: int) -> None:
        picture = self._av.VideoFrame.from_ndarray(image, format="bgr24").reformat(format="yuv420p")
        picture.pts, picture.time_base = round(slot * _CLOCK_HZ / self._rate_hz), Fraction(1, _CLOCK_HZ)
        self._begun = True
        with self._plain_errors():
            self._container.mux(self._stream.encode(picture))

    def close(self) -> int:
        with self._plain_errors():
            try:
                if self._begun:
                    self._container.mux(self._stream.encode(None))
            finally:
                self._container.close()
            if not self._begun:
                return 0
            with self._av.open(str(self._path)) as film:
                stamps = [packet.pts * packet.time_base for packet in film.demux() if packet.pts is not None]
        return round(float(max(stamps)) * self._rate_hz) + 1 if stamps else 0

    @contextmanager
    def _plain_errors(self) -> Iterator[None]:
        try:
            yield
        except self._av.FFmpegError as error:  # of which not all are OSErrors
            raise OSError(error.errno, error.strerror) from error


class OpenCvEncoder:
    """VP8 at FFmpeg's own settings."""

    def __init__(self, path: Path, width: int, height: int, rate_hz: float) -> None:
        self._path = path
        self._slots = 0
        self._image: NDArray[np.uint8] | None = None
        quiet_opencv()
        with _without_harmless_lines():
            self._writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, _FOURCC, rate_hz, (width, height))
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
        # OpenCV's write reports no failure, so the file itself has to be asked.
        capture = cv2.VideoCapture(str(self._path), cv2.CAP_FFMPEG)
        readable = capture.isOpened() and capture.grab()
        held = round(capture.get(cv2.CAP_PROP_FRAME_COUNT)) if readable else 0
        capture.release()
        return max(held, 0)


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
