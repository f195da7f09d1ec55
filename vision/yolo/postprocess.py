"""From the network's raw maps to a short list of boxes: best class, class filter, threshold, suppression."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from vision.yolo.architecture import YoloModel
from vision.yolo.maps import Head, LevelMaps

MOST_BOXES = 300
# Up to so many boxes all pairs are compared at once; beyond, the table of pairs costs more than it saves.
_MOST_PAIRED = 512
# Below the threshold by this much a cell is still looked at: rounding must not decide in logit space.
_LOGIT_MARGIN = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class Boxes:
    """N boxes of one image, the most confident first.

    Attributes:
        xyxy: (N, 4) float32, pixels of the network's input.
        confidence: (N,) float32 in 0..1.
        class_id: (N,) int64.
    """

    xyxy: NDArray[np.float32]
    confidence: NDArray[np.float32]
    class_id: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.xyxy)

    def at(self, index: NDArray[np.int64]) -> Boxes:
        """Those at `index`, in its order."""
        return Boxes(self.xyxy[index], self.confidence[index], self.class_id[index])


def select_boxes(
    model: YoloModel,
    maps: Sequence[Tensor],
    *,
    confidence: float = 0.25,
    iou: float = 0.7,
    class_ids: Sequence[int] | None = None,
    most: int = MOST_BOXES,
) -> Boxes:
    """One image's maps as the model gives them, (1, 4 · reg_max + classes, H, W) a level → its boxes."""
    sides = 4 * model.reg_max
    arrays = [level[0].detach().float().cpu().numpy() for level in maps]
    levels = [LevelMaps(array[:sides], array[sides:]) for array in arrays]
    return boxes_of(head_of(model), levels, confidence=confidence, iou=iou, class_ids=class_ids, most=most)


def head_of(model: YoloModel) -> Head:
    """How to read the maps of a whole model."""
    classes = len(model.class_names)
    return Head(tuple(model.strides), model.reg_max, model.end_to_end, classes, tuple(range(classes)))


def boxes_of(
    head: Head,
    levels: Sequence[LevelMaps],
    *,
    confidence: float = 0.25,
    iou: float = 0.7,
    class_ids: Sequence[int] | None = None,
    most: int = MOST_BOXES,
) -> Boxes:
    """One image's maps → its boxes.

    A cell speaks for its most probable class, of all that the model knows. Cells of other classes than
    `class_ids`, and those not above `confidence`, are dropped before anything is decoded; then each class
    suppresses its own overlaps.

    The one-to-one head (YOLOv10, Wang et al., 2024; YOLO26) has learnt to speak once an object: overlapping
    boxes are different objects. Its cells speak for every class above `confidence`, the `most` best pairs of
    cell and class are kept, and `iou` is of no consequence.

    Args:
        class_ids: None: all. Where the maps hold some classes alone, those must be among them.
    """
    candidates = _candidates(head, levels, confidence, class_ids)
    if head.end_to_end:
        order = np.argsort(-candidates.confidence, kind="stable")[:most]
        return candidates.at(order)
    return candidates.at(suppress(candidates.xyxy, candidates.confidence, candidates.class_id, iou, most))


def _candidates(
    head: Head, levels: Sequence[LevelMaps], confidence: float, class_ids: Sequence[int] | None
) -> Boxes:
    floor = _logit(confidence) - _LOGIT_MARGIN
    ids = np.asarray(head.class_ids, np.int64)
    wanted = None
    if class_ids is not None:
        wanted = np.zeros(head.class_count, np.bool_)
        wanted[list(class_ids)] = True
    boxes, scores, classes = [], [], []
    for number, (level, stride) in enumerate(zip(levels, head.strides, strict=True)):
        logits = level.classes.reshape(len(ids), -1)
        if head.end_to_end:
            cells, channel = _pairs_above(logits, floor)
        else:
            cells, channel = _best_above(logits, floor)
        if not len(cells):
            continue
        found = ids[channel]
        score = 1 / (1 + np.exp(-logits[channel, cells], dtype=np.float32))
        kept = score > confidence
        if wanted is not None:
            kept &= wanted[found]
        if head.rows is not None and level.features is not None and not head.end_to_end:
            # A class that nobody asked for may be the better one, and then the cell speaks for that.
            features = level.features.reshape(len(level.features), -1)[:, cells]
            kept &= np.isin(head.rows[number].best_class(features), ids)
        cells = cells[kept]
        boxes.append(_decode(level, cells, head.reg_max, stride))
        scores.append(score[kept])
        classes.append(found[kept])
    if not boxes:
        return Boxes(np.zeros((0, 4), np.float32), np.zeros(0, np.float32), np.zeros(0, np.int64))
    return Boxes(np.concatenate(boxes), np.concatenate(scores), np.concatenate(classes))


