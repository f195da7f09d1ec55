"""Fine-tuning: added classes, training images from labelled files, objects of classes without labels."""

from __future__ import annotations

import pickle
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from vision.detections import Detections
from vision.evaluation.datasets import Dataset, Sample
from vision.training.fine_tuning import LabelledScenes, TrainingImage, extend_classes, training_images
from vision.training.published import published_description
from vision.yolo.architecture import YoloModel, build

NAMES = ("person", "traffic light")
RED, GREEN = (0, 0, 255), (0, 255, 0)


def model(family: str = "YOLOv8") -> YoloModel:
    torch.manual_seed(1)
    return build(published_description(family, "n", NAMES)).eval()


@pytest.mark.parametrize("family", ["YOLOv8", "YOLO11"])
def test_added_classes_leave_the_others_unchanged(family: str) -> None:
    start = model(family)
    extended = extend_classes(start, ("Traffic_Light", "drone", "drone")).eval()
    assert extended.class_names == ("person", "traffic light", "drone")
    image = torch.rand(1, 3, 64, 64)
    with torch.inference_mode():
        for before, after in zip(start(image), extended(image), strict=True):
            assert after.shape[1] == before.shape[1] + 1
            torch.testing.assert_close(after[:, :-1], before)
            assert (after[:, -1].sigmoid() < 0.1).all()
    # Nothing to add, and again: the width of the class branches does not follow the number of classes.
    assert extend_classes(extended, ()).class_names == extended.class_names
    assert len(extend_classes(extended, [str(n) for n in range(90)]).class_names) == 93


@pytest.mark.parametrize("family", ["YOLOv10", "YOLO26"])
def test_end_to_end_networks_are_refused_by_family(family: str) -> None:
    with pytest.raises(ValueError, match=rf"{family} .*YOLOv8 or YOLO11"):
        extend_classes(model(family), ("drone",))


def write_image(path: Path, width: int = 200, height: int = 100) -> Path:
    """Grey, with a red rectangle from (20, 30) to (60, 70) and a green one from (120, 10) to (180, 90)."""
    image = np.full((height, width, 3), 114, np.uint8)
    image[30:70, 20:60] = RED
    image[10:90, 120:180] = GREEN
    assert cv2.imwrite(str(path), image)
    return path


BOXES = np.array([[20, 30, 60, 70], [120, 10, 180, 90]], np.float32)


def numbered(tmp_path: Path, names: tuple[str, ...], sample: Sample) -> TrainingImage:
    """The only image of a data set; the starting model finds four objects in it."""
    found = Detections(
        np.array([[20, 30, 60, 72], [100, 0, 119, 9], [0, 0, 9, 9], [0, 80, 9, 89]], np.float32),
        np.array([0.9, 0.8, 0.7, 0.2], np.float32),
        np.array([1, 0, 1, 1]),
        NAMES,
    )
    (image,) = training_images(
        Dataset(tmp_path, "YOLO", names, (sample,)), (*NAMES, "drone"), lambda _image: found
    )
    return image


def test_unlabelled_classes_are_labelled_by_the_starting_model(tmp_path: Path) -> None:
    sample = Sample(write_image(tmp_path / "a.png"), BOXES, np.array([1, 0]), ignored=np.array([False, True]))
    image = numbered(tmp_path, ("person", "Drone"), sample)
    # Not the person, a class with labels, and not the traffic light where a drone is labelled.
    assert image.class_ids.tolist() == [2, ~0, 1, ~1]
    assert image.boxes[2:].tolist() == [[0, 0, 9, 9], [0, 80, 9, 89]]


def test_labels_of_all_classes_are_used_as_they_are(tmp_path: Path) -> None:
    boxes = np.array([[0.1, 0.3, 0.3, 0.7], [0.6, 0.1, 0.9, 0.9], [0, 0, 0.1, 0.1]], np.float32)
    sample = Sample(write_image(tmp_path / "a.png"), boxes, np.array([0, 1, 2]), in_fractions=True)
    image = numbered(tmp_path, ("drone", "traffic_light", "person"), sample)
    assert image.class_ids.tolist() == [2, 1, 0]
    assert image.boxes[:2] == pytest.approx(BOXES, abs=1e-4)


def shown(image: NDArray[np.uint8], colour: tuple[int, int, int], box: NDArray[np.float32]) -> float:
    """Share of a box's pixels that have nearly this colour."""
    left, top, right, bottom = box.round().astype(int)
    inside = image[top:bottom, left:right].astype(int) - colour
    return float((np.abs(inside).max(axis=2) < 60).mean())


def test_boxes_fit_their_objects_in_single_images_and_mosaics(tmp_path: Path) -> None:
    item = TrainingImage(write_image(tmp_path / "a.png"), BOXES, np.array([0, 1]))
    scenes = LabelledScenes([item, item], known=2)
    counts = []
    for seed in range(30):
        image, boxes, ids = scenes(np.random.default_rng(seed), 160, 128)
        assert image.shape == (128, 160, 3)
        assert (boxes[:, 2:] <= (160, 128)).all()
        for box, class_id in zip(boxes, ids, strict=True):
            if class_id >= 0:
                assert shown(image, (RED, GREEN)[class_id], box) > 0.75
        counts.append(len(ids))
        again = pickle.loads(pickle.dumps(scenes))(np.random.default_rng(seed), 160, 128)
        assert np.array_equal(image, again[0])
    assert counts.count(2) >= 8
    assert max(counts) > 3


def test_half_of_the_images_show_a_new_class(tmp_path: Path) -> None:
    path = write_image(tmp_path / "a.png")
    images = [TrainingImage(path, BOXES[:1], np.array([number == 0])) for number in range(20)]
    rng = np.random.default_rng(0)

    def share(known: int) -> float:
        scenes = LabelledScenes(images, known)
        return float(np.mean(np.concatenate([scenes(rng, 64, 64)[2] == 1 for _ in range(60)])))

    assert share(known=1) > 0.4
    assert share(known=2) < 0.2
