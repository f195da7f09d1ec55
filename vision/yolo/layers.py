"""The layers of YOLOv8, as published: convolution blocks, C2f, SPPF, the anchor-free head.

Attribute names (`conv`, `bn`, `cv1`, `m`, `dfl` …) are those that checkpoints in circulation use, so that
weights load by name.

References: YOLOv8's published model tables; SPP (He et al., 2014); CSPNet (Wang et al., 2019); generalised
focal loss, for the box sides as distributions (Li et al., 2020).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

# Published hyper-parameters of every batch normalisation in the network; they differ from torch's defaults.
BATCH_NORM_EPSILON = 1e-3
BATCH_NORM_MOMENTUM = 0.03

ACTIVATIONS: dict[str, type[nn.Module]] = {"SiLU": nn.SiLU, "ReLU": nn.ReLU}


def same_padding(kernel: int) -> int:
    """The padding that keeps the size of the map at stride 1, for an odd kernel."""
    return kernel // 2


class Conv(nn.Module):
    """Convolution without bias → batch normalisation → activation.

    (B, `inputs`, H, W) → (B, `outputs`, H / stride, W / stride).
    """

    def __init__(
        self, inputs: int, outputs: int, kernel: int = 1, stride: int = 1, *, activation: str = "SiLU"
    ) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, kernel, stride, same_padding(kernel), bias=False)
        self.bn: nn.Module = nn.BatchNorm2d(outputs, eps=BATCH_NORM_EPSILON, momentum=BATCH_NORM_MOMENTUM)
        # In place is safe: normalisation keeps its input, not its output.
        self.act = ACTIVATIONS[activation](inplace=True)

    def forward(self, x: Tensor) -> Tensor:
        y: Tensor = self.act(self.bn(self.conv(x)))
        return y

    def fuse(self) -> None:
        """Fold the normalisation's running statistics into the convolution, for inference only."""
        if not isinstance(self.bn, nn.BatchNorm2d):
            return
        norm, conv = self.bn, self.conv
        if norm.running_mean is None or norm.running_var is None:
            raise ValueError("a batch normalisation without running statistics cannot be folded")
        with torch.no_grad():
            scale = norm.weight.double() / (norm.running_var.double() + norm.eps).sqrt()
            weight = conv.weight.double() * scale[:, None, None, None]
            bias = norm.bias.double() - norm.running_mean.double() * scale
            conv.weight.copy_(weight.to(conv.weight.dtype))
            conv.bias = nn.Parameter(bias.to(conv.weight.dtype), requires_grad=conv.weight.requires_grad)
        self.bn = nn.Identity()


class Bottleneck(nn.Module):
    """Two 3×3 convolutions, with a shortcut around them where the channel counts allow and it is asked."""

    def __init__(self, inputs: int, outputs: int, shortcut: bool, *, activation: str = "SiLU") -> None:
        super().__init__()
        self.cv1 = Conv(inputs, outputs, 3, activation=activation)
        self.cv2 = Conv(outputs, outputs, 3, activation=activation)
        self.add = shortcut and inputs == outputs

    def forward(self, x: Tensor) -> Tensor:
        y: Tensor = self.cv2(self.cv1(x))
        return x + y if self.add else y


class C2f(nn.Module):
    """Cross-stage partial block: half of the channels pass `repeats` bottlenecks, and every stage is kept."""

    def __init__(
        self,
        inputs: int,
        outputs: int,
        repeats: int = 1,
        shortcut: bool = False,
        *,
        activation: str = "SiLU",
    ) -> None:
        super().__init__()
        hidden = outputs // 2
        self.cv1 = Conv(inputs, 2 * hidden, activation=activation)
        self.cv2 = Conv((2 + repeats) * hidden, outputs, activation=activation)
        self.m = nn.ModuleList(
            Bottleneck(hidden, hidden, shortcut, activation=activation) for _ in range(repeats)
        )

    def forward(self, x: Tensor) -> Tensor:
        stages = list(self.cv1(x).chunk(2, dim=1))
        for bottleneck in self.m:
            stages.append(bottleneck(stages[-1]))
        y: Tensor = self.cv2(torch.cat(stages, dim=1))
        return y


