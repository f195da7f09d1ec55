"""Labelled data sets, and the worst errors of a detector on them."""

from __future__ import annotations

import json
import os
import re
import unicodedata
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from vision.detections import Detections
from vision.evaluation.datasets import Dataset, DatasetError, open_dataset, read_image
from vision.evaluation.misses import WorstMisses


def make_image(path: Path, width: int = 200, height: int = 100) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.full((height, width, 3), 90, np.uint8))
    return path


def text(path: Path, content: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content)
    return path


@pytest.fixture
def yolo(tmp_path: Path) -> Path:
    """Two labelled images and one negative."""
    for name in ("a", "b", "c"):
        make_image(tmp_path / "images" / "val" / f"{name}.jpg")
    text(tmp_path / "labels" / "val" / "a.txt", "0 0.5 0.5 0.2 0.4\n\n1 0.25 0.25 0.5 0.5\n")
    text(tmp_path / "labels" / "val" / "b.txt", "1 0.1 0.1 0.3 0.1 0.3 0.5 0.1 0.5\n")
    return tmp_path


def pixels(dataset: Dataset, index: int) -> list[list[int]]:
    boxes: list[list[int]] = dataset.samples[index].boxes_in(200, 100).round().astype(int).tolist()
    return boxes


def test_images_and_labels_in_separate_folders(yolo: Path) -> None:
    dataset = open_dataset(yolo)
    assert (dataset.kind, dataset.class_names) == ("YOLO", None)
    assert [sample.image.name for sample in dataset.samples] == ["a.jpg", "b.jpg", "c.jpg"]
    assert pixels(dataset, 0) == [[80, 30, 120, 70], [0, 0, 100, 50]]
    assert dataset.samples[0].class_ids.tolist() == [0, 1]
    assert pixels(dataset, 1) == [[20, 10, 60, 50]]  # The box of a polygon.
    assert len(dataset.samples[2].boxes) == 0


def test_image_with_a_name_that_is_not_utf8_is_read(yolo: Path) -> None:
    image = next((yolo / "images").rglob("a.jpg"))
    renamed = image.rename(image.with_name(os.fsdecode(b"caf\xe9.jpg")))
    assert read_image(renamed).shape == (100, 200, 3)
    for unreadable in (image, renamed.parent):
        with pytest.raises(DatasetError, match=re.escape(str(unreadable))):
            read_image(unreadable)


def test_labels_without_their_image_are_rejected(yolo: Path) -> None:
    text(yolo / "labels" / "val" / "classes.txt", "car\n")  # the names, of a labelling program
    assert len(open_dataset(yolo, class_names=("car", "dog")).samples) == 3
    lost = text(yolo / "labels" / "val" / "d.txt", "0 0.5 0.5 0.2 0.4\n")
    with pytest.raises(DatasetError, match=rf"{lost}: its image .*d\.jpg"):
        open_dataset(yolo)


def test_images_with_labels_beside_them(tmp_path: Path) -> None:
    make_image(tmp_path / "x.png")
    text(tmp_path / "x.txt", "0 0.5 0.5 1 1")
    assert pixels(open_dataset(tmp_path), 0) == [[0, 0, 200, 100]]


@pytest.mark.parametrize("names", ["[car, no]", "{0: car, 1: no}"])
def test_a_data_yaml_gives_names_and_splits(yolo: Path, names: str) -> None:
    text(
        yolo / "data.yaml",
        f"path: /where/it/was/made\nval: images/val\ntrain: images/train\nnames: {names}\n",
    )
    for path in (yolo, yolo / "data.yaml"):
        dataset = open_dataset(path)
        assert dataset.class_names == ("car", "no")
        assert len(dataset.samples) == 3
    with pytest.raises(DatasetError, match=r"`train` .*images/train"):
        open_dataset(yolo, split="train")
    with pytest.raises(DatasetError, match=r"'test'.* val, train"):
        open_dataset(yolo, split="test")


