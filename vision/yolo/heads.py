"""The anchor-free heads: with and without distributions over the box sides, NMS and rotated boxes.

Attribute names (`cv2`, `cv3`, `one2one_cv2`, `dfl` …) are those of published checkpoints.

References: generalised focal loss, for the box sides as distributions (Li et al., 2020); consistent dual
assignments, for the end-to-end head (YOLOv10, Wang et al., 2024); focal loss, for the prior (Lin et al.,
2017).
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from typing import Any

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

    Attributes:
        reg_max: of the outputs.

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
        classes = self.cv3 if self.training and not self._fused else self.class_branches
        return [
            torch.cat((self.sides(level, x), kind(x)), dim=1)
            for level, (x, kind) in enumerate(zip(maps, classes, strict=True))
        ]

    def sides(self, level: int, x: Tensor) -> Tensor:
        """(B, C, H, W) input of one level → (B, 4 · reg_max, H, W) box sides."""
        boxes = self.cv2 if self.training and not self._fused else self.box_branches
        sides: Tensor = boxes[level](x)
        return sides

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


class OBB(Detect):
    """A head of rotated boxes, whose outputs are the axis-aligned boxes that enclose them.

    The distances left, top, right and bottom of the box branch are along the rotated box's axes; a further
    branch, `cv4`, has the logit of the angle, -π/4 to 3π/4. The conversion takes place in the network, so
    that decoding, every runtime and every export treat it as a detector of distances (`reg_max` 1).
    """

    def __init__(self, classes: int, inputs: Sequence[int], reg_max: int = 16, **options: Any) -> None:
        super().__init__(classes, inputs, reg_max, **options)
        self.cv4 = nn.ModuleList(_branch(channels, max(inputs[0] // 4, 1), 1) for channels in inputs)
        self.reg_max = 1

    def sides(self, level: int, x: Tensor) -> Tensor:
        # torch computes this in float32 whatever the network's precision: a distance needs more digits than a
        # logit. OpenVINO in bfloat16 does not keep all of it in float32 (figures: docs/measurements.md).
        logits = super().sides(level, x).float().permute(0, 2, 3, 1)
        left, top, right, bottom = self.dfl(logits).unbind(dim=-1)
        angle = (self.cv4[level](x).float().squeeze(1).sigmoid() - 0.25) * math.pi
        cos, sin = angle.cos(), angle.sin()
        across, along = (right - left) / 2, (bottom - top) / 2
        centre_x, centre_y = across * cos - along * sin, across * sin + along * cos
        width, height = left + right, top + bottom
        half_width = (width * cos.abs() + height * sin.abs()) / 2
        half_height = (width * sin.abs() + height * cos.abs()) / 2
        enclosing = (
            half_width - centre_x,
            half_height - centre_y,
            half_width + centre_x,
            half_height + centre_y,
        )
        return torch.stack(enclosing, dim=1)


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
