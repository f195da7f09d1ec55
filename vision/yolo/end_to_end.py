"""From an end-to-end head's raw maps to a short list of boxes: the best pairs of cell and class, no NMS.

The one-to-one head (YOLOv10, Wang et al., 2024) has learnt to speak once an object, so boxes that overlap are
different objects and are all kept.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from vision.yolo.architecture import YoloModel, decode_boxes


def best_pairs(
    model: YoloModel,
    maps: Sequence[Tensor],
    *,
    confidence: float,
    class_ids: Sequence[int] | None,
    most: int,
) -> tuple[Tensor, Tensor, Tensor]:
    """One image's maps, (1, 4 · reg_max + classes, H, W) a level → its boxes, the most confident first.

    The `most` cells of the highest score, in the best of the classes asked for, are looked at; of these the
    `most` best pairs of a cell and a class, so that one cell may give two boxes of different classes. Scores
    not above `confidence` are dropped.

    Returns:
        (N, 4) float32 xyxy in pixels of the network's input, (N,) float32 confidence, (N,) int64 class.
    """
    side_channels = 4 * model.reg_max
    sides, centres, strides, logits = [], [], [], []
    for level, stride in zip(maps, model.strides, strict=True):
        width = level.shape[3]
        cells = level[0].flatten(1)
        wanted = cells[side_channels:] if class_ids is None else cells[side_channels:][list(class_ids)]
        index = (wanted.amax(dim=0).float().sigmoid_() > confidence).nonzero().squeeze(1)
        sides.append(cells[:side_channels, index].float().T)
        logits.append(wanted[:, index].float().T)
        centres.append(torch.stack((index % width, index // width), dim=1) + 0.5)
        strides.append(torch.full((len(index), 1), float(stride), device=level.device))
    every = torch.cat(logits)
    cell = every.amax(dim=1).topk(min(most, len(every))).indices
    score, pair = every[cell].flatten().topk(min(most, len(cell) * every.shape[1]))
    score = score.sigmoid_()
    sure = score > confidence
    score, pair = score[sure], pair[sure]
    cell, class_id = cell[pair // every.shape[1]], pair % every.shape[1]
    if class_ids is not None:
        class_id = torch.tensor(list(class_ids), device=class_id.device)[class_id]
    xyxy = decode_boxes(
        model.detect.dfl(torch.cat(sides)[cell]), torch.cat(centres)[cell], torch.cat(strides)[cell]
    )
    return xyxy, score, class_id