def test_a_split_may_be_a_list_of_files(yolo: Path) -> None:
    text(yolo / "val.txt", "./images/val/b.jpg\n\nimages/val/gone.jpg\n")
    text(yolo / "data.yaml", "val: val.txt\nnames: [car, dog]\n")
    with pytest.raises(DatasetError, match=r"line 3: .*gone\.jpg"):
        open_dataset(yolo)
    text(yolo / "val.txt", "./images/val/b.jpg\n")
    assert [sample.image.name for sample in open_dataset(yolo).samples] == ["b.jpg"]


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("0 0.5 0.5 0.2", "got 4 numbers"),
        ("0 0.5 0.5 0.2 0.2 0.9", "got 6 numbers"),
        ("car 0.5 0.5 0.2 0.2", "expected numbers"),
        ("0.5 0.5 0.5 0.2 0.2", "whole number"),
        ("-1 0.5 0.5 0.2 0.2", "whole number"),
        ("2 0.5 0.5 0.2 0.2", r"whole number, 0\.\.1, got 2"),
        ("0 0.5 0.5 0 0.2", "width and height"),
        ("0 120 50 20 20", r"got 20 to 120"),
        ("0 nan 0.5 0.2 0.2", "not finite"),
    ],
)
def test_a_wrong_label_is_named_with_file_and_line(yolo: Path, line: str, expected: str) -> None:
    text(yolo / "data.yaml", "val: images/val\nnames: [car, dog]\n")
    text(yolo / "labels" / "val" / "b.txt", f"0 0.5 0.5 0.1 0.1\n{line}\n")
    with pytest.raises(DatasetError, match=rf"b\.txt, line 2: .*{expected}"):
        open_dataset(yolo)


def test_image_without_labels_is_rejected(tmp_path: Path) -> None:
    make_image(tmp_path / "images" / "a.jpg")
    with pytest.raises(DatasetError, match=r"labels/a\.txt"):
        open_dataset(tmp_path)


def coco(tmp_path: Path, **changes: Any) -> Path:
    make_image(tmp_path / "val2017" / "a.jpg")
    content = {
        "images": [{"id": 7, "file_name": "a.jpg", "width": 200, "height": 100}],
        "categories": [{"id": 3, "name": "car"}, {"id": 90, "name": "dog"}],
        "annotations": [
            {"image_id": 7, "category_id": 90, "bbox": [10, 20, 30, 40], "iscrowd": 0},
            {"image_id": 7, "category_id": 3, "bbox": [0, 0, 5.5, 5], "iscrowd": 1},
        ],
    } | changes
    return text(tmp_path / "annotations" / "instances_val2017.json", json.dumps(content))


def test_a_coco_file_is_read_with_its_crowds(tmp_path: Path) -> None:
    path = coco(tmp_path)
    for where in (path, tmp_path):
        dataset = open_dataset(where)
        assert (dataset.kind, dataset.class_names) == ("COCO", ("car", "dog"))
        (sample,) = dataset.samples
        assert sample.image == tmp_path / "val2017" / "a.jpg"
        assert sample.boxes_in(200, 100).tolist() == [[10, 20, 40, 60], [0, 0, 5.5, 5]]
        assert sample.class_ids.tolist() == [1, 0]
        assert sample.ignored.tolist() == [False, True]


@pytest.mark.parametrize("size", [(100, 200), (100, 50)])
def test_coco_boxes_of_another_size_are_refused(tmp_path: Path, size: tuple[int, int]) -> None:
    width, height = size
    listed = {"id": 7, "file_name": "a.jpg", "width": width, "height": height}
    (sample,) = open_dataset(coco(tmp_path, images=[listed])).samples
    image = read_image(sample.image)
    with pytest.raises(DatasetError, match=rf"a\.jpg: .* {width}x{height} .* 200x100 "):
        sample.boxes_in(image.shape[1], image.shape[0])


def test_coco_image_ids_may_be_text_beside_numbers(tmp_path: Path) -> None:
    boxes = [{"image_id": "7", "category_id": 3, "bbox": [0, 0, 5, 5]}]
    (sample,) = open_dataset(coco(tmp_path, annotations=boxes)).samples
    assert sample.class_ids.tolist() == [0]


def test_coco_category_ids_may_be_text_and_sizes_floats(tmp_path: Path) -> None:
    boxes = [{"image_id": 7, "category_id": "90", "bbox": [0, 0, 5, 5]}]
    listed = {"id": 7, "file_name": "a.jpg", "width": 200.0, "height": 100.0}
    (sample,) = open_dataset(coco(tmp_path, annotations=boxes, images=[listed])).samples
    assert (sample.class_ids.tolist(), sample.stated_size) == ([1], (200, 100))


