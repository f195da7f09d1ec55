"""YOLO-format data sets: images, with label files of `class cx cy w h` lines beside them or under `labels/`.

Coordinates are fractions of the image. A line with more numbers is a polygon (segmentation label); its
bounding box is used. An image without a label file, or with an empty one, is a negative.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vision.evaluation.samples import Dataset, DatasetError, Sample, image_files
from vision.plain_yaml import PlainYamlError, load_plain_yaml

_TABLE_NAMES = ("data.yaml", "data.yml", "dataset.yaml")
_SPLITS = ("val", "test", "train")
# Labels are written with six digits, so a box at the edge may exceed it by this much.
_ROUNDING = 1e-4
_LARGEST_LABELS_BYTES = 16 << 20


def read_yolo(path: Path, split: str | None = None) -> Dataset:
    """Read the data set at `path`: a `data.yaml`, a folder with one, or a folder of images. Raises
    `DatasetError`.
    """
    table_path = (
        path if path.is_file() else next((path / n for n in _TABLE_NAMES if (path / n).is_file()), None)
    )
    if table_path is None:
        names, images = None, image_files(path / "images" if (path / "images").is_dir() else path)
    else:
        table = _read_table(table_path)
        names, images = _names(table, table_path), _images_of(table, table_path, split)
    if not images:
        raise DatasetError(
            f"{path}: has no images; expected images/ and labels/, or images with label files beside them"
        )
    samples = tuple(_sample(image, path, names) for image in images)
    if not any(_labels_path(image, path).is_file() for image in images):
        raise DatasetError(
            f"{path}: none of its {len(images)} images has labels; for {images[0]} "
            f"{_labels_path(images[0], path)} was expected"
        )
    return Dataset(path, "YOLO", names, samples)


def _read_table(path: Path) -> dict[Any, Any]:
    try:
        table = load_plain_yaml(path.read_text(encoding="utf-8"))
    except (PlainYamlError, UnicodeDecodeError) as error:
        raise DatasetError(f"{path}: {error}") from None
    if not isinstance(table, dict):
        raise DatasetError(f"{path}: expected a table with `names` and `val`")
    return table


def _names(table: dict[Any, Any], path: Path) -> tuple[str, ...] | None:
    names = table.get("names")
    if isinstance(names, dict):
        if sorted(map(str, names)) != sorted(map(str, range(len(names)))):
            raise DatasetError(f"{path}: the class names are not numbered from 0")
        names = [names[index] if index in names else names[str(index)] for index in range(len(names))]
    if names is None:
        return None
    if not isinstance(names, list) or not names:
        raise DatasetError(f"{path}: `names` must be a list or a numbered table of class names")
    return tuple(str(name) for name in names)


def _images_of(table: dict[Any, Any], path: Path, split: str | None) -> list[Path]:
    available = [name for name in _SPLITS if table.get(name)]
    chosen = split or (available[0] if available else None)
    if chosen is None and split is None:
        root = path.parent
        return image_files(root / "images" if (root / "images").is_dir() else root)
    if chosen not in available:
        raise DatasetError(f"{path}: has no split {chosen!r}; it has {', '.join(available) or 'none'}")
    base = path.parent / str(table["path"]) if table.get("path") else path.parent
    if not base.is_dir():
        base = path.parent  # `path` is often the author's local path.
    entries = table[chosen] if isinstance(table[chosen], list) else [table[chosen]]
    found: list[Path] = []
    for entry in entries:
        where = base / str(entry)
        if where.is_dir():
            found += image_files(where)
        elif where.is_file() and where.suffix == ".txt":
            lines = where.read_text(encoding="utf-8").splitlines()
            found += [
                _listed(line.strip(), base, where, number)
                for number, line in enumerate(lines, 1)
                if line.strip()
            ]
        else:
            raise DatasetError(f"{path}: `{chosen}` names {where}, which does not exist")
    return found


def _listed(line: str, base: Path, source: Path, number: int) -> Path:
    image = base / line
    if not image.is_file():
        raise DatasetError(f"{source}, line {number}: {image} does not exist")
    return image


def _labels_path(image: Path, root: Path) -> Path:
    """`…/images/x/1.jpg` → `…/labels/x/1.txt`, for the last `images`; else the file beside the image."""
    parts = list(image.parts)
    below = len((root if root.is_dir() else root.parent).parts)
    for index in range(len(parts) - 2, -1, -1):
        if parts[index] == "images":
            moved = Path(*parts[:index], "labels", *parts[index + 1 :]).with_suffix(".txt")
            if index >= below or moved.is_file():
                return moved
    return image.with_suffix(".txt")


def _sample(image: Path, root: Path, names: tuple[str, ...] | None) -> Sample:
    path = _labels_path(image, root)
    if not path.is_file():
        return Sample(image, np.zeros((0, 4), np.float32), np.zeros(0, np.int64), in_fractions=True)
    if path.stat().st_size > _LARGEST_LABELS_BYTES:
        raise DatasetError(f"{path}: has {path.stat().st_size} bytes, too many for a label file")
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError:
        raise DatasetError(f"{path}: is not UTF-8 text") from None
    boxes: list[NDArray[np.float64]] = []
    class_ids: list[int] = []
    for number, line in enumerate(lines, 1):
        if words := line.split():
            class_id, box = _label(words, f"{path}, line {number}", names)
            class_ids.append(class_id)
            boxes.append(box)
    xyxy = np.array(boxes, np.float32).reshape(-1, 4)
    return Sample(image, xyxy, np.array(class_ids, np.int64), in_fractions=True)


def _label(words: list[str], where: str, names: tuple[str, ...] | None) -> tuple[int, NDArray[np.float64]]:
    """One line → class id and (4,) xyxy in fractions."""
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        raise DatasetError(f"{where}: expected numbers, got {' '.join(words)!r:.100}") from None
    class_id = numbers[0]
    if not class_id.is_integer() or class_id < 0 or (names is not None and class_id >= len(names)):
        known = "0 or more" if names is None else f"0..{len(names) - 1}"
        raise DatasetError(f"{where}: the class must be a whole number, {known}, got {words[0]:.100}")
    values = np.array(numbers[1:])
    if len(values) != 4 and (len(values) < 6 or len(values) % 2):
        raise DatasetError(f"{where}: expected `class cx cy w h` or a polygon, got {len(words)} numbers")
    if not all(math.isfinite(value) for value in values):
        raise DatasetError(f"{where}: has a number that is not finite")
    if len(values) == 4:
        x, y, width, height = values
        if width <= 0 or height <= 0:
            raise DatasetError(f"{where}: width and height must be above 0, got {width:g} and {height:g}")
        box = np.array([x - width / 2, y - height / 2, x + width / 2, y + height / 2])
        inside = values
    else:
        x, y = values[::2], values[1::2]
        box = np.array([x.min(), y.min(), x.max(), y.max()])
        inside = values
    if inside.min() < -_ROUNDING or inside.max() > 1 + _ROUNDING:
        raise DatasetError(
            f"{where}: coordinates are fractions of the image, 0..1, got {inside.min():g} to {inside.max():g}"
        )
    return int(class_id), box.clip(0, 1)
