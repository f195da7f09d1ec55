"""Labelled data sets in YOLO and COCO format: images and their ground truth.

YOLO: images, with label files of `class cx cy w h` lines beside them or under `labels/`. Coordinates are
fractions of the image. A line with more numbers is a polygon (segmentation label); its bounding box is used.
An image without a label file, or with an empty one, is a negative.

COCO: one JSON file of images, categories and annotations (cocodataset.org, Data format).
"""

from __future__ import annotations

import json
import logging
import math
import os
import unicodedata
from collections import defaultdict
from collections.abc import Hashable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from vision import image_file
from vision.file_kinds import explained, is_hidden, open_file
from vision.image_file import is_image
from vision.plain_yaml import PlainYamlError, load_plain_yaml, numbered
from vision.text_file import read_text

logger = logging.getLogger(__name__)

_Label = TypeVar("_Label", bound=Hashable)

_TABLE_NAMES = ("data.yaml", "data.yml", "dataset.yaml")
_SPLITS = ("val", "test", "train")
# Labels are written with six digits, so a box at the edge may exceed it by this much.
_ROUNDING = 1e-4
_LARGEST_LABELS_BYTES = 16 << 20


def open_dataset(
    path: Path,
    *,
    split: str | None = None,
    images: Path | None = None,
    class_names: tuple[str, ...] | None = None,
) -> Dataset:
    """Detect the format of the data set at `path` and read its labels.

    Args:
        path: a folder with `images/` and `labels/`, or with both side by side; one with a `data.yaml`, or
            that file; a COCO annotation file (JSON), or a folder with one.
        split: `train`, `val` or `test` of a `data.yaml` (None: `val`, or the first other one), or in the name
            of one of several annotation files.
        images: folder of a COCO file's images; None: searched near the file.
        class_names: of a data set without names.

    Raises:
        MissingSplitError: it has splits, but not `split`.
        DatasetError: no data set found, or an invalid label.
    """
    if not path.exists():
        raise DatasetError(
            f"{path}: no such file or folder; give a data set's folder, data.yaml or COCO JSON"
        )
    annotations = path if path.suffix.lower() == ".json" else find_annotations(path, split)
    if annotations is not None:
        return read_coco(annotations, images)
    return read_yolo(path, split, class_names)


class DatasetError(ValueError):
    """A data set that cannot be used; the message names the file, the line or entry, and the problem."""


class MissingSplitError(DatasetError):
    """A data set that has splits, but not the requested one."""


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """One image and its ground truth.

    Attributes:
        image: the file.
        boxes: (N, 4) float32 xyxy: pixels, or fractions of the image if `in_fractions`.
        class_ids: (N,) int64.
        in_fractions: as in YOLO labels.
        stated_size: width and height of the image by the data set, pixels; None: not stated.
        ignored: (N,) bool: regions that need not be detected (COCO's `iscrowd`).
    """

    image: Path
    boxes: NDArray[np.float32]
    class_ids: NDArray[np.int64]
    in_fractions: bool = False
    ignored: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, np.bool_))
    stated_size: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        if self.ignored.shape != self.class_ids.shape:
            object.__setattr__(self, "ignored", np.zeros(len(self.class_ids), np.bool_))

    def boxes_in(self, width: int, height: int) -> NDArray[np.float32]:
        """(N, 4) float32 xyxy in the pixels of an image of this size.

        Raises:
            DatasetError: the data set states another size, or the middle of a box is outside, so its boxes
                are of another image.
        """
        if self.stated_size is not None and self.stated_size != (width, height):
            stated_width, stated_height = self.stated_size
            turned = self.stated_size == (height, width)
            why = "its EXIF orientation turns it" if turned else "it was resized"
            raise DatasetError(
                f"{self.image}: the annotations state {stated_width}x{stated_height} pixels, the image has "
                f"{width}x{height} ({why}): their boxes do not fit it; annotate this image, or use "
                f"the original"
            )
        if not self.in_fractions:
            middles = (self.boxes[:, :2] + self.boxes[:, 2:]) / 2
            outside = np.any((middles < 0) | (middles > (width, height)), axis=1)
            if outside.any():
                left, top, right, bottom = self.boxes[int(np.argmax(outside))].tolist()
                raise DatasetError(
                    f"{self.image}: the middle of the bbox [{left:g}, {top:g}, {right - left:g}, "
                    f"{bottom - top:g}] is outside the image of {width}x{height} pixels: it is of a larger "
                    f"image, or not [left, top, width, height]"
                )
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
    """Every image below `folder`, by name, without hidden files and folders."""
    return sorted(_images_below(folder))


