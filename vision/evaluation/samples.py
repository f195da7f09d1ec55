"""Data types of labelled data sets: images and their ground truth."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".webp", ".tif", ".tiff")


class DatasetError(ValueError):
    """A data set that cannot be used; the message names the file, the line or entry, and the problem."""


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """One image and its ground truth.

    Attributes:
        image: the file.
        boxes: (N, 4) float32 xyxy: pixels, or fractions of the image if `in_fractions`.
        class_ids: (N,) int64.
        in_fractions: as in YOLO labels.
        ignored: (N,) bool: regions that need not be detected (COCO's `iscrowd`).
    """

    image: Path
    boxes: NDArray[np.float32]
    class_ids: NDArray[np.int64]
    in_fractions: bool = False
    ignored: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, np.bool_))

    def __post_init__(self) -> None:
        if self.ignored.shape != self.class_ids.shape:
            object.__setattr__(self, "ignored", np.zeros(len(self.class_ids), np.bool_))

    def boxes_in(self, width: int, height: int) -> NDArray[np.float32]:
        """(N, 4) float32 xyxy in the pixels of an image of this size."""
        if not self.in_fractions:
            return self.boxes
        return self.boxes * np.array([width, height, width, height], np.float32)


@dataclass(frozen=True, slots=True)
class Dataset:
    """Samples in the order of their files.

    Attributes:
        root: path that was opened.
        kind: "YOLO" or "COCO".
        class_names: id → name; None if the data set has no names.
        samples: one per image; one without labels is a negative.
    """

    root: Path
    kind: str
    class_names: tuple[str, ...] | None
    samples: tuple[Sample, ...]


def image_files(folder: Path) -> list[Path]:
    """Every image below `folder`, by name."""
    return sorted(_images_below(folder))


def _images_below(folder: Path) -> Iterator[Path]:
    for where, folders, names in os.walk(folder):
        folders.sort()
        yield from (Path(where, name) for name in names if Path(name).suffix.lower() in IMAGE_SUFFIXES)


def read_image(path: Path) -> NDArray[np.uint8]:
    """(height, width, 3) uint8 BGR, rotated by its EXIF orientation; raises `DatasetError`."""
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise DatasetError(f"{path}: cannot be read as an image; it may be truncated")
    return image.astype(np.uint8, copy=False)
