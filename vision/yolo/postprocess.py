"""Decoding of raw outputs to boxes: best class, class filter, threshold, suppression."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vision.yolo.level_outputs import Head, LevelOutput, Product

if TYPE_CHECKING:
    from torch import Tensor

    from vision.yolo.architecture import YoloModel

MOST_BOXES = 300
# Up to this many boxes all pairs are compared at once; beyond, the table of pairs is slower.
_MOST_PAIRED = 512
# Cells below the threshold by this much are still considered: rounding in logit space must not decide.
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


def select_boxes(
    model: YoloModel,
    outputs: Sequence[Tensor],
    *,
    confidence: float = 0.25,
    iou: float = 0.7,
    class_ids: Sequence[int] | None = None,
    most: int = MOST_BOXES,
) -> Boxes:
    """One image's model outputs, (1, 4 · reg_max + classes, H, W) per level → its boxes."""
    sides = 4 * model.reg_max
    arrays = [level[0].detach().float().cpu().numpy() for level in outputs]
    levels = [LevelOutput(classes=array[sides:], sides=array[:sides]) for array in arrays]
    return boxes_of(head_of(model), levels, confidence=confidence, iou=iou, class_ids=class_ids, most=most)


def head_of(model: YoloModel) -> Head:
    """The output layout of a complete model."""
    classes = len(model.class_names)
    return Head(tuple(model.strides), model.reg_max, model.end_to_end, classes, tuple(range(classes)))


def boxes_of(
    head: Head,
    levels: Sequence[LevelOutput],
    *,
    confidence: float = 0.25,
    iou: float = 0.7,
    class_ids: Sequence[int] | None = None,
    most: int = MOST_BOXES,
) -> Boxes:
    """One image's outputs → its boxes: `candidates_of`, `decode_ltrb` and `boxes_from` in sequence."""
    candidates = candidates_of(head, levels, confidence, class_ids)
    return boxes_from(head, levels, candidates, decode_ltrb(head, levels, candidates), iou, most)


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """The cells of one level that may become boxes.

    Attributes:
        cell: (N,) int64, row-major index.
        confidence: (N,) float32 in 0..1.
        class_id: (N,) int64.
    """

    cell: NDArray[np.int64]
    confidence: NDArray[np.float32]
    class_id: NDArray[np.int64]


def candidates_of(
    head: Head, levels: Sequence[LevelOutput], confidence: float, class_ids: Sequence[int] | None = None
) -> list[Candidates]:
    """The cells of each level that predict a wanted class above `confidence`.

    A cell predicts its most probable class, among all classes of the model. In a one-to-one head (YOLOv10,
    Wang et al., 2024; YOLO26), which predicts each object once, it predicts every class above the threshold.

    Args:
        class_ids: None: all. If the outputs contain only some classes, these must be among them.
    """
    floor = _logit(confidence) - _LOGIT_MARGIN
    ids = np.asarray(head.class_ids, np.int64)
    wanted = None
    if class_ids is not None:
        wanted = np.zeros(head.class_count, np.bool_)
        wanted[list(class_ids)] = True
    found = []
    for number, level in enumerate(levels):
        logits = level.classes.reshape(len(ids), -1)
        cells, channel = (_pairs_above if head.end_to_end else _best_above)(logits, floor)
        class_id = ids[channel]
        score = (1 / (1 + np.exp(-logits[channel, cells]))).astype(np.float32, copy=False)
        kept = score > confidence
        if wanted is not None:
            kept &= wanted[class_id]
        if head.rows is not None and level.features is not None and len(cells):
            # Another class may have a higher score; then the cell does not predict a wanted one.
            features = level.features.reshape(len(level.features), -1)[:, cells]
            kept &= np.isin(head.rows[number].best_class(features), ids)
        found.append(Candidates(cells[kept], score[kept], class_id[kept]))
    return found


def decode_ltrb(
    head: Head, levels: Sequence[LevelOutput], candidates: Sequence[Candidates], product: Product = np.matmul
) -> list[NDArray[np.float32]]:
    """Each level's (4 · reg_max, N) raw box sides at its N candidates, computed from the neck if necessary.

    Args:
        product: matrix product for this computation.
    """
    found = []
    for number, (level, some) in enumerate(zip(levels, candidates, strict=True)):
        if level.sides is not None:
            found.append(level.sides.reshape(len(level.sides), -1)[:, some.cell])
            continue
        if head.boxes is None or level.neck is None:
            raise ValueError("outputs without box sides need the neck and the head's box branches")
        # A cell of a one-to-one head may occur several times, for several classes.
        cells, back = np.unique(some.cell, return_inverse=True)
        found.append(head.boxes[number].sides(level.neck, cells, product)[:, back])
    return found


