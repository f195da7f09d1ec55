"""The basic convolution of all networks, and its depthwise form.

Attribute names (`conv`, `bn`, `act`) are those of published checkpoints, so that weights load by name.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

# Published hyper-parameters of every batch normalisation in the networks; they differ from torch's defaults.
BATCH_NORM_EPSILON = 1e-3
BATCH_NORM_MOMENTUM = 0.03

ACTIVATIONS: dict[str, type[nn.Module]] = {"SiLU": nn.SiLU, "ReLU": nn.ReLU}


def same_padding(kernel: int) -> int:
    """The padding that keeps the size of the map at stride 1, for an odd kernel."""
    return kernel // 2


class Conv(nn.Module):
    """Convolution without bias → batch normalisation → activation.

    (B, `inputs`, H, W) → (B, `outputs`, H / stride, W / stride). `activation` None omits the last step;
    `padding` None keeps the size at stride 1.
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        kernel: int = 1,
        stride: int = 1,
        *,
        padding: int | None = None,
        groups: int = 1,
        activation: str | None = "SiLU",
    ) -> None:
        super().__init__()
        padding = same_padding(kernel) if padding is None else padding
        self.conv = nn.Conv2d(inputs, outputs, kernel, stride, padding, groups=groups, bias=False)
        self.bn: nn.Module = nn.BatchNorm2d(outputs, eps=BATCH_NORM_EPSILON, momentum=BATCH_NORM_MOMENTUM)
        # In place is safe: normalisation keeps its input, not its output.
        self.act = nn.Identity() if activation is None else ACTIVATIONS[activation](inplace=True)

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
        self.bn = nn.Identity()
        if conv.weight.is_meta:  # Shapes only: nothing to compute, and torch would import much to do so.
            conv.bias = nn.Parameter(norm.bias.detach().clone())
            return
        with torch.no_grad():
            scale = norm.weight.double() / (norm.running_var.double() + norm.eps).sqrt()
            weight = conv.weight.double() * scale[:, None, None, None]
            bias = norm.bias.double() - norm.running_mean.double() * scale
            conv.weight.copy_(weight.to(conv.weight.dtype))
            conv.bias = nn.Parameter(bias.to(conv.weight.dtype), requires_grad=conv.weight.requires_grad)


class DWConv(Conv):
    """A `Conv` with as many groups as both channel counts allow: one filter per channel if they are equal."""

    def __init__(
        self,
        inputs: int,
        outputs: int,
        kernel: int = 1,
        stride: int = 1,
        *,
        activation: str | None = "SiLU",
    ) -> None:
        groups = math.gcd(inputs, outputs)
        super().__init__(inputs, outputs, kernel, stride, groups=groups, activation=activation)
