"""Appearance of boxes, and what the tracker does with it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from vision.detections import Detections
from vision.tracking import Tracker
from vision.tracking.appearance import appearances
from vision.tracking.byte_track import MIN_LOOK_PX, MOST_LOOKS, _looks

RED, BLUE = (30, 30, 160), (160, 50, 25)
FRAME_NS = 50_000_000


def image_of(colour: tuple[int, int, int], left: int = 100, side: int = 120) -> NDArray[np.uint8]:
    """A striped square on noise."""
    image = np.random.default_rng(1).integers(80, 140, (300, 400, 3), np.uint8)
    image[60 : 60 + side, left : left + side] = colour
    image[60 : 60 + side // 3, left : left + side] = 20
    return image


def box(left: int = 100, side: int = 120) -> NDArray[np.float32]:
    return np.array([[left, 60, left + side, 60 + side]], np.float32)


def seen(boxes: NDArray[np.float32]) -> Detections:
    count = len(boxes)
    return Detections(boxes, np.full(count, 0.8, np.float32), np.zeros(count, np.int64), ("car",))


def similarity(one: NDArray[np.uint8], other: NDArray[np.uint8]) -> float:
    return float(appearances(one, box())[0] @ appearances(other, box())[0])


def test_an_appearance_is_a_unit_vector_whatever_the_boxes_size() -> None:
    image = image_of(RED)
    boxes = np.array([(0, 0, 400, 300), (10, 10, 11, 11), (-50, -50, 30, 30), (5, 5, 5, 5)], np.float32)
    found = appearances(image, boxes)
    assert found.shape == (4, 60)
    assert found.dtype == np.float32
    assert np.linalg.norm(found, axis=1) == pytest.approx([1.0] * 4, abs=1e-5)
    assert appearances(image, boxes[:0]).shape == (0, 60)


def test_same_object_is_alike_and_another_colour_is_not() -> None:
    same = image_of(RED)
    assert similarity(same, same) == pytest.approx(1.0, abs=1e-5)
    assert similarity(same, np.asarray(cv2.GaussianBlur(same, (9, 9), 3), np.uint8)) > 0.97
    assert similarity(same, image_of(RED, left=106)) > 0.95
    for gain in (0.7, 0.8, 1.25):
        assert similarity(same, np.asarray(same * gain, np.uint8)) > 0.95
    for blue in (0.9, 1.1):
        assert similarity(same, np.asarray(same * [blue, 1.0, 1 / blue], np.uint8)) > 0.95
    assert similarity(same, image_of(BLUE)) < 0.8


def test_other_object_at_predicted_position_gets_a_new_track() -> None:
    tracker = Tracker()
    ids = []
    for frame in range(12):
        gap = 6 <= frame < 9
        image = image_of(RED if frame < 6 else BLUE)
        found = seen(np.zeros((0, 4), np.float32) if gap else box())
        shown = tracker.update(found, frame * FRAME_NS + 1, image=image).detections
        ids.append(None if gap or shown.track_id is None else int(shown.track_id[0]))
    assert ids == [1] * 6 + [None] * 3 + [2] * 3


def test_the_same_object_continues_its_track_after_a_gap() -> None:
    tracker = Tracker()
    for frame in range(12):
        found = seen(np.zeros((0, 4), np.float32) if 6 <= frame < 9 else box())
        shown = tracker.update(found, frame * FRAME_NS + 1, image=image_of(RED)).detections
    assert shown.track_id is not None
    assert shown.track_id.tolist() == [1]


def test_object_that_changes_its_look_without_a_gap_keeps_track() -> None:
    tracker = Tracker()
    for frame in range(8):
        image = image_of(RED if frame < 4 else BLUE)
        shown = tracker.update(seen(box()), frame * FRAME_NS + 1, image=image).detections
    assert shown.track_id is not None
    assert shown.track_id.tolist() == [1]


def test_other_object_after_one_missed_frame_continues_track() -> None:
    tracker = Tracker()
    for frame in range(8):
        found = seen(np.zeros((0, 4), np.float32) if frame == 4 else box())
        image = image_of(RED if frame < 4 else BLUE)
        shown = tracker.update(found, frame * FRAME_NS + 1, image=image).detections
    assert shown.track_id is not None
    assert shown.track_id.tolist() == [1]


def test_small_boxes_are_matched_without_appearance() -> None:
    tracker = Tracker()
    for frame in range(8):
        image = image_of(RED if frame < 4 else BLUE, side=30)
        found = seen(np.zeros((0, 4), np.float32) if frame == 4 else box(side=30))
        shown = tracker.update(found, frame * FRAME_NS + 1, image=image).detections
    assert shown.track_id is not None
    assert shown.track_id.tolist() == [1]


def test_appearance_is_of_the_largest_boxes_of_a_crowd() -> None:
    sides = MIN_LOOK_PX - 1 + np.random.default_rng(0).permutation(2 * MOST_LOOKS)
    boxes = np.concatenate([box(side=int(side)) for side in sides])
    looks = _looks(image_of(RED), seen(boxes))
    assert set(looks) == set(np.argsort(-sides)[:MOST_LOOKS].tolist())
    for index, look in looks.items():
        np.testing.assert_array_equal(look, appearances(image_of(RED), boxes[[index]])[0])
    few = _looks(image_of(RED), seen(boxes[sides <= MIN_LOOK_PX + 1]))
    assert len(few) == 2  # The third is too small.
