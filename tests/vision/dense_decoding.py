"""Every cell of raw outputs as a box, decoded by torch: the reference of `vision.yolo.postprocess`."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from vision.training.losses import cell_grid
from vision.yolo.architecture import YoloModel


def decoded(model: YoloModel, maps: Sequence[Tensor]) -> Tensor:
    """Raw outputs → (B, N, 4 + classes): xyxy in pixels of the network's input, then scores in 0..1."""
    flat = torch.cat([level.flatten(2) for level in maps], dim=2).transpose(1, 2)
    sides, logits = torch.split(flat, [4 * model.reg_max, len(model.class_names)], dim=2)
    centres, strides = cell_grid([(level.shape[2], level.shape[3]) for level in maps], model.strides)
    distances = model.detect.dfl(sides) * strides[:, None]
    return torch.cat((centres - distances[..., :2], centres + distances[..., 2:], logits.sigmoid()), dim=2)
