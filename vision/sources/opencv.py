"""OpenCV and FFmpeg as used by sources: without their log output, and with FFmpeg options per capture.

Both print to standard error what this package logs in one line. `OPENCV_LOG_LEVEL=INFO` and
`OPENCV_FFMPEG_LOGLEVEL=32` enable their output.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import cv2
import numpy as np
from numpy.typing import NDArray

from vision.image_file import frame_pixels

_AV_LOG_QUIET = "-8"  # libavutil/log.h
_environment_lock = threading.Lock()


def quiet_opencv() -> None:
    """Silence the messages of OpenCV and FFmpeg, unless the environment enables them."""
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", _AV_LOG_QUIET)
    if "OPENCV_LOG_LEVEL" not in os.environ:
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)


quiet_opencv()  # on import too: FFmpeg's level is read once, at its first use through OpenCV


@contextmanager
def environment(name: str, value: str) -> Iterator[None]:
    """Set one environment variable temporarily, one thread at a time."""
    with _environment_lock:
        before = os.environ.get(name)
        os.environ[name] = value
        try:
            yield
        finally:
            if before is None:
                del os.environ[name]
            else:
                os.environ[name] = before


def read_capture(capture: cv2.VideoCapture, name: str) -> tuple[NDArray[np.uint8] | None, int, float]:
    """Read the next image of a capture, with its arrival time and decoding time.

    OpenCV waits and decodes in two calls; FFmpeg's decoders already work in the first.

    Args:
        name: of the capture, for a line about its pixels.

    Returns:
        (height, width, 3) uint8 BGR or None; CLOCK_MONOTONIC nanoseconds of the first call's end;
        milliseconds of the second.
    """
    if not capture.grab():
        return None, time.monotonic_ns(), 0.0
    arrived_ns = time.monotonic_ns()
    ok, image = capture.retrieve()
    decode_ms = (time.monotonic_ns() - arrived_ns) / 1e6
    if not ok or image is None:
        return None, arrived_ns, decode_ms
    return frame_pixels(image, name), arrived_ns, decode_ms


def interval_of(capture: cv2.VideoCapture) -> float:
    """Frame interval of an open capture, seconds; 1/25 if it states none that is plausible."""
    rate_hz = capture.get(cv2.CAP_PROP_FPS)
    return 1.0 / rate_hz if 0.1 < rate_hz < 1000.0 else 1.0 / 25.0


def open_ffmpeg(
    location: str,
    *,
    open_timeout_s: float | None = None,
    read_timeout_s: float | None = None,
    options: Mapping[str, str] | None = None,
) -> cv2.VideoCapture:
    """Open a capture by FFmpeg; check `isOpened`.

    Args:
        location: a file name or an address, as FFmpeg accepts it.
        open_timeout_s, read_timeout_s: FFmpeg's timeouts; None: its default (30 s).
        options: FFmpeg's format and codec options; OPENCV_FFMPEG_CAPTURE_OPTIONS overrides them.
    """
    quiet_opencv()
    parameters: list[int] = []
    if open_timeout_s is not None:
        parameters += [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, max(1, round(open_timeout_s * 1000))]
    if read_timeout_s is not None:
        parameters += [cv2.CAP_PROP_READ_TIMEOUT_MSEC, max(1, round(read_timeout_s * 1000))]
    if not options:
        return cv2.VideoCapture(location, cv2.CAP_FFMPEG, parameters)
    merged = dict(options)
    for pair in filter(None, os.environ.get("OPENCV_FFMPEG_CAPTURE_OPTIONS", "").split("|")):
        key, _, value = pair.partition(";")
        merged[key] = value
    text = "|".join(f"{key};{value}" for key, value in merged.items())
    with environment("OPENCV_FFMPEG_CAPTURE_OPTIONS", text):
        return cv2.VideoCapture(location, cv2.CAP_FFMPEG, parameters)