@pytest.mark.parametrize(
    ("stored", "listed"),
    [
        ("b.jpg", "val2017\\b.jpg"),
        (unicodedata.normalize("NFD", "gärten.jpg"), unicodedata.normalize("NFC", "gärten.jpg")),
        (unicodedata.normalize("NFC", "gärten.jpg"), unicodedata.normalize("NFD", "gärten.jpg")),
    ],
)
def test_coco_file_names_of_other_systems_are_found(tmp_path: Path, stored: str, listed: str) -> None:
    make_image(tmp_path / "val2017" / stored)
    (sample,) = open_dataset(coco(tmp_path, images=[{"id": 7, "file_name": listed}])).samples
    assert sample.image.name == stored


def test_a_coco_box_beyond_its_image_is_refused(tmp_path: Path) -> None:
    corners = [{"image_id": 7, "category_id": 3, "bbox": [120, 50, 190, 90]}]
    (sample,) = open_dataset(coco(tmp_path, annotations=corners)).samples
    with pytest.raises(DatasetError, match=r"a\.jpg: .*\[120, 50, 190, 90\] .* 200x100 "):
        sample.boxes_in(200, 100)


def test_a_number_of_classes_that_contradicts_the_names_is_refused(yolo: Path) -> None:
    table = text(yolo / "data.yaml", "val: images/val\nnc: 3\nnames: [one, two]\n")
    with pytest.raises(DatasetError, match=r"data\.yaml: `nc` .*3.* 2 "):
        open_dataset(table)


@pytest.mark.parametrize("keypoint", ["0.5 0.5 2", "0.5 0.5"])
def test_box_of_a_label_with_keypoints(yolo: Path, keypoint: str) -> None:
    each = len(keypoint.split())
    names = f"val: images/val\nnames: [one, two]\nkpt_shape: [3, {each}]\n"
    table = text(yolo / "data.yaml", names)
    points = " ".join([keypoint] * 3)
    text(yolo / "labels" / "val" / "a.txt", f"1 0.25 0.25 0.5 0.5 {points}\n")
    text(yolo / "labels" / "val" / "b.txt", "0 0.5 0.5 0.2 0.4\n")  # without keypoints
    dataset = open_dataset(table)
    assert (pixels(dataset, 0), pixels(dataset, 1)) == ([[0, 0, 100, 50]], [[80, 30, 120, 70]])
    text(yolo / "labels" / "val" / "a.txt", f"1 0.25 0.25 0.5 0.5 {points} 0.5\n")
    with pytest.raises(DatasetError, match=rf"line 1: `kpt_shape: \[3, {each}\]` .* {5 + 3 * each} "):
        open_dataset(table)


def test_a_wrong_kpt_shape_is_named(yolo: Path) -> None:
    for shape in ("17", "[17]", "[17, 4]", "[0, 3]", "[a, 2]"):
        table = text(yolo / "data.yaml", f"val: images/val\nkpt_shape: {shape}\n")
        with pytest.raises(DatasetError, match=r"yaml: `kpt_shape`"):
            open_dataset(table)


def test_repeated_labels_are_used_once(yolo: Path, caplog: pytest.LogCaptureFixture) -> None:
    text(yolo / "labels" / "val" / "a.txt", "0 0.5 0.5 0.2 0.4\n1 0.25 0.25 0.5 0.5\n0 0.5 0.5 0.2 0.4\n")
    dataset = open_dataset(yolo)
    assert dataset.samples[0].class_ids.tolist() == [0, 1]
    assert pixels(dataset, 0) == [[80, 30, 120, 70], [0, 0, 100, 50]]
    box = {"image_id": 7, "category_id": 3, "bbox": [0, 0, 5, 5]}
    (sample,) = open_dataset(coco(yolo, annotations=[box, box])).samples
    assert sample.class_ids.tolist() == [0]
    assert [record.args[1] for record in caplog.records if isinstance(record.args, tuple)] == [1, 1]


@pytest.mark.parametrize("entry", ["../valid/images", "..\\valid\\images", "valid\\images"])
def test_roboflow_and_windows_paths_are_found(tmp_path: Path, entry: str) -> None:
    make_image(tmp_path / "set" / "valid" / "images" / "a.jpg")
    text(tmp_path / "set" / "valid" / "labels" / "a.txt", "0 0.5 0.5 0.2 0.4\n")
    table = text(tmp_path / "set" / "data.yaml", f"val: {entry}\nnames: [car]\n")
    dataset = open_dataset(table)
    assert pixels(dataset, 0) == [[80, 30, 120, 70]]


