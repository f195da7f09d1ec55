"""YOLOv9's layers: GELAN blocks of re-parameterised convolutions, and the paths of its largest network.

Attribute names are those of published checkpoints. References: YOLOv9 (Wang et al., 2024); RepVGG (Ding et
al., 2021); CBNet (Liang et al., 2021), whose auxiliary backbone feeds the main one.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from vision.yolo.layers import Conv, SplitBlock, merged_convolution


class RepConv(nn.Module):
    """Two parallel convolutions, 3×3 and 1×1, added and activated; `fuse` merges them into one."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.conv1: nn.Module = Conv(inputs, outputs, 3, activate=False)
        self.conv2: nn.Module | None = Conv(inputs, outputs, 1, activate=False)
        self.act: nn.Module = nn.SiLU(inplace=True)

    def forward(self, x: Tensor) -> Tensor:
        y = self.conv1(x) if self.conv2 is None else self.conv1(x) + self.conv2(x)
        activated: Tensor = self.act(y)
        return activated

    def fuse(self) -> None:
        if isinstance(self.conv1, Conv) and isinstance(self.conv2, Conv):
            self.conv1, self.conv2 = merged_convolution(self.conv1, self.conv2), None


class RepBottleneck(nn.Module):
    """A re-parameterised and an ordinary 3×3 convolution, with a shortcut around them."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.cv1 = RepConv(channels, channels)
        self.cv2 = Conv(channels, channels, 3)

    def forward(self, x: Tensor) -> Tensor:
        y: Tensor = x + self.cv2(self.cv1(x))
        return y


class RepCSP(SplitBlock):
    """Cross-stage partial block of re-parameterised bottlenecks."""

    def __init__(self, inputs: int, outputs: int, repeats: int = 1) -> None:
        super().__init__(inputs, outputs, RepBottleneck, repeats)


class ELAN1(nn.Module):
    """Half of the channels pass two stages in sequence; both halves and both stages' outputs are kept."""

    def __init__(self, inputs: int, outputs: int, hidden: int, width: int) -> None:
        super().__init__()
        self.cv1 = Conv(inputs, hidden)
        self.cv2, self.cv3 = self._stages(hidden // 2, width)
        self.cv4 = Conv(hidden + 2 * width, outputs)

    def _stages(self, inputs: int, width: int) -> tuple[nn.Module, nn.Module]:
        return Conv(inputs, width, 3), Conv(width, width, 3)

    def forward(self, x: Tensor) -> Tensor:
        outputs = list(self.cv1(x).chunk(2, dim=1))
        for stage in (self.cv2, self.cv3):
            outputs.append(stage(outputs[-1]))
        y: Tensor = self.cv4(torch.cat(outputs, dim=1))
        return y


class RepNCSPELAN4(ELAN1):
    """`ELAN1` whose stages are a `RepCSP` of `repeats` bottlenecks and a 3×3 convolution."""

    def __init__(self, inputs: int, outputs: int, hidden: int, width: int, repeats: int = 1) -> None:
        self._repeats = repeats
        super().__init__(inputs, outputs, hidden, width)

    def _stages(self, inputs: int, width: int) -> tuple[nn.Module, nn.Module]:
        first, second = (
            nn.Sequential(RepCSP(channels, width, self._repeats), Conv(width, width, 3))
            for channels in (inputs, width)
        )
        return first, second


def _blurred(x: Tensor) -> Tensor:
    """The mean of each 2×2 cells at stride 1: a row and a column less."""
    return functional.avg_pool2d(x, kernel_size=2, stride=1)


class AConv(nn.Module):
    """Downsampling: average, then a 3×3 convolution at stride 2."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.cv1 = Conv(inputs, outputs, 3, 2)

    def forward(self, x: Tensor) -> Tensor:
        y: Tensor = self.cv1(_blurred(x))
        return y


class ADown(nn.Module):
    """Downsampling: average; half of the channels pass a convolution at stride 2, the others a maximum."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.cv1 = Conv(inputs // 2, outputs // 2, 3, 2)
        self.cv2 = Conv(inputs // 2, outputs // 2)

    def forward(self, x: Tensor) -> Tensor:
        convolved, pooled = _blurred(x).chunk(2, dim=1)
        pooled = functional.max_pool2d(pooled, kernel_size=3, stride=2, padding=1)
        return torch.cat((self.cv1(convolved), self.cv2(pooled)), dim=1)


class SPPELAN(nn.Module):
    """Spatial pyramid pooling: one window applied one to three times, all sizes kept."""

    def __init__(self, inputs: int, outputs: int, hidden: int, kernel: int = 5) -> None:
        super().__init__()
        self.cv1 = Conv(inputs, hidden)
        self.cv5 = Conv(4 * hidden, outputs)
        self.kernel = kernel

    def forward(self, x: Tensor) -> Tensor:
        outputs = [self.cv1(x)]
        for _ in range(3):
            outputs.append(
                functional.max_pool2d(outputs[-1], self.kernel, stride=1, padding=self.kernel // 2)
            )
        y: Tensor = self.cv5(torch.cat(outputs, dim=1))
        return y


class CBLinear(nn.Module):
    """A 1×1 convolution that gives several maps, here along the channels; `CBFuse` picks one."""

    def __init__(self, inputs: int, widths: Sequence[int]) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, sum(widths), 1)

    def forward(self, x: Tensor) -> Tensor:
        y: Tensor = self.conv(x)
        return y


class CBFuse(nn.Module):
    """Adds to the last input one map of each of the others, enlarged to its size.

    Args:
        starts: of each of the others, the first channel of its map.
    """

    def __init__(self, starts: Sequence[int]) -> None:
        super().__init__()
        self.starts = tuple(starts)

    def forward(self, maps: Sequence[Tensor]) -> Tensor:
        *others, last = maps
        parts = [
            functional.interpolate(
                other[:, start : start + last.shape[1]], size=last.shape[2:], mode="nearest"
            )
            for other, start in zip(others, self.starts, strict=True)
        ]
        return torch.stack([*parts, last]).sum(dim=0)
