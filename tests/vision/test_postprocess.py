"""From raw outputs to a short list of boxes."""

from __future__ import annotations

from typing import Literal
from unittest import mock

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from tests.vision.dense_decoding import decoded
from vision.training.published import yolov8_description
from vision.yolo import postprocess
from vision.yolo.architecture import YoloModel, build
from vision.yolo.level_outputs import ClassRows, Head, LevelOutput
from vision.yolo.postprocess import boxes_of, candidates_of, select_boxes, suppress

NAMES = ("car", "dog", "boat")


@pytest.fixture(scope="module")
def model() -> YoloModel:
    return build(yolov8_description((0.1, 0.01, 64), NAMES)).eval()


def empty_maps() -> list[Tensor]:
    """Outputs for a 64 × 96 input without any detection."""
    maps = [torch.full((1, 64 + 3, 64 // stride, 96 // stride), -40.0) for stride in (8, 16, 32)]
    for level in maps:
        level[:, :64] = 0
    return maps


def put(maps: list[Tensor], level: int, x: int, y: int, bins: tuple[int, ...], **logits: float) -> None:
    """An object predicted by one cell: its sides at whole bins, its class logits by name."""
    cell = maps[level][0, :, y, x]
    cell[:64] = -40.0
    for side, number in enumerate(bins):
        cell[side * 16 + number] = 40.0
    for name, logit in logits.items():
        cell[64 + NAMES.index(name)] = logit


def test_no_activation_gives_no_boxes(model: YoloModel) -> None:
    boxes = select_boxes(model, empty_maps())
    assert len(boxes) == 0
    assert boxes.xyxy.shape == (0, 4)


def test_one_cell_gives_its_box_in_pixels(model: YoloModel) -> None:
    maps = empty_maps()
    put(maps, 1, 2, 1, (1, 0, 2, 1), dog=2.0)
    boxes = select_boxes(model, maps)
    np.testing.assert_allclose(boxes.xyxy, [[1.5 * 16, 1.5 * 16, 4.5 * 16, 2.5 * 16]], atol=1e-3)
    assert boxes.class_id.tolist() == [1]
    assert boxes.confidence[0] == pytest.approx(1 / (1 + np.exp(-2.0)), abs=1e-6)


def test_the_same_boxes_come_from_the_dense_decoding(model: YoloModel) -> None:
    generator = torch.Generator().manual_seed(3)
    maps = [torch.randn(level.shape, generator=generator) for level in empty_maps()]
    boxes = select_boxes(model, maps, confidence=0.0, iou=1.0, most=10_000)
    dense = decoded(model, maps)[0]
    best, best_class = dense[:, 4:].max(dim=1)
    order = best.argsort(descending=True, stable=True)
    np.testing.assert_allclose(boxes.xyxy, dense[order, :4], atol=1e-3)
    np.testing.assert_allclose(boxes.confidence, best[order], atol=1e-6)
    assert boxes.class_id.tolist() == best_class[order].tolist()


def test_two_cells_of_one_object_become_one_box(model: YoloModel) -> None:
    maps = empty_maps()
    put(maps, 0, 4, 3, (2, 2, 2, 2), car=3.0)
    put(maps, 0, 5, 3, (3, 2, 1, 2), car=2.0)
    boxes = select_boxes(model, maps)
    assert len(boxes) == 1
    assert boxes.confidence[0] == pytest.approx(1 / (1 + np.exp(-3.0)))


def test_objects_of_two_classes_do_not_suppress_each_other(model: YoloModel) -> None:
    maps = empty_maps()
    put(maps, 0, 4, 3, (2, 2, 2, 2), car=3.0)
    put(maps, 0, 5, 3, (3, 2, 1, 2), dog=2.0)
    assert select_boxes(model, maps).class_id.tolist() == [0, 1]


def test_classes_are_filtered_before_the_limit_on_boxes(model: YoloModel) -> None:
    maps = empty_maps()
    for x in range(12):
        put(maps, 0, x, 0, (0, 0, 0, 0), car=5.0)
    put(maps, 0, 4, 5, (1, 1, 1, 1), boat=0.0)
    assert select_boxes(model, maps, most=3, class_ids=[2]).class_id.tolist() == [2]
    assert select_boxes(model, maps, most=3).class_id.tolist() == [0, 0, 0]


def test_cell_predicts_only_its_most_probable_class(model: YoloModel) -> None:
    maps = empty_maps()
    put(maps, 0, 4, 3, (2, 2, 2, 2), car=3.0, dog=2.0)
    assert len(select_boxes(model, maps, class_ids=[1])) == 0
    assert select_boxes(model, maps).class_id.tolist() == [0]


def test_a_box_must_be_above_the_confidence(model: YoloModel) -> None:
    maps = empty_maps()
    put(maps, 0, 4, 3, (2, 2, 2, 2), car=0.0)
    assert len(select_boxes(model, maps, confidence=0.49)) == 1
    assert len(select_boxes(model, maps, confidence=0.5)) == 0


def test_one_to_one_head_predicts_every_class_without_nms() -> None:
    head = Head((8,), 1, True, 3, (0, 1, 2))
    classes = np.full((3, 4, 4), -9.0, np.float32)
    classes[0, 1, 1], classes[2, 1, 1], classes[0, 1, 2] = 3.0, 1.0, 2.0
    sides = np.full((4, 4, 4), 1.5, np.float32)
    boxes = boxes_of(head, [LevelOutput(classes=classes, sides=sides)], iou=0.1)
    assert boxes.class_id.tolist() == [0, 0, 2]
    np.testing.assert_allclose(boxes.xyxy[0], [0, 0, 24, 24])
    np.testing.assert_allclose(boxes.xyxy[2], boxes.xyxy[0])
    assert boxes_of(head, [LevelOutput(classes=classes, sides=sides)], most=2).class_id.tolist() == [0, 0]
    only = boxes_of(head, [LevelOutput(classes=classes, sides=sides)], class_ids=[2])
    assert only.class_id.tolist() == [2]


@given(
    seed=st.integers(0, 2**32 - 1),
    classes=st.integers(1, 7),
    wanted=st.sets(st.integers(0, 6), min_size=1),
    confidence=st.sampled_from([0.0, 0.1, 0.5, 0.9, 1.0]),
)
def test_computing_some_classes_equals_filtering_afterwards(
    seed: int, classes: int, wanted: set[int], confidence: float
) -> None:
    """Integers, so that logits are exact and ties between classes are frequent."""
    random = np.random.default_rng(seed)
    ids = sorted(index for index in wanted if index < classes) or [0]
    # Few distinct rows: some classes have identical weights.
    weight = random.integers(-2, 3, (3, 4))[random.integers(0, 3, classes)].astype(np.float32)
    bias = random.integers(-1, 2, classes).astype(np.float32)
    features = random.integers(-2, 3, (4, 5, 6)).astype(np.float32)
    sides = random.random((4, 5, 6), np.float32)
    logits = np.einsum("cf,fhw->chw", weight, features) + bias[:, None, None]
    whole = Head((8,), 1, False, classes, tuple(range(classes)))
    rows = (ClassRows.distinct(weight, bias),) if len(ids) < classes else None
    sliced = Head((8,), 1, False, classes, tuple(ids), rows)
    (expected,) = candidates_of(whole, [LevelOutput(classes=logits, sides=sides)], confidence, ids)
    maps = LevelOutput(classes=logits[ids], sides=sides, features=features if rows else None)
    (found,) = candidates_of(sliced, [maps], confidence, ids)
    assert found.cell.tolist() == expected.cell.tolist()
    assert found.class_id.tolist() == expected.class_id.tolist()
    assert found.confidence.tolist() == expected.confidence.tolist()


@pytest.mark.parametrize("order", ["C", "F"])
def test_memory_order_of_the_outputs_does_not_matter(order: Literal["C", "F"]) -> None:
    random = np.random.default_rng(0)
    classes, sides = random.normal(size=(5, 6, 7)), random.normal(size=(64, 6, 7))
    head = Head((8,), 16, False, 5, tuple(range(5)))
    plain = boxes_of(head, [LevelOutput(classes=classes.astype(np.float32), sides=sides.astype(np.float32))])
    # Channels last in memory, as torch gives them.
    moved = [
        np.array(a.transpose(1, 2, 0), np.float32, order=order).transpose(2, 0, 1) for a in (classes, sides)
    ]
    again = boxes_of(head, [LevelOutput(classes=moved[0], sides=moved[1])])
    np.testing.assert_allclose(again.xyxy, plain.xyxy, atol=1e-4)
    assert again.class_id.tolist() == plain.class_id.tolist()


BOXES = st.lists(
    st.tuples(
        st.integers(0, 60),
        st.integers(0, 60),
        st.integers(1, 40),
        st.integers(1, 40),
        st.integers(1, 100),
        st.integers(0, 2),
    ),
    max_size=40,
)


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    width = min(a[2], b[2]) - max(a[0], b[0])
    height = min(a[3], b[3]) - max(a[1], b[1])
    common = max(width, 0) * max(height, 0)
    return float(common / ((a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - common))


@pytest.mark.parametrize("paired", [512, 0], ids=["all pairs at once", "one by one"])
@given(boxes=BOXES, iou=st.sampled_from([0.0, 0.3, 0.5, 0.7, 1.0]), most=st.integers(1, 50))
def test_suppression_matches_its_definition(
    paired: int, boxes: list[tuple[int, ...]], iou: float, most: int
) -> None:
    table = np.array(boxes, np.float64).reshape(-1, 6)
    xyxy = np.column_stack([table[:, :2], table[:, :2] + table[:, 2:4]])
    confidence, class_id = table[:, 4] / 100, table[:, 5].astype(np.int64)
    expected: list[int] = []
    for index in sorted(range(len(boxes)), key=lambda i: -confidence[i]):
        rivals = (kept for kept in expected if class_id[kept] == class_id[index])
        if len(expected) < most and all(overlap(xyxy[kept], xyxy[index]) <= iou for kept in rivals):
            expected.append(index)
    with mock.patch.object(postprocess, "_MOST_PAIRED", paired):
        assert suppress(xyxy, confidence, class_id, iou, most).tolist() == expected


def test_boxes_without_area_do_not_break_the_suppression() -> None:
    point = np.zeros((3, 4), np.float32)
    assert suppress(point, np.array([0.5, 0.9, 0.7]), np.zeros(3, np.int64)).tolist() == [1, 2, 0]