def _images_below(folder: Path) -> Iterator[Path]:
    for where, folders, names in os.walk(folder):
        folders[:] = sorted(name for name in folders if not is_hidden(Path(name)))
        files = (Path(where, name) for name in names)
        yield from (path for path in files if is_image(path) and not is_hidden(path))


def read_image(path: Path) -> NDArray[np.uint8]:
    """(height, width, 3) uint8 BGR, rotated by its EXIF orientation; raises `DatasetError`."""
    try:
        return image_file.read_image(path)
    except image_file.ImageError as error:
        raise DatasetError(f"{path}: {error}") from None


def find_annotations(folder: Path, split: str | None = None) -> Path | None:
    """Find the annotation file of a folder: the only JSON with `images` and `annotations`, or the one with
    the split in its name; None if there is none.
    """
    if not folder.is_dir():
        return None
    found = sorted({*folder.glob("annotations/*.json"), *folder.glob("*.json")})
    fitting = [path for path in found if path.name.startswith(("instances", "_annotations", "annotations"))]
    candidates = fitting or [path for path in found if _looks_like_coco(path)]
    if split is not None and len(candidates) > 1:
        candidates = [path for path in candidates if split in path.stem] or candidates
    if len(candidates) > 1:
        names = ", ".join(str(path.relative_to(folder)) for path in candidates)
        absent = split is not None and split not in candidates[0].stem
        error = MissingSplitError if absent else DatasetError
        raise error(f"{folder}: has several annotation files, give one: {names}")
    return candidates[0] if candidates else None


def _looks_like_coco(path: Path) -> bool:
    """Check the keys at the beginning and end of the file: annotation files can be large."""
    with open_file(path) as file:
        seen = file.read(1 << 16)
        file.seek(max(0, path.stat().st_size - (1 << 16)))
        seen += file.read()
    return b'"images"' in seen and (b'"annotations"' in seen or b'"categories"' in seen)


def read_coco(path: Path, images: Path | None = None) -> Dataset:
    """Read the data set of one annotation file; raises `DatasetError` naming the entry."""
    try:
        content = json.loads(read_text(path))
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror or error})") from None
    except UnicodeDecodeError as error:
        raise DatasetError(f"{path}: {error}") from None
    except (ValueError, RecursionError) as error:
        raise DatasetError(explained(path, f"{path}: is not JSON ({error})")) from None
    if not isinstance(content, dict):
        raise DatasetError(f"{path}: expected an object with images, annotations and categories")
    names, ids = _categories(_entries(content, "categories", path), path)
    annotations = defaultdict(list)
    for index, entry in enumerate(_entries(content, "annotations", path)):
        of_image, class_id, box, crowd = _annotation(entry, ids, f"{path}, annotation {index}")
        annotations[str(of_image)].append((class_id, box, crowd))
    samples = []
    repeated = 0
    listed: set[str] = set()
    finder = _ImageFinder(path, images)
    for index, entry in enumerate(_entries(content, "images", path)):
        where = f"{path}, image {index}"
        image_id, file_name = entry.get("id"), entry.get("file_name")
        if type(image_id) not in (int, str) or not isinstance(file_name, str):
            raise DatasetError(f"{where}: expected `id` and `file_name`")
        if str(image_id) in listed:
            raise DatasetError(f"{where}: its id {image_id!r:.100} is that of an earlier image")
        listed.add(str(image_id))
        given = annotations.pop(str(image_id), [])
        seen = _once(given)
        repeated += len(given) - len(seen)
        samples.append(
            Sample(
                finder.find(file_name, where),
                np.array([box for _, box, _ in seen], np.float32).reshape(-1, 4),
                np.array([class_id for class_id, _, _ in seen], np.int64),
                ignored=np.array([crowd for _, _, crowd in seen], np.bool_),
                stated_size=_stated_size(entry, where),
            )
        )
    if annotations:
        raise DatasetError(
            f"{path}: has annotations of the image {next(iter(annotations)):.100}, which is not listed"
        )
    if not samples:
        raise DatasetError(f"{path}: lists no images")
    _report_repeated(path, repeated)
    return Dataset(path, "COCO", names, tuple(samples))


def _once(labels: Iterable[_Label]) -> list[_Label]:
    """Without those that are given again."""
    return list(dict.fromkeys(labels))


def _report_repeated(path: Path, repeated: int) -> None:
    if repeated:
        logger.warning(
            "%s: %d labels are given more than once in an image; each is used once", path, repeated
        )


