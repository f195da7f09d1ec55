"""The anchor-free heads: with and without distributions over the box sides, with and without NMS.

Attribute names (`cv2`, `cv3`, `one2one_cv2`, `dfl` …) are those of published checkpoints.

References: generalised focal loss, for the box sides as distributions (Li et al., 2020); consistent dual
assignments, for the end-to-end head (YOLOv10, Wang et al., 2024); focal loss, for the prior (Lin et al.,
2017).
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from vision.yolo.layers import Conv, DWConv


class DFL(nn.Module):
    """The expected value of a distribution over the distances 0 … bins - 1 (Li et al., 2020)."""

    def __init__(self, bins: int = 16) -> None:
        super().__init__()
        self.bins = bins
        self.conv = nn.Conv2d(bins, 1, 1, bias=False).requires_grad_(False)
        # On the CPU, whatever the default device: arange on the meta device makes torch import sympy.
        distances = torch.arange(bins, dtype=torch.float32, device="cpu")
        self.conv.weight.data.copy_(distances.view(1, bins, 1, 1))

    def forward(self, logits: Tensor) -> Tensor:
        """(…, 4 · bins) logits → (…, 4) distances, in cells, of left, top, right, bottom."""
        probabilities = logits.reshape(*logits.shape[:-1], 4, self.bins).softmax(dim=-1)
        distances: Tensor = probabilities @ self.conv.weight.view(self.bins).to(probabilities.dtype)
        return distances


class Detect(nn.Module):
    """The head: for each level box sides and class logits.

    A list of (B, C_i, H_i, W_i) → a list of (B, 4 · reg_max + classes, H_i, W_i). With `reg_max` 1 the first
    four channels are the distances themselves, in cells; otherwise `dfl` converts them to distances.

    An end-to-end head has every branch twice. The one-to-many branches learn from many cells per object, need
    NMS, and are used in training. The one-to-one branches predict each object once and are used in
    evaluation; `fuse` drops the others.

    Args:
        light: class branches of depthwise and 1×1 convolutions (YOLOv10, YOLO11 and later).
        class_width: channels within the class branches; None for the default.
    """

    def __init__(
        self,
        classes: int,
        inputs: Sequence[int],
        reg_max: int = 16,
        *,
        light: bool = False,
        end_to_end: bool = False,
        class_width: int | None = None,
    ) -> None:
        super().__init__()
        self.nc = classes
        self.reg_max = reg_max
        self.end_to_end = end_to_end
        self._fused = False
        box_width = max(16, inputs[0] // 4, 4 * reg_max)
        class_width = max(inputs[0], min(classes, 100)) if class_width is None else class_width
        class_branch = _light_branch if light else _branch
        self.cv2 = nn.ModuleList(_branch(channels, box_width, 4 * reg_max) for channels in inputs)
        self.cv3 = nn.ModuleList(class_branch(channels, class_width, classes) for channels in inputs)
        self.dfl = DFL(reg_max) if reg_max > 1 else nn.Identity()
        if end_to_end:
            self.one2one_cv2 = copy.deepcopy(self.cv2)
            self.one2one_cv3 = copy.deepcopy(self.cv3)

    @property
    def box_branches(self) -> nn.ModuleList:
        """The box branches used in evaluation, one per level."""
        return self.one2one_cv2 if self.end_to_end else self.cv2

    @property
    def class_branches(self) -> nn.ModuleList:
        """The class branches used in evaluation, one per level."""
        return self.one2one_cv3 if self.end_to_end else self.cv3

    def forward(self, maps: Sequence[Tensor]) -> list[Tensor]:
        if self.training and not self._fused:
            boxes, classes = self.cv2, self.cv3
        else:
            boxes, classes = self.box_branches, self.class_branches
        return [
            torch.cat((box(x), kind(x)), dim=1) for x, box, kind in zip(maps, boxes, classes, strict=True)
        ]

    def fuse(self) -> None:
        """Drop the branches that are not used in evaluation."""
        if self.end_to_end and not self._fused:
            del self.cv2, self.cv3
        self._fused = True

    def initialise_biases(self, strides: Sequence[int], image_size: int = 640) -> None:
        """Set the prior of each class to 5 objects per image of side `image_size` (after Lin et al., 2017).

        Without it the loss of thousands of background cells dominates the first epochs.
        """
        pairs = [(self.box_branches, self.class_branches)]
        if self.end_to_end and not self._fused:
            pairs.append((self.cv2, self.cv3))
        for boxes, classes in pairs:
            for box, kind, stride in zip(boxes, classes, strides, strict=True):
                _last_bias(box).data.fill_(1.0)
                _last_bias(kind).data.fill_(math.log(5 / self.nc / (image_size / stride) ** 2))


def _branch(channels: int, width: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(Conv(channels, width, 3), Conv(width, width, 3), nn.Conv2d(width, outputs, 1))


def _light_branch(channels: int, width: int, outputs: int) -> nn.Sequential:
    def separable(inputs: int) -> nn.Sequential:
        return nn.Sequential(DWConv(inputs, inputs, 3), Conv(inputs, width))

    return nn.Sequential(separable(channels), separable(width), nn.Conv2d(width, outputs, 1))


def _last_bias(branch: nn.Module) -> Tensor:
    assert isinstance(branch, nn.Sequential)
    bias = branch[-1].bias
    assert isinstance(bias, Tensor)
    return bias