class SPPF(nn.Module):
    """Spatial pyramid pooling: one pooling window applied three times sees three window sizes."""

    def __init__(self, inputs: int, outputs: int, kernel: int = 5, *, activation: str = "SiLU") -> None:
        super().__init__()
        hidden = inputs // 2
        self.cv1 = Conv(inputs, hidden, activation=activation)
        self.cv2 = Conv(4 * hidden, outputs, activation=activation)
        self.m = nn.MaxPool2d(kernel, stride=1, padding=same_padding(kernel))

    def forward(self, x: Tensor) -> Tensor:
        stages = [self.cv1(x)]
        for _ in range(3):
            stages.append(self.m(stages[-1]))
        y: Tensor = self.cv2(torch.cat(stages, dim=1))
        return y


class Concat(nn.Module):
    """Joins several maps along one axis."""

    def __init__(self, dimension: int = 1) -> None:
        super().__init__()
        self.dimension = dimension

    def forward(self, maps: Sequence[Tensor]) -> Tensor:
        return torch.cat(list(maps), dim=self.dimension)


class DFL(nn.Module):
    """The expected value of a distribution over the distances 0 … bins - 1 (Li et al., 2020)."""

    def __init__(self, bins: int = 16) -> None:
        super().__init__()
        self.bins = bins
        self.conv = nn.Conv2d(bins, 1, 1, bias=False).requires_grad_(False)
        self.conv.weight.data.copy_(torch.arange(bins, dtype=torch.float32).view(1, bins, 1, 1))

    def forward(self, logits: Tensor) -> Tensor:
        """(…, 4 · bins) logits → (…, 4) distances, in cells, of left, top, right, bottom."""
        probabilities = logits.reshape(*logits.shape[:-1], 4, self.bins).softmax(dim=-1)
        distances: Tensor = probabilities @ self.conv.weight.view(self.bins).to(probabilities.dtype)
        return distances


class Detect(nn.Module):
    """The head: for each level one map of box distributions and class logits.

    A list of (B, C_i, H_i, W_i) → a list of (B, 4 · reg_max + classes, H_i, W_i).
    """

    def __init__(
        self, classes: int, inputs: Sequence[int], reg_max: int = 16, *, activation: str = "SiLU"
    ) -> None:
        super().__init__()
        self.nc = classes
        self.reg_max = reg_max
        box_width = max(16, inputs[0] // 4, 4 * reg_max)
        class_width = max(inputs[0], min(classes, 100))

        def branch(channels: int, width: int, outputs: int) -> nn.Sequential:
            return nn.Sequential(
                Conv(channels, width, 3, activation=activation),
                Conv(width, width, 3, activation=activation),
                nn.Conv2d(width, outputs, 1),
            )

        self.cv2 = nn.ModuleList(branch(channels, box_width, 4 * reg_max) for channels in inputs)
        self.cv3 = nn.ModuleList(branch(channels, class_width, classes) for channels in inputs)
        self.dfl = DFL(reg_max)

    def forward(self, maps: Sequence[Tensor]) -> list[Tensor]:
        return [
            torch.cat((boxes(x), classes(x)), dim=1)
            for x, boxes, classes in zip(maps, self.cv2, self.cv3, strict=True)
        ]

    def initialise_biases(self, strides: Sequence[int], image_size: int = 640) -> None:
        """Start with each class as rare as 5 objects in an `image_size` picture (after Lin et al., 2017).

        Without this prior the thousands of background cells drown the first epochs.
        """
        for boxes, classes, stride in zip(self.cv2, self.cv3, strides, strict=True):
            _last_bias(boxes).data.fill_(1.0)
            _last_bias(classes).data.fill_(math.log(5 / self.nc / (image_size / stride) ** 2))


def _last_bias(branch: Any) -> Tensor:
    bias: Tensor = branch[-1].bias
    return bias
