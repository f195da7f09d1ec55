"""From the network's raw maps to a short list of boxes: best class, class filter, threshold, suppression."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vision.yolo.architecture import YoloModel, decode_boxes
from vision.yolo.end_to_end import best_pairs

MOST_BOXES = 300


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
    maps: Sequence[Tensor],
    *,
    confidence: float = 0.25,
    iou: float = 0.7,
    class_ids: Sequence[int] | None = None,
    most: int = MOST_BOXES,
) -> Boxes:
    """One image's maps, (1, 4 · reg_max + classes, H, W) a level → its boxes.

    A cell speaks for its most probable class. Cells of other classes than `class_ids`, and those not above
    `confidence`, are dropped before anything is decoded; then each class suppresses its own overlaps. The
    boxes of an end-to-end head are selected instead (`best_pairs`); `iou` is of no consequence to it.
    """
    if model.end_to_end:
        xyxy, scores, classes = best_pairs(model, maps, confidence=confidence, class_ids=class_ids, most=most)
        return Boxes(xyxy.cpu().numpy(), scores.cpu().numpy(), classes.cpu().numpy())
    candidates = _candidates(model, maps, confidence, class_ids)
    kept = suppress(candidates.xyxy, candidates.confidence, candidates.class_id, iou, most)
    return Boxes(candidates.xyxy[kept], candidates.confidence[kept], candidates.class_id[kept])


def _candidates(
    model: YoloModel, maps: Sequence[Tensor], confidence: float, class_ids: Sequence[int] | None
) -> Boxes:
    side_channels = 4 * model.reg_max
    sides, centres, strides, scores, classes = [], [], [], [], []
    wanted = None
    if class_ids is not None:
        wanted = torch.zeros(len(model.class_names), dtype=torch.bool, device=maps[0].device)
        wanted[list(class_ids)] = True
    for level, stride in zip(maps, model.strides, strict=True):
        width = level.shape[3]
        cells = level[0].flatten(1)
        best, best_class = cells[side_channels:].max(dim=0)
        score = best.float().sigmoid_()
        above = score > confidence
        if wanted is not None:
            above &= wanted[best_class]
        index = above.nonzero().squeeze(1)
        # Most cells are background: only the few that remain are decoded.
        sides.append(cells[:side_channels, index].float().T)
        centres.append(torch.stack((index % width, index // width), dim=1) + 0.5)
        strides.append(torch.full((len(index), 1), float(stride), device=level.device))
        scores.append(score[index])
        classes.append(best_class[index])
    xyxy = decode_boxes(model.detect.dfl(torch.cat(sides)), torch.cat(centres), torch.cat(strides))
    return Boxes(
        xyxy.cpu().numpy().astype(np.float32, copy=False),
        torch.cat(scores).cpu().numpy(),
        torch.cat(classes).cpu().numpy().astype(np.int64, copy=False),
    )


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
    left, top, right, bottom = (np.asarray(side, np.float64)[order] for side in xyxy.T)
    area = (right - left).clip(0) * (bottom - top).clip(0)
    classes = class_id[order]
    waiting = np.arange(len(order))
    kept: list[int] = []
    while len(waiting) and len(kept) < most:
        first, rest = waiting[0], waiting[1:]
        kept.append(int(first))
        width = np.minimum(right[first], right[rest]) - np.maximum(left[first], left[rest])
        height = np.minimum(bottom[first], bottom[rest]) - np.maximum(top[first], top[rest])
        common = width.clip(0) * height.clip(0)
        overlaps = common > iou * (area[first] + area[rest] - common)
        waiting = rest[~(overlaps & (classes[rest] == classes[first]))]
    return order[np.array(kept, dtype=np.int64)]