def _stated_size(entry: dict[str, Any], where: str) -> tuple[int, int] | None:
    size = entry.get("width"), entry.get("height")
    if size == (None, None) or size == (0, 0):
        return None
    # Some programs write whole numbers as 640.0.
    width, height = (int(side) if isinstance(side, float) and side.is_integer() else side for side in size)
    if type(width) is not int or type(height) is not int or min(width, height) <= 0:
        raise DatasetError(
            f"{where}: width and height must be whole numbers of pixels, got {width!r:.100} and "
            f"{height!r:.100}"
        )
    return width, height


def _entries(content: dict[str, Any], key: str, path: Path) -> list[dict[str, Any]]:
    value = content.get(key)
    if not isinstance(value, list) or not all(isinstance(entry, dict) for entry in value):
        raise DatasetError(explained(path, f"{path}: `{key}` must be a list of objects"))
    return value


def _categories(entries: list[dict[str, Any]], path: Path) -> tuple[tuple[str, ...], dict[str, int]]:
    """Names in the order of the file, and the file's ids, as text → their index in it."""
    ids: dict[str, int] = {}
    names = []
    for index, entry in enumerate(entries):
        number, name = entry.get("id"), entry.get("name")
        if type(number) not in (int, str) or not isinstance(name, str) or str(number) in ids:
            raise DatasetError(f"{path}, category {index}: expected a unique `id` and a `name`")
        ids[str(number)] = index
        names.append(name)
    if not names:
        raise DatasetError(f"{path}: has no categories")
    return tuple(names), ids


def _annotation(
    entry: dict[str, Any], ids: dict[str, int], where: str
) -> tuple[int | str, int, tuple[float, ...], bool]:
    category, box = entry.get("category_id"), entry.get("bbox")
    if type(category) not in (int, str) or str(category) not in ids:
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
        ids[str(category)],
        (left, top, left + width, top + height),
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
        # Windows writes backslashes, and macOS decomposes letters with marks.
        slashed = file_name.replace("\\", "/")
        names = (file_name, slashed, *(unicodedata.normalize(form, slashed) for form in ("NFC", "NFD")))
        for folder in self._folders:
            for name in names:
                if (folder / name).is_file():
                    return folder / name
        searched = ", ".join(str(folder) for folder in self._folders)
        raise DatasetError(f"{where}: {file_name} is in none of {searched}; give the folder with --images")


def read_yolo(path: Path, split: str | None = None, class_names: tuple[str, ...] | None = None) -> Dataset:
    """Read the data set at `path`: a `data.yaml`, a folder with one, or a folder of images. `class_names`
    are used if it has none. Raises `DatasetError`.
    """
    table_path = (
        path if path.is_file() else next((path / n for n in _TABLE_NAMES if (path / n).is_file()), None)
    )
    keypoints = None
    if table_path is None:
        names, images = class_names, image_files(path / "images" if (path / "images").is_dir() else path)
    else:
        table = _read_table(table_path)
        names, images = _names(table, table_path) or class_names, _images_of(table, table_path, split)
        keypoints = _keypoints(table, table_path)
        count = table.get("nc")
        if "names" in table and names is not None and type(count) is int and count != len(names):
            raise DatasetError(f"{table_path}: `nc` is {count}, but `names` has {len(names)} classes")
    if not images:
        raise DatasetError(
            f"{path}: has no images; expected images/ and labels/, or images with label files beside them"
        )
    read = [_sample(image, path, names, keypoints) for image in images]
    samples = tuple(sample for sample, _ in read)
    if not any(_labels_path(image, path).is_file() for image in images):
        raise DatasetError(
            f"{path}: none of its {len(images)} images has labels; for {images[0]} "
            f"{_labels_path(images[0], path)} was expected"
        )
    _check_labels_have_images(images, path)
    _report_repeated(path, sum(repeated for _, repeated in read))
    return Dataset(path, "YOLO", names, samples)


def _check_labels_have_images(images: list[Path], root: Path) -> None:
    """Raise `DatasetError` for a file under `labels/` without an image: the image was lost or renamed."""
    for labels, folder in {(_labels_path(image, root).parent, image.parent) for image in images}:
        if labels == folder or not labels.is_dir():
            continue
        shown = {image.stem for image in folder.iterdir() if is_image(image)}
        for path in sorted(labels.glob("*.txt")):
            if is_hidden(path):
                continue
            if path.stem not in shown and path.name != "classes.txt":  # labelling programs list the names
                raise DatasetError(
                    f"{path}: its image {folder / path.stem}.jpg (or of another kind) does not exist; "
                    "add the image or remove the labels"
                )


def _read_table(path: Path) -> dict[Any, Any]:
    try:
        table = load_plain_yaml(read_text(path))
    except (PlainYamlError, UnicodeDecodeError) as error:
        raise DatasetError(explained(path, f"{path}: {error}")) from None
    if not isinstance(table, dict) or not table.keys() & {"names", "nc", "path", *_SPLITS}:
        raise DatasetError(explained(path, f"{path}: expected a table with `names` and `val`"))
    return table


