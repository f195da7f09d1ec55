"""Blocks between input and head: cross-stage partial blocks of every model family, pooling, concatenation.

Attribute names (`cv1`, `m`, `gamma` …) are those of published checkpoints.

References: CSPNet (Wang et al., 2019); SPP (He et al., 2014); the published model tables of YOLOv5u, YOLOv8,
YOLO11, YOLO12 and YOLO26; YOLOv12 (Tian et al., 2025).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from vision.yolo.attention import ABlock, PSABlock
from vision.yolo.convolution import Conv, same_padding


class Bottleneck(nn.Module):
    """Two convolutions, with a shortcut around them if requested and the channel counts allow it.

    `expansion` is the width between the two, as a share of `outputs`.
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        shortcut: bool,
        *,
        kernels: tuple[int, int] = (3, 3),
        expansion: float = 1.0,
        activation: str = "SiLU",
    ) -> None:
        super().__init__()
        hidden = int(outputs * expansion)
        self.cv1 = Conv(inputs, hidden, kernels[0], activation=activation)
        self.cv2 = Conv(hidden, outputs, kernels[1], activation=activation)
        self.add = shortcut and inputs == outputs

    def forward(self, x: Tensor) -> Tensor:
        y: Tensor = self.cv2(self.cv1(x))
        return x + y if self.add else y


class GrowingBlock(nn.Module):
    """Cross-stage partial block that keeps every stage: `hidden` channels pass `repeats` stages in sequence.

    With `parts` 2 the same number of channels bypasses them, with 1 none.
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        stage: Callable[[], nn.Module],
        repeats: int,
        hidden: int,
        *,
        parts: int = 2,
        activation: str = "SiLU",
    ) -> None:
        super().__init__()
        self.parts = parts
        self.cv1 = Conv(inputs, parts * hidden, activation=activation)
        self.cv2 = Conv((parts + repeats) * hidden, outputs, activation=activation)
        self.m = nn.ModuleList(stage() for _ in range(repeats))

    def forward(self, x: Tensor) -> Tensor:
        first = self.cv1(x)
        outputs = [first] if self.parts == 1 else list(first.chunk(self.parts, dim=1))
        for stage in self.m:
            outputs.append(stage(outputs[-1]))
        y: Tensor = self.cv2(torch.cat(outputs, dim=1))
        return y


class C2f(GrowingBlock):
    """YOLOv8's: half of the channels pass `repeats` bottlenecks, and every stage is kept."""

    def __init__(
        self,
        inputs: int,
        outputs: int,
        repeats: int = 1,
        shortcut: bool = False,
        *,
        expansion: float = 0.5,
        activation: str = "SiLU",
    ) -> None:
        hidden = int(outputs * expansion)

        def stage() -> nn.Module:
            return Bottleneck(hidden, hidden, shortcut, activation=activation)

        super().__init__(inputs, outputs, stage, repeats, hidden, activation=activation)


class C2(nn.Module):
    """Half of the channels pass `repeats` bottlenecks, the other half bypasses them (YOLOv8-P6)."""

    def __init__(
        self,
        inputs: int,
        outputs: int,
        repeats: int = 1,
        shortcut: bool = True,
        *,
        expansion: float = 0.5,
        activation: str = "SiLU",
    ) -> None:
        super().__init__()
        hidden = int(outputs * expansion)
        self.cv1 = Conv(inputs, 2 * hidden, activation=activation)
        self.cv2 = Conv(2 * hidden, outputs, activation=activation)
        self.m = nn.Sequential(
            *(Bottleneck(hidden, hidden, shortcut, activation=activation) for _ in range(repeats))
        )

    def forward(self, x: Tensor) -> Tensor:
        through, bypass = self.cv1(x).chunk(2, dim=1)
        y: Tensor = self.cv2(torch.cat((self.m(through), bypass), dim=1))
        return y


class SplitBlock(nn.Module):
    """Cross-stage partial block of three convolutions: two branches, one of them through `stages`."""

    def __init__(
        self,
        inputs: int,
        outputs: int,
        stage: Callable[[int], nn.Module],
        repeats: int,
        *,
        expansion: float = 0.5,
        activation: str = "SiLU",
    ) -> None:
        super().__init__()
        hidden = int(outputs * expansion)
        self.cv1 = Conv(inputs, hidden, activation=activation)
        self.cv2 = Conv(inputs, hidden, activation=activation)
        self.cv3 = Conv(2 * hidden, outputs, activation=activation)
        self.m = nn.Sequential(*(stage(hidden) for _ in range(repeats)))

    def forward(self, x: Tensor) -> Tensor:
        y: Tensor = self.cv3(torch.cat((self.m(self.cv1(x)), self.cv2(x)), dim=1))
        return y