def _logit(probability: float) -> float:
    if probability <= 0:
        return -math.inf
    return math.inf if probability >= 1 else math.log(probability / (1 - probability))


def _best_above(logits: NDArray[np.float32], floor: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(K, N) logits → the cells whose largest is above `floor`, and which that is."""
    cells = np.flatnonzero(logits.max(axis=0) > floor)
    return cells, logits[:, cells].argmax(axis=0)


def _pairs_above(logits: NDArray[np.float32], floor: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(K, N) logits → every cell and channel above `floor`, cell by cell."""
    cells = np.flatnonzero(logits.max(axis=0) > floor)
    place, channel = (logits[:, cells].T > floor).nonzero()
    return cells[place], channel


def _decode(level: LevelMaps, cells: NDArray[np.int64], reg_max: int, stride: int) -> NDArray[np.float32]:
    """The boxes of some cells of a level → (N, 4) float32 xyxy in pixels of the input."""
    sides = level.sides.reshape(4 * reg_max, -1)[:, cells]
    if reg_max > 1:
        # The expected value of the distribution over the distances 0 … reg_max - 1 (Li et al., 2020).
        weights = sides.reshape(4, reg_max, -1)
        weights = np.exp(weights - weights.max(axis=1, keepdims=True))
        bins = np.arange(reg_max, dtype=np.float32)
        sides = np.einsum("sbn,b->sn", weights, bins) / weights.sum(axis=1)
    row, column = np.divmod(cells, level.sides.shape[2])
    x, y = column.astype(np.float32) + 0.5, row.astype(np.float32) + 0.5
    xyxy = np.stack((x - sides[0], y - sides[1], x + sides[2], y + sides[3]), axis=1)
    return (xyxy * np.float32(stride)).astype(np.float32, copy=False)


def suppress(
    xyxy: NDArray[Any],
    confidence: NDArray[Any],
    class_id: NDArray[Any],
    iou: float = 0.7,
    most: int = MOST_BOXES,
) -> NDArray[np.int64]:
    """Greedy non-maximum suppression within each class.

    A box falls when a more confident one of its class overlaps it by more than `iou`, intersection over
    union.

    Args:
        xyxy: (N, 4). confidence: (N,). class_id: (N,).
        most: how many boxes to keep at most.

    Returns:
        Indices of the kept boxes, the most confident first; of equals, the earlier.
    """
    order = np.argsort(-confidence, kind="stable")
    sides = np.asarray(xyxy, np.float64)[order].T
    area = (sides[2] - sides[0]).clip(0) * (sides[3] - sides[1]).clip(0)
    walk = _kept_by_pairs if len(order) <= _MOST_PAIRED else _kept_one_by_one
    return order[walk(sides, area, class_id[order], iou, most)]


def _kept_by_pairs(
    sides: NDArray[np.float64], area: NDArray[np.float64], classes: NDArray[Any], iou: float, most: int
) -> NDArray[np.int64]:
    left, top, right, bottom = sides
    width = np.minimum(right[:, None], right) - np.maximum(left[:, None], left)
    height = np.minimum(bottom[:, None], bottom) - np.maximum(top[:, None], top)
    common = width.clip(0) * height.clip(0)
    overlaps = common > iou * (area[:, None] + area - common)
    overlaps &= classes[:, None] == classes
    alive = np.ones(len(area), np.bool_)
    # Only a box that overlaps a later one can change anything.
    for index in np.flatnonzero(np.triu(overlaps, 1).any(axis=1)):
        if alive[index]:
            alive[index + 1 :] &= ~overlaps[index, index + 1 :]
    return np.flatnonzero(alive)[:most]


def _kept_one_by_one(
    sides: NDArray[np.float64], area: NDArray[np.float64], classes: NDArray[Any], iou: float, most: int
) -> NDArray[np.int64]:
    left, top, right, bottom = sides
    waiting = np.arange(len(area))
    kept: list[int] = []
    while len(waiting) and len(kept) < most:
        first, rest = waiting[0], waiting[1:]
        kept.append(int(first))
        width = np.minimum(right[first], right[rest]) - np.maximum(left[first], left[rest])
        height = np.minimum(bottom[first], bottom[rest]) - np.maximum(top[first], top[rest])
        common = width.clip(0) * height.clip(0)
        overlaps = common > iou * (area[first] + area[rest] - common)
        waiting = rest[~(overlaps & (classes[rest] == classes[first]))]
    return np.array(kept, dtype=np.int64)