def boxes_from(
    head: Head,
    levels: Sequence[LevelOutput],
    candidates: Sequence[Candidates],
    sides: Sequence[NDArray[np.float32]],
    iou: float = 0.7,
    most: int = MOST_BOXES,
) -> Boxes:
    """Decode the candidates, apply NMS per class, and keep the `most` confident.

    In a one-to-one head overlapping boxes are different objects; NMS is not applied.
    """
    xyxy = np.concatenate(
        [
            _decode(raw, some.cell, level.classes.shape[2], head.reg_max, stride)
            for level, some, raw, stride in zip(levels, candidates, sides, head.strides, strict=True)
        ]
    )
    confidence = np.concatenate([some.confidence for some in candidates])
    class_id = np.concatenate([some.class_id for some in candidates])
    if head.end_to_end:
        kept = np.argsort(-confidence, kind="stable")[:most]
    else:
        kept = suppress(xyxy, confidence, class_id, iou, most)
    return Boxes(xyxy[kept], confidence[kept], class_id[kept])


def _logit(probability: float) -> float:
    if probability <= 0:
        return -math.inf
    return math.inf if probability >= 1 else math.log(probability / (1 - probability))


def _best_above(logits: NDArray[np.float32], floor: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(K, N) logits → the cells whose largest logit is above `floor`, and its index."""
    cells = _cells_above(logits, floor)
    return cells, logits[:, cells].argmax(axis=0)


def _pairs_above(logits: NDArray[np.float32], floor: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(K, N) logits → every cell and channel above `floor`, cell by cell."""
    cells = _cells_above(logits, floor)
    row, channel = (logits[:, cells].T > floor).nonzero()
    return cells[row], channel


def _cells_above(logits: NDArray[np.float32], floor: float) -> NDArray[np.int64]:
    """(K, N) logits → the cells with any logit above `floor`, ascending.

    If there are few, scanning in memory order is fastest.
    """
    by_cell = logits.T
    if floor == -math.inf or len(logits) == 1 or not by_cell.flags.c_contiguous:
        return np.flatnonzero(logits.max(axis=0) > floor)
    above = np.flatnonzero((by_cell > floor).ravel()) // len(logits)
    return above[np.flatnonzero(np.diff(above, prepend=-1))]


def _decode(
    sides: NDArray[np.float32], cells: NDArray[np.int64], width: int, reg_max: int, stride: int
) -> NDArray[np.float32]:
    """(4 · reg_max, N) raw sides of N cells of a level → (N, 4) float32 xyxy in pixels of the input."""
    if reg_max > 1:
        # The expected value of the distribution over the distances 0 … reg_max - 1 (Li et al., 2020).
        weights = sides.reshape(4, reg_max, -1)
        weights = np.exp(weights - weights.max(axis=1, keepdims=True))
        bins = np.arange(reg_max, dtype=np.float32)
        sides = np.einsum("sbn,b->sn", weights, bins) / weights.sum(axis=1)
    row, column = np.divmod(cells, width)
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

    A box is dropped if a more confident one of its class overlaps it by more than `iou`, intersection over
    union.

    Args:
        xyxy: (N, 4). confidence: (N,). class_id: (N,).
        most: largest number of boxes to keep.

    Returns:
        Indices of the kept boxes, most confident first; of equals, the earlier first.
    """
    order = np.argsort(-confidence, kind="stable")
    sides = np.asarray(xyxy, np.float64)[order].T
    area = (sides[2] - sides[0]).clip(0) * (sides[3] - sides[1]).clip(0)
    nms = _nms_pairwise if len(order) <= _MOST_PAIRED else _nms_sequential
    return order[nms(sides, area, class_id[order], iou, most)]


def _nms_pairwise(
    sides: NDArray[np.float64], area: NDArray[np.float64], classes: NDArray[Any], iou: float, most: int
) -> NDArray[np.int64]:
    left, top, right, bottom = sides
    width = np.minimum(right[:, None], right) - np.maximum(left[:, None], left)
    height = np.minimum(bottom[:, None], bottom) - np.maximum(top[:, None], top)
    common = width.clip(0) * height.clip(0)
    overlaps = common > iou * (area[:, None] + area - common)
    overlaps &= classes[:, None] == classes
    alive = np.ones(len(area), np.bool_)
    # Only a box that overlaps a later one matters.
    for index in np.flatnonzero(np.triu(overlaps, 1).any(axis=1)):
        if alive[index]:
            alive[index + 1 :] &= ~overlaps[index, index + 1 :]
    return np.flatnonzero(alive)[:most]


def _nms_sequential(
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