def test_apple_double_files_are_left_out(yolo: Path) -> None:
    for path in (yolo / "images" / "val" / "._a.jpg", yolo / "labels" / "val" / "._a.txt"):
        path.write_bytes(b"\x00\x05\x16\x07\x00\x02\x00\x00Mac OS X")
    assert [sample.image.name for sample in open_dataset(yolo).samples] == ["a.jpg", "b.jpg", "c.jpg"]


def annotated(**changes: Any) -> dict[str, Any]:
    return {"annotations": [{"image_id": 7, "category_id": 3, "bbox": [0, 0, 1, 1]} | changes]}


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        (annotated(category_id=1), "annotation 0: .*category_id 1"),
        (annotated(bbox=[0, 0, -1, 1]), "annotation 0: .*bbox"),
        (annotated(image_id=8), "image 8"),
        ({"annotations": {}}, "`annotations`"),
        ({"categories": []}, "has no categories"),
        ({"categories": [{"id": 1}]}, "category 0: expected"),
        ({"images": [{"id": 7, "file_name": "gone.jpg"}]}, "image 0: gone.jpg .*--images"),
        ({"images": [{"id": 7, "file_name": "a.jpg"}] * 2}, "image 1: its id 7"),
    ],
)  # fmt: skip
def test_a_wrong_entry_of_a_coco_file_is_named(
    tmp_path: Path, changes: dict[str, Any], expected: str
) -> None:
    with pytest.raises(DatasetError, match=expected):
        open_dataset(coco(tmp_path, **changes))


def test_invalid_json_and_ambiguous_files_are_rejected(tmp_path: Path) -> None:
    path = coco(tmp_path)
    text(path.with_name("instances_train2017.json"), "{}")
    with pytest.raises(DatasetError, match=r"several .*instances_train2017"):
        open_dataset(tmp_path)
    assert open_dataset(tmp_path, split="val").root == path
    with pytest.raises(DatasetError, match=r"x\.json: .*not JSON \("):
        open_dataset(text(tmp_path / "x.json", "{"))


NAMES = ("car", "dog")
IMAGE = np.zeros((100, 200, 3), np.uint8)


def found(*boxes: tuple[float, float, float, float, float, int]) -> Detections:
    table = np.array(boxes, np.float32).reshape(-1, 6)
    return Detections(table[:, :4], table[:, 4], table[:, 5].astype(np.int64), NAMES)


def add(
    misses: WorstMisses, detections: Detections, *true: tuple[float, float, float, float, int], **crowd: bool
) -> None:
    table = np.array(true, np.float32).reshape(-1, 5)
    ignored = np.full(len(table), crowd.get("ignored", False))
    misses.add(Path("a.jpg"), IMAGE, detections, table[:, :4], table[:, 4].astype(np.int64), ignored)


def test_correct_detections_are_no_errors() -> None:
    misses = WorstMisses()
    add(misses, found((0, 0, 50, 50, 0.9, 0)), (2, 2, 50, 50, 0))
    assert misses.counts == {"missed": 0, "imagined": 0}
    assert misses.sheet() is None


def test_wrong_class_position_or_confidence_is_an_error() -> None:
    misses = WorstMisses()
    add(
        misses,
        found((0, 0, 50, 50, 0.9, 1), (100, 0, 150, 50, 0.1, 0)),
        (0, 0, 50, 50, 0),
        (100, 0, 150, 50, 0),
    )
    assert misses.counts == {"missed": 2, "imagined": 1}
    assert misses.worst("imagined")[0].class_name == "dog"


def test_a_crowd_is_not_missed() -> None:
    misses = WorstMisses()
    add(misses, found(), (0, 0, 50, 50, 0), ignored=True)
    assert misses.counts["missed"] == 0


def test_worst_errors_of_each_kind_are_kept() -> None:
    misses = WorstMisses(keep=2)
    for size in (10, 40, 20, 30):
        add(misses, found((100, 50, 120, 70, size / 100 + 0.3, 0)), (0, 0, size, size, 0))
    assert [miss.box[2] for miss in misses.worst("missed")] == [40, 30]
    assert [round(miss.severity, 1) for miss in misses.worst("imagined")] == [0.7, 0.6]
    assert misses.counts == {"missed": 4, "imagined": 4}
    sheet = misses.sheet()
    assert sheet is not None
    assert sheet.dtype == np.uint8
    assert sheet.shape[1] == 6 * 168
