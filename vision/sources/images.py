"""A folder of images, or one image."""

from __future__ import annotations

import logging
import re
import time
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from vision.sources.capture import Capture, RawFrame
from vision.sources.opencv import quiet_opencv
from vision.sources.source import EndOfStream, SourceError

logger = logging.getLogger(__name__)

IMAGE_SUFFIXES = frozenset(
    (".jpg", ".jpeg", ".png", ".bmp", ".webp", ".tif", ".tiff", ".ppm", ".pgm", ".pnm", ".jp2", ".avif")
)


def is_image(path: Path) -> bool:
    """Whether the file name has an image suffix."""
    return path.suffix.lower() in IMAGE_SUFFIXES


def natural_key(path: Path) -> tuple[tuple[int, int, str], ...]:
    """Sort key of natural order: image2 before image10."""
    parts = re.split(r"(\d+)", path.name.casefold())
    return tuple((0, int(part), part) if part.isdecimal() else (1, 0, part) for part in parts if part)


def images_in(folder: Path) -> list[Path]:
    """The images directly in a folder, in natural order.

    Raises:
        SourceError: there are none.
    """
    paths = sorted((path for path in folder.iterdir() if is_image(path) and path.is_file()), key=natural_key)
    if not paths:
        raise SourceError(
            f"{folder}: no images in this folder; expected names ending in "
            f"{', '.join(sorted(IMAGE_SUFFIXES))}"
        )
    return paths


def decode_image(data: bytes) -> NDArray[np.uint8] | None:
    """(height, width, 3) BGR of an encoded image, rotated by its EXIF orientation; None if unreadable."""
    if not data:
        return None
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    except cv2.error:  # a size beyond OpenCV's limits
        return None
    return None if image is None else np.ascontiguousarray(image, dtype=np.uint8)


class ImagesCapture(Capture):
    """Images in order. An unreadable one is logged, counted and skipped."""

    def __init__(self, paths: list[Path], rate_hz: float) -> None:
        quiet_opencv()
        self._paths = paths
        self.interval_s = 1 / rate_hz
        self._next = 0
        self.total_frames = len(paths)

    def read(self, timeout_s: float) -> RawFrame | None:
        while self._next < len(self._paths):
            index = self._next
            self._next += 1
            path = self._paths[index]
            started_ns = time.monotonic_ns()
            try:
                image = decode_image(path.read_bytes())
                reason = "not an image that OpenCV can read; it may be truncated or damaged"
            except OSError as error:
                image, reason = None, error.strerror or str(error)
            if image is not None:
                decode_ms = (time.monotonic_ns() - started_ns) / 1e6
                return RawFrame(image, media_s=index * self.interval_s, decode_ms=decode_ms)
            self.unreadable += 1
            logger.warning("%s: skipped: %s", path, reason)
        if self.unreadable == len(self._paths):
            raise SourceError(f"{self._paths[0]}: none of the {len(self._paths)} images could be read")
        raise EndOfStream

    def close(self) -> None:
        """Nothing stays open."""
