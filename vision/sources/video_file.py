"""A video file, read by OpenCV's FFmpeg."""

from __future__ import annotations

import time
from pathlib import Path

import cv2
import numpy as np

from vision.sources.capture import Capture, RawFrame
from vision.sources.opencv import open_ffmpeg
from vision.sources.source import EndOfStream, SourceError


class VideoFileCapture(Capture):
    """Every frame of a video file in order, with its media time.

    Raises:
        SourceError: no video that FFmpeg can read.
    """

    def __init__(self, path: Path) -> None:
        if path.stat().st_size == 0:
            raise SourceError(f"{path}: the file is empty")
        self._path = path
        self._capture = open_ffmpeg(str(path))
        if not self._capture.isOpened():
            raise SourceError(
                f"{path}: no video that FFmpeg can read ({path.stat().st_size} bytes); it may be damaged or "
                f"another kind of file"
            )
        claimed = self._capture.get(cv2.CAP_PROP_FRAME_COUNT)
        self.total_frames = int(claimed) if 0 < claimed < 1e9 else None
        rate_hz = self._capture.get(cv2.CAP_PROP_FPS)
        self.interval_s = 1.0 / rate_hz if 0.1 < rate_hz < 1000.0 else 1.0 / 25.0
        self._delivered = 0
        self._last_s = -self.interval_s

    def read(self, timeout_s: float) -> RawFrame | None:
        started_ns = time.monotonic_ns()
        ok, image = self._capture.read()
        decode_ms = (time.monotonic_ns() - started_ns) / 1e6  # a file read does not wait
        if not ok:
            # OpenCV does not distinguish an end from damage; the frame count in the file does.
            missing = (self.total_frames or 0) - self._delivered
            if missing > max(2, 0.02 * (self.total_frames or 0)):
                raise EndOfStream(f"the file should have {self.total_frames}; it is truncated or damaged")
            raise EndOfStream
        self._delivered += 1
        stamp_s = self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1000.0
        if not stamp_s > self._last_s:  # some containers carry no stamps, or repeat them
            stamp_s = self._last_s + self.interval_s
        self._last_s = stamp_s
        return RawFrame(np.ascontiguousarray(image, dtype=np.uint8), media_s=stamp_s, decode_ms=decode_ms)

    def close(self) -> None:
        self._capture.release()
