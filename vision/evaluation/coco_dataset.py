"""COCO-format data sets: one JSON file of images, categories and annotations (cocodataset.org, Data
format).
"""

from __future__ import annotations

import json
import math
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from vision.evaluation.samples import Dataset, DatasetError, Sample


def find_annotations(folder: Path) -> Path | None:
    """Find the annotation file of a folder: the only JSON with `images` and `annotations`; None if there is
    none.
    """
    if not folder.is_dir():
        return None
    found = sorted({*folder.glob("annotations/*.json"), *folder.glob("*.json")})
    fitting = [path for path in found if path.name.startswith(("instances", "_annotations", "annotations"))]
    candidates = fitting or [path for path in found if _looks_like_coco(path)]
    if len(candidates) > 1:
        names = ", ".join(str(path.relative_to(folder)) for path in candidates)
        raise DatasetError(f"{folder}: has several annotation files, give one: {names}")
    return candidates[0] if candidates else None


def _looks_like_coco(path: Path) -> bool:
    """Check the keys at the beginning and end of the file: annotation files can be large."""
    with path.open("rb") as file:
        seen = file.read(1 << 16)
        file.seek(max(0, path.stat().st_size - (1 << 16)))
        seen += file.read()
    return b'"images"' in seen and (b'"annotations"' in seen or b'"categories"' in seen)


def read_coco(path: Path, images: Path | None = None) -> Dataset:
    """Read the data set of one annotation file; raises `DatasetError` naming the entry."""
    try:
        content = json.loads(path.read_bytes())
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror or error})") from None
    except (ValueError, RecursionError) as error:
        raise DatasetError(f"{path}: is not JSON ({error})") from None
    if not isinstance(content, dict):
        raise DatasetError(f"{path}: expected an object with images, annotations and categories")
    names, ids = _categories(_entries(content, "categories", path), path)
    annotations = defaultdict(list)
    for index, entry in enumerate(_entries(content, "annotations", path)):
        image_id, class_id, box, crowd = _annotation(entry, ids, f"{path}, annotation {index}")
        annotations[image_id].append((class_id, box, crowd))
    samples = []
    finder = _ImageFinder(path, images)
    for index, entry in enumerate(_entries(content, "images", path)):
        where = f"{path}, image {index}"
        image_id, file_name = entry.get("id"), entry.get("file_name")
        if type(image_id) not in (int, str) or not isinstance(file_name, str):
            raise DatasetError(f"{where}: expected `id` and `file_name`")
        seen = annotations.pop(image_id, [])
        samples.append(
            Sample(
                finder.find(file_name, where),
                np.array([box for _, box, _ in seen], np.float32).reshape(-1, 4),
                np.array([class_id for class_id, _, _ in seen], np.int64),
                ignored=np.array([crowd for _, _, crowd in seen], np.bool_),
            )
        )
    if annotations:
        raise DatasetError(
            f"{path}: has annotations of the image {next(iter(annotations))!r}, which is not listed"
        )
    if not samples:
        raise DatasetError(f"{path}: lists no images")
    return Dataset(path, "COCO", names, tuple(samples))


def _entries(content: dict[str, Any], key: str, path: Path) -> list[dict[str, Any]]:
    value = content.get(key)
    if not isinstance(value, list) or not all(isinstance(entry, dict) for entry in value):
        raise DatasetError(f"{path}: `{key}` must be a list of objects")
    return value


def _categories(entries: list[dict[str, Any]], path: Path) -> tuple[tuple[str, ...], dict[Any, int]]:
    """Names in the order of the file, and the file's ids → their index in it."""
    ids: dict[Any, int] = {}
    names = []
    for index, entry in enumerate(entries):
        if type(entry.get("id")) is not int or not isinstance(entry.get("name"), str) or entry["id"] in ids:
            raise DatasetError(f"{path}, category {index}: expected a unique `id` and a `name`")
        ids[entry["id"]] = index
        names.append(entry["name"])
    if not names:
        raise DatasetError(f"{path}: has no categories")
    return tuple(names), ids


def _annotation(entry: dict[str, Any], ids: dict[Any, int], where: str) -> tuple[Any, int, list[float], bool]:
    category, box = entry.get("category_id"), entry.get("bbox")
    if type(category) is not int or category not in ids:
        raise DatasetError(f"{where}: its category_id {category!r:.100} is not in categories")
    if type(entry.get("image_id")) not in (int, str):
        raise DatasetError(f"{where}: has no image_id")
    if (
        not isinstance(box, list)
        or len(box) != 4
        or not all(type(value) in (int, float) and math.isfinite(value) for value in box)
        or min(box[2:]) < 0
    ):
        raise DatasetError(
            f"{where}: its bbox must be [left, top, width, height] in pixels, got {box!r:.100}"
        )
    left, top, width, height = box
    return (
        entry["image_id"],
        ids[category],
        [left, top, left + width, top + height],
        bool(entry.get("iscrowd")),
    )


class _ImageFinder:
    """Finds the images of an annotation file: beside it, in `images/`, or in a folder named after the
    split.
    """

    def __init__(self, annotations: Path, images: Path | None) -> None:
        if images is not None and not images.is_dir():
            raise DatasetError(f"{images}: is not a folder of images")
        root = annotations.parent
        split = annotations.stem.removeprefix("instances_")
        above = root.parent if root.name == "annotations" else root
        self._folders = (
            [images] if images else [root, above / split, above / "images" / split, above / "images", above]
        )

    def find(self, file_name: str, where: str) -> Path:
        for folder in self._folders:
            if (folder / file_name).is_file():
                return folder / file_name
        searched = ", ".join(str(folder) for folder in self._folders)
        raise DatasetError(f"{where}: {file_name} is in none of {searched}; give the folder with --images")
