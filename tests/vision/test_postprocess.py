"""From raw maps to a short list of boxes."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from vision.yolo.architecture import YoloModel, build, yolov8_description
from vision.yolo.postprocess import select_boxes, suppress

NAMES = ("car", "dog", "boat")


@pytest.fixture(scope="module")
def model() -> YoloModel:
    return build(yolov8_description((0.1, 0.01, 64), NAMES)).eval()


def empty_maps() -> list[Tensor]:
    """Maps of a 64 × 96 input in which nothing is seen."""
    maps = [torch.full((1, 64 + 3, 64 // stride, 96 // stride), -40.0) for stride in (8, 16, 32)]
    for level in maps:
        level[:, :64] = 0
    return maps


def put(maps: list[Tensor], level: int, x: int, y: int, bins: tuple[int, ...], **logits: float) -> None:
    """An object seen by one cell: its sides at whole bins, its class logits by name."""
    cell = maps[level][0, :, y, x]
    cell[:64] = -40.0
    for side, number in enumerate(bins):
        cell[side * 16 + number] = 40.0
    for name, logit in logits.items():
        cell[64 + NAMES.index(name)] = logit


def test_nothing_seen_gives_no_boxes(model: YoloModel) -> None:
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
    dense = model.decode(maps)[0]
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


def test_a_cell_speaks_for_its_most_probable_class_only(model: YoloModel) -> None:
    maps = empty_maps()
    put(maps, 0, 4, 3, (2, 2, 2, 2), car=3.0, dog=2.0)
    assert len(select_boxes(model, maps, class_ids=[1])) == 0
    assert select_boxes(model, maps).class_id.tolist() == [0]


def test_a_box_must_be_above_the_confidence(model: YoloModel) -> None:
    maps = empty_maps()
    put(maps, 0, 4, 3, (2, 2, 2, 2), car=0.0)
    assert len(select_boxes(model, maps, confidence=0.49)) == 1
    assert len(select_boxes(model, maps, confidence=0.5)) == 0


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
    return common / ((a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - common)


@given(boxes=BOXES, iou=st.sampled_from([0.0, 0.3, 0.5, 0.7, 1.0]), most=st.integers(1, 50))
def test_suppression_is_what_the_definition_says(boxes: list[tuple[int, ...]], iou: float, most: int) -> None:
    table = np.array(boxes, np.float64).reshape(-1, 6)
    xyxy = np.column_stack([table[:, :2], table[:, :2] + table[:, 2:4]])
    confidence, class_id = table[:, 4] / 100, table[:, 5].astype(np.int64)
    expected: list[int] = []
    for index in sorted(range(len(boxes)), key=lambda i: -confidence[i]):
        rivals = (kept for kept in expected if class_id[kept] == class_id[index])
        if len(expected) < most and all(overlap(xyxy[kept], xyxy[index]) <= iou for kept in rivals):
            expected.append(index)
    assert suppress(xyxy, confidence, class_id, iou, most).tolist() == expected


def test_boxes_without_area_do_not_break_the_suppression() -> None:
    point = np.zeros((3, 4), np.float32)
    assert suppress(point, np.array([0.5, 0.9, 0.7]), np.zeros(3, np.int64)).tolist() == [1, 2, 0]
