"""A folder of images, one image, or a video file."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
from numpy.typing import NDArray

from vision.file_kinds import explained, is_hidden, why_no_frames
from vision.image_file import (
    IMAGE_SUFFIXES,
    UNREADABLE_SUFFIXES,
    ImageError,
    frame_pixels,
    natural_key,
    read_image,
)
from vision.sources.capture import LONGEST_STEP_S, Capture, RawFrame
from vision.sources.opencv import interval_of, open_ffmpeg, quiet_opencv
from vision.sources.source import EndOfStream, SourceError

logger = logging.getLogger(__name__)

# FFmpeg's gray16le, of which OpenCV would deliver the upper byte.
_GREY_16, _GREY_16_BIG_ENDIAN = (int.from_bytes(b"Y1\0\x10", order) for order in ("little", "big"))
_CAP_PROP_PTS = 71  # stamp in frame intervals; its name is missing before OpenCV 4.11, where it is 0


def images_in(folder: Path, suffixes: frozenset[str] = IMAGE_SUFFIXES) -> list[Path]:
    """The images directly in a folder, in natural order, without hidden ones.

    Raises:
        SourceError: there are none.
    """
    paths = sorted(
        (
            path
            for path in folder.iterdir()
            if path.suffix.lower() in suffixes and not is_hidden(path) and path.is_file()
        ),
        key=natural_key,
    )
    if not paths:
        known = ", ".join(sorted(suffixes - UNREADABLE_SUFFIXES))
        raise SourceError(f"{folder}: no images in this folder; expected names ending in {known}")
    return paths


def partners(images: list[Path], depths: list[Path]) -> list[Path | None]:
    """The depth image of each image: of the same name without suffix, or of the same position.

    Images without a partner have None. The position decides if no names agree and the numbers are the same.

    Raises:
        SourceError: neither names nor numbers agree, or two depth images have one name.
    """
    by_stem = {path.stem: path for path in depths}
    if len(by_stem) < len(depths):
        raise SourceError(
            f"{depths[0].parent}: two depth images have the same name without suffix; keep one of each"
        )
    paired = [by_stem.get(path.stem) for path in images]
    count = sum(path is not None for path in paired)
    if count * 2 >= min(len(images), len(depths)):
        return paired
    if not count and len(images) == len(depths):
        return list(depths)
    alone = next(path for path, partner in zip(images, paired, strict=True) if partner is None)
    raise SourceError(
        f"{len(images)} images in {images[0].parent} and {len(depths)} depth images in {depths[0].parent} "
        f"cannot be paired: {count} names without suffix agree, {alone.stem} is the first without a partner; "
        f"give each depth image the name of its image"
    )


class ImagesCapture(Capture):
    """Images in order. An unreadable one is logged, counted and skipped.

    Args:
        paths: the images; None: no image for this interval.
        read: returns the image of a file; raises ImageError.
    """

    def __init__(
        self,
        paths: Sequence[Path | None],
        rate_hz: float,
        read: Callable[[Path], NDArray[Any]] = read_image,
    ) -> None:
        quiet_opencv()
        self._read_image = read
        self._paths = [(index, path) for index, path in enumerate(paths) if path is not None]
        self.interval_s = 1 / rate_hz
        self._next = 0
        self.total_frames = len(self._paths)

    def read(self, timeout_s: float) -> RawFrame | None:
        while self._next < len(self._paths):
            index, path = self._paths[self._next]
            self._next += 1
            started_ns = time.monotonic_ns()
            try:
                image = self._read_image(path)
            except ImageError as error:
                self.unreadable += 1
                if self.total_frames == 1:
                    raise SourceError(f"{path}: {error}") from None
                logger.warning("%s: skipped: %s", path, error)
                continue
            decode_ms = (time.monotonic_ns() - started_ns) / 1e6
            media_s = index * self.interval_s
            return RawFrame(image, media_s=media_s, decode_ms=decode_ms, file_name=path.name)
        if self.unreadable == len(self._paths):
            raise SourceError(f"{self._paths[0][1]}: none of the {len(self._paths)} images could be read")
        raise EndOfStream

    def close(self) -> None:
        """Nothing stays open."""


class VideoFileCapture(Capture):
    """Every frame of a video file in order, with its media time.

    Raises:
        SourceError: no video that FFmpeg can read.
    """

    def __init__(self, path: Path) -> None:
        if path.stat().st_size == 0:
            raise SourceError(f"{path}: the file is empty")
        try:
            str(path).encode()
        except UnicodeEncodeError:  # OpenCV would crash
            raise SourceError(f"{path}: the name is not UTF-8; rename the file") from None
        self._path = path
        self._capture = open_ffmpeg(str(path))
        if not self._capture.isOpened():
            if reason := why_no_frames(path):
                raise SourceError(f"{path}: {reason}")
            problem = (
                f"{path}: no video that FFmpeg can read ({path.stat().st_size} bytes); it may be damaged or "
                f"another kind of file"
            )
            raise SourceError(explained(path, problem, "is a video"))
        pixel_format = self._capture.get(cv2.CAP_PROP_CODEC_PIXEL_FORMAT)
        if pixel_format == _GREY_16:
            self._capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)
        elif pixel_format == _GREY_16_BIG_ENDIAN:
            logger.warning(
                "%s: 16-bit grey, big-endian, is shown by its upper byte and may be dark; convert it: "
                "ffmpeg -i %s -c:v ffv1 -pix_fmt gray16le converted.mkv",
                path,
                path.name,
            )
        self.interval_s = interval_of(self._capture)
        self._grabbed = self._capture.grab()
        self._claimed = self._capture.get(cv2.CAP_PROP_FRAME_COUNT)
        # By the rate that OpenCV made the number with, however implausible.
        rate_hz = self._capture.get(cv2.CAP_PROP_FPS)
        self._claimed_s = self._claimed / rate_hz if rate_hz > 0 else self._claimed * self.interval_s
        # Stamps count from the first frame, but the claimed number of a file may count from 0.
        start_s = self._capture.get(_CAP_PROP_PTS) * self.interval_s
        self._latest_s = self._start_s = max(start_s - self._stamp_s(), 0.0)
        if 0 < self._claimed < 1e9 and self._start_s <= LONGEST_STEP_S:
            self.total_frames = int(self._claimed)
        self._delivered = 0

    def read(self, timeout_s: float) -> RawFrame | None:
        started_ns = time.monotonic_ns()
        ok, image = self._capture.retrieve() if self._grabbed or self._capture.grab() else (False, None)
        self._grabbed = False
        decode_ms = (time.monotonic_ns() - started_ns) / 1e6  # a file read does not wait
        if not ok or image is None:
            missing = self._missing()
            if missing > max(2, 0.02 * (self._delivered + missing)):
                expected = self._delivered + missing
                raise EndOfStream(f"the file should have {expected}; it is truncated or damaged")
            raise EndOfStream
        self._delivered += 1
        stamp_s = self._stamp_s()
        self._latest_s = max(self._latest_s, self._start_s + stamp_s)
        pixels = frame_pixels(image, str(self._path))
        return RawFrame(pixels, media_s=stamp_s, decode_ms=decode_ms, file_name=self._path.name)

    def _stamp_s(self) -> float:
        return self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1000.0

    def _missing(self) -> int:
        """Frames that did not come: OpenCV does not distinguish an end from damage.

        Of many containers its count is duration times rate, and the duration lasts until the latest stamp,
        which may be late or wrong: frames are missing only if time is missing too.
        """
        if not 0 < self._claimed < 1e9:
            return 0
        missing_s = self._claimed_s - self._latest_s - self.interval_s
        return int(min(self._claimed - self._delivered, round(missing_s / self.interval_s)))

    def close(self) -> None:
        self._capture.release()