def _names(table: dict[Any, Any], path: Path) -> tuple[str, ...] | None:
    names = table.get("names")
    if isinstance(names, dict):
        given = names
        names = numbered(given)
        if names is None:
            missing = next(
                (index for index in range(len(given)) if not given.keys() & {index, str(index)}), 0
            )
            raise DatasetError(f"{path}: the class names are not numbered from 0: {missing} is missing")
    if names is None:
        return None
    if not isinstance(names, list) or not names:
        raise DatasetError(f"{path}: `names` must be a list or a numbered table of class names")
    return tuple(str(name) for name in names)


def _keypoints(table: dict[Any, Any], path: Path) -> tuple[int, int] | None:
    """`kpt_shape`: the number of keypoints of each label, and the numbers of each (2 or 3); None: none."""
    shape = table.get("kpt_shape")
    if shape is None:
        return None
    if (
        not isinstance(shape, list)
        or len(shape) != 2
        or not all(type(number) is int and number > 0 for number in shape)
        or shape[1] not in (2, 3)
    ):
        raise DatasetError(f"{path}: `kpt_shape` must be [keypoints, 2 or 3], got {shape!r:.100}")
    return shape[0], shape[1]


def _images_of(table: dict[Any, Any], path: Path, split: str | None) -> list[Path]:
    available = [name for name in _SPLITS if table.get(name)]
    chosen = split or (available[0] if available else None)
    if not available:
        root = path.parent
        return image_files(root / "images" if (root / "images").is_dir() else root)
    if chosen not in available:
        raise MissingSplitError(f"{path}: has no split {chosen!r}; it has {', '.join(available)}")
    base = path.parent / str(table["path"]) if table.get("path") else path.parent
    if not base.is_dir():
        base = path.parent  # `path` is often the author's local path.
    entries = table[chosen] if isinstance(table[chosen], list) else [table[chosen]]
    found: list[Path] = []
    for entry in entries:
        where = _place(base, str(entry))
        if where.is_dir():
            found += image_files(where)
        elif where.is_file() and where.suffix == ".txt":
            lines = read_text(where).splitlines()
            found += [
                _listed(line.strip(), base, where, number)
                for number, line in enumerate(lines, 1)
                if line.strip()
            ]
        else:
            raise DatasetError(f"{path}: `{chosen}` names {where}, which does not exist")
    return found


def _place(base: Path, entry: str) -> Path:
    """Where an entry of `data.yaml` is. Roboflow writes `../valid/images` beside the folder `valid`."""
    slashed = entry.replace("\\", "/")
    places = [base / entry, base / slashed, base / slashed.removeprefix("../")]
    return next((place for place in places if place.exists()), places[0])


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


def _sample(
    image: Path, root: Path, names: tuple[str, ...] | None, keypoints: tuple[int, int] | None
) -> tuple[Sample, int]:
    """An image with its labels, and how many of these were repeated."""
    path = _labels_path(image, root)
    if not path.is_file():
        return Sample(image, np.zeros((0, 4), np.float32), np.zeros(0, np.int64), in_fractions=True), 0
    if path.stat().st_size > _LARGEST_LABELS_BYTES:
        raise DatasetError(f"{path}: has {path.stat().st_size} bytes, too many for a label file")
    try:
        lines = read_text(path).splitlines()
    except UnicodeDecodeError as error:
        raise DatasetError(f"{path}: {error}") from None
    given: list[tuple[int, tuple[float, ...]]] = []
    for number, line in enumerate(lines, 1):
        if words := line.split():
            class_id, box = _label(words, f"{path}, line {number}", names, keypoints)
            given.append((class_id, tuple(box.tolist())))
    labels = _once(given)
    xyxy = np.array([box for _, box in labels], np.float32).reshape(-1, 4)
    class_ids = np.array([class_id for class_id, _ in labels], np.int64)
    return Sample(image, xyxy, class_ids, in_fractions=True), len(given) - len(labels)


def _label(
    words: list[str], where: str, names: tuple[str, ...] | None, keypoints: tuple[int, int] | None
) -> tuple[int, NDArray[np.float64]]:
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
    if keypoints is not None:
        count, each = keypoints
        if len(values) not in (4, 4 + count * each):
            raise DatasetError(
                f"{where}: `kpt_shape: [{count}, {each}]` means {5 + count * each} numbers, the class, the "
                f"box and {count} keypoints of {each}; got {len(words)}"
            )
        values = values[:4]
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