class C3(SplitBlock):
    """YOLOv5's: bottlenecks of a 1×1 and a 3×3 convolution."""

    def __init__(
        self,
        inputs: int,
        outputs: int,
        repeats: int = 1,
        shortcut: bool = True,
        *,
        expansion: float = 0.5,
        activation: str = "SiLU",
    ) -> None:
        def stage(hidden: int) -> nn.Module:
            return Bottleneck(hidden, hidden, shortcut, kernels=(1, 3), activation=activation)

        super().__init__(inputs, outputs, stage, repeats, expansion=expansion, activation=activation)


class C3k(SplitBlock):
    """YOLO11's: bottlenecks of two 3×3 convolutions."""

    def __init__(
        self,
        inputs: int,
        outputs: int,
        repeats: int = 2,
        shortcut: bool = True,
        *,
        activation: str = "SiLU",
    ) -> None:
        def stage(hidden: int) -> nn.Module:
            return Bottleneck(hidden, hidden, shortcut, activation=activation)

        super().__init__(inputs, outputs, stage, repeats, activation=activation)


class C3k2(GrowingBlock):
    """YOLO11's C2f. A stage is a bottleneck of half width, a C3k, or (YOLO26) a bottleneck with attention."""

    def __init__(
        self,
        inputs: int,
        outputs: int,
        repeats: int = 1,
        c3k: bool = False,
        expansion: float = 0.5,
        attention: bool = False,
        shortcut: bool = True,
        *,
        activation: str = "SiLU",
    ) -> None:
        hidden = int(outputs * expansion)

        def narrow() -> nn.Module:
            return Bottleneck(hidden, hidden, shortcut, expansion=0.5, activation=activation)

        def stage() -> nn.Module:
            if attention:
                return nn.Sequential(narrow(), PSABlock(hidden, activation=activation))
            return C3k(hidden, hidden, 2, shortcut, activation=activation) if c3k else narrow()

        super().__init__(inputs, outputs, stage, repeats, hidden, activation=activation)


class A2C2f(GrowingBlock):
    """YOLO12's (R-ELAN): stages of two area-attention blocks each, or of one C3k each.

    With `residual` the result, scaled by the learnt `gamma`, is added to the input.
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        repeats: int = 1,
        area_attention: bool = True,
        areas: int = 1,
        residual: bool = False,
        mlp_ratio: float = 2.0,
        expansion: float = 0.5,
        shortcut: bool = True,
        *,
        activation: str = "SiLU",
    ) -> None:
        hidden = int(outputs * expansion)

        def stage() -> nn.Module:
            if not area_attention:
                return C3k(hidden, hidden, 2, shortcut, activation=activation)
            return nn.Sequential(*(ABlock(hidden, areas, mlp_ratio, activation=activation) for _ in range(2)))

        super().__init__(inputs, outputs, stage, repeats, hidden, parts=1, activation=activation)
        residual = residual and area_attention
        self.gamma = nn.Parameter(torch.full((outputs,), 0.01)) if residual else None

    def forward(self, x: Tensor) -> Tensor:
        y = super().forward(x)
        return y if self.gamma is None else x + self.gamma.view(1, -1, 1, 1) * y


class SPPF(nn.Module):
    """Spatial pyramid pooling: one pooling window applied `pools` times gives as many window sizes.

    YOLO26's adds the input where the channel counts allow (`shortcut`) and omits the first activation.
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        kernel: int = 5,
        pools: int = 3,
        shortcut: bool = False,
        activate_first: bool = True,
        *,
        activation: str = "SiLU",
    ) -> None:
        super().__init__()
        hidden = inputs // 2
        self.cv1 = Conv(inputs, hidden, activation=activation if activate_first else None)
        self.cv2 = Conv((pools + 1) * hidden, outputs, activation=activation)
        self.m = nn.MaxPool2d(kernel, stride=1, padding=same_padding(kernel))
        self.pools = pools
        self.add = shortcut and inputs == outputs

    def forward(self, x: Tensor) -> Tensor:
        stages = [self.cv1(x)]
        for _ in range(self.pools):
            stages.append(self.m(stages[-1]))
        y: Tensor = self.cv2(torch.cat(stages, dim=1))
        return x + y if self.add else y


class Concat(nn.Module):
    """Concatenates several inputs along one axis."""

    def __init__(self, dimension: int = 1) -> None:
        super().__init__()
        self.dimension = dimension

    def forward(self, maps: Sequence[Tensor]) -> Tensor:
        return torch.cat(list(maps), dim=self.dimension)
