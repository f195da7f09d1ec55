"""Layers between input and head: convolutions, attention, and the blocks of every model family.

Attribute names (`conv`, `cv1`, `m`, `gamma` …) are those of published checkpoints: weights load by name.

References: CSPNet (Wang et al., 2019); SPP (He et al., 2014); attention (Vaswani et al., 2017); RepVGG (Ding
et al., 2021); YOLOv10 (Wang et al., 2024); YOLOv12 (Tian et al., 2025), whose attention is over areas; the
published model tables of YOLOv5u, YOLOv8, YOLO11, YOLO12 and YOLO26. A convolution of the values adds the
cell's position, which attention alone ignores.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

# Published hyper-parameters of every batch normalisation in the networks; they differ from torch's defaults.
BATCH_NORM_EPSILON = 1e-3
BATCH_NORM_MOMENTUM = 0.03

ACTIVATIONS: dict[str, type[nn.Module]] = {"SiLU": nn.SiLU, "ReLU": nn.ReLU}
CHANNELS_PER_HEAD = 64
CHANNELS_PER_AREA_HEAD = 32


def same_padding(kernel: int) -> int:
    """The padding that keeps the size of the map at stride 1, for an odd kernel."""
    return kernel // 2


class Conv(nn.Module):
    """Convolution without bias → batch normalisation → activation.

    (B, `inputs`, H, W) → (B, `outputs`, H / stride, W / stride). `activate` False omits the last step;
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
        activate: bool = True,
    ) -> None:
        super().__init__()
        padding = same_padding(kernel) if padding is None else padding
        self.conv = nn.Conv2d(inputs, outputs, kernel, stride, padding, groups=groups, bias=False)
        self.bn: nn.Module = nn.BatchNorm2d(outputs, eps=BATCH_NORM_EPSILON, momentum=BATCH_NORM_MOMENTUM)
        # In place is safe: normalisation keeps its input, not its output.
        self.act: nn.Module = nn.SiLU(inplace=True) if activate else nn.Identity()

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
        self, inputs: int, outputs: int, kernel: int = 1, stride: int = 1, *, activate: bool = True
    ) -> None:
        groups = math.gcd(inputs, outputs)
        super().__init__(inputs, outputs, kernel, stride, groups=groups, activate=activate)


def attend(query: Tensor, key: Tensor, value: Tensor) -> Tensor:
    """Scaled dot-product attention, channels before cells: (…, K, N), (…, K, N), (…, V, N) → (…, V, N)."""
    weights = ((query * query.shape[-2] ** -0.5).transpose(-2, -1) @ key).softmax(dim=-1)
    attended: Tensor = value @ weights.transpose(-2, -1)
    return attended


class Attention(nn.Module):
    """Attention of every cell to every other. Keys are half as wide as values."""

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.value_width = channels // heads
        self.key_width = self.value_width // 2
        self.qkv = Conv(channels, channels + 2 * heads * self.key_width, activate=False)
        self.proj = Conv(channels, channels, activate=False)
        self.pe = Conv(channels, channels, 3, groups=channels, activate=False)

    def forward(self, x: Tensor) -> Tensor:
        batch, channels, height, width = x.shape
        mixed = self.qkv(x).reshape(batch, self.heads, -1, height * width)
        query, key, value = mixed.split([self.key_width, self.key_width, self.value_width], dim=2)
        attended = attend(query, key, value).reshape(batch, channels, height, width)
        y: Tensor = self.proj(attended + self.pe(value.reshape(batch, channels, height, width)))
        return y


class AreaAttention(nn.Module):
    """Attention of every cell to the cells of its area: the map's rows, divided into `areas` equal runs.

    The number of cells must be a multiple of `areas`; with 4 areas at stride 16 it is, for sides in multiples
    of 32.
    """

    def __init__(self, channels: int, heads: int, areas: int) -> None:
        super().__init__()
        self.heads = heads
        self.areas = areas
        self.qkv = Conv(channels, 3 * channels, activate=False)
        self.proj = Conv(channels, channels, activate=False)
        self.pe = Conv(channels, channels, 7, groups=channels, activate=False)

    def forward(self, x: Tensor) -> Tensor:
        batch, channels, height, width = x.shape
        mixed = self.qkv(x).reshape(batch, self.heads, 3 * channels // self.heads, self.areas, -1)
        query, key, value = mixed.chunk(3, dim=2)
        attended = attend(query.transpose(2, 3), key.transpose(2, 3), value.transpose(2, 3)).transpose(2, 3)
        attended = attended.reshape(batch, channels, height, width)
        y: Tensor = self.proj(attended + self.pe(value.reshape(batch, channels, height, width)))
        return y


def feed_forward(channels: int, hidden: int) -> nn.Sequential:
    """Two 1×1 convolutions, the second without activation."""
    return nn.Sequential(Conv(channels, hidden), Conv(hidden, channels, activate=False))


class PSABlock(nn.Module):
    """Attention, then a feed-forward network, each added to its input."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.attn = Attention(channels, max(channels // CHANNELS_PER_HEAD, 1))
        self.ffn = feed_forward(channels, 2 * channels)

    def forward(self, x: Tensor) -> Tensor:
        x = x + self.attn(x)
        y: Tensor = x + self.ffn(x)
        return y


class PSA(PSABlock):
    """YOLOv10's: half of the channels pass one attention block, the other half bypasses it."""

    def __init__(self, channels: int) -> None:
        hidden = channels // 2
        super().__init__(hidden)
        self.cv1 = Conv(channels, 2 * hidden)
        self.cv2 = Conv(2 * hidden, channels)

    def forward(self, x: Tensor) -> Tensor:
        bypass, through = self.cv1(x).chunk(2, dim=1)
        y: Tensor = self.cv2(torch.cat((bypass, super().forward(through)), dim=1))
        return y


class C2PSA(nn.Module):
    """YOLO11's: as `PSA`, with `repeats` attention blocks."""

    def __init__(self, channels: int, repeats: int = 1) -> None:
        super().__init__()
        hidden = channels // 2
        self.cv1 = Conv(channels, 2 * hidden)
        self.cv2 = Conv(2 * hidden, channels)
        self.m = nn.Sequential(*(PSABlock(hidden) for _ in range(repeats)))

    def forward(self, x: Tensor) -> Tensor:
        bypass, through = self.cv1(x).chunk(2, dim=1)
        y: Tensor = self.cv2(torch.cat((bypass, self.m(through)), dim=1))
        return y


class ABlock(nn.Module):
    """Area attention, then a feed-forward network `mlp_ratio` times as wide, each added to its input."""

    def __init__(self, channels: int, areas: int = 1, mlp_ratio: float = 2.0) -> None:
        super().__init__()
        self.attn = AreaAttention(channels, channels // CHANNELS_PER_AREA_HEAD, areas)
        self.mlp = feed_forward(channels, int(channels * mlp_ratio))

    def forward(self, x: Tensor) -> Tensor:
        x = x + self.attn(x)
        y: Tensor = x + self.mlp(x)
        return y


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
    ) -> None:
        super().__init__()
        hidden = int(outputs * expansion)
        self.cv1 = Conv(inputs, hidden, kernels[0])
        self.cv2 = Conv(hidden, outputs, kernels[1])
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
    ) -> None:
        super().__init__()
        self.parts = parts
        self.cv1 = Conv(inputs, parts * hidden)
        self.cv2 = Conv((parts + repeats) * hidden, outputs)
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
        self, inputs: int, outputs: int, repeats: int = 1, shortcut: bool = False, *, expansion: float = 0.5
    ) -> None:
        hidden = int(outputs * expansion)
        super().__init__(inputs, outputs, lambda: Bottleneck(hidden, hidden, shortcut), repeats, hidden)


class C2(nn.Module):
    """Half of the channels pass `repeats` bottlenecks, the other half bypasses them (YOLOv8-P6)."""

    def __init__(
        self, inputs: int, outputs: int, repeats: int = 1, shortcut: bool = True, *, expansion: float = 0.5
    ) -> None:
        super().__init__()
        hidden = int(outputs * expansion)
        self.cv1 = Conv(inputs, 2 * hidden)
        self.cv2 = Conv(2 * hidden, outputs)
        self.m = nn.Sequential(*(Bottleneck(hidden, hidden, shortcut) for _ in range(repeats)))

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
    ) -> None:
        super().__init__()
        hidden = int(outputs * expansion)
        self.cv1 = Conv(inputs, hidden)
        self.cv2 = Conv(inputs, hidden)
        self.cv3 = Conv(2 * hidden, outputs)
        self.m = nn.Sequential(*(stage(hidden) for _ in range(repeats)))

    def forward(self, x: Tensor) -> Tensor:
        y: Tensor = self.cv3(torch.cat((self.m(self.cv1(x)), self.cv2(x)), dim=1))
        return y


class C3(SplitBlock):
    """YOLOv5's: bottlenecks of a 1×1 and a 3×3 convolution."""

    def __init__(
        self, inputs: int, outputs: int, repeats: int = 1, shortcut: bool = True, *, expansion: float = 0.5
    ) -> None:
        super().__init__(
            inputs,
            outputs,
            lambda hidden: Bottleneck(hidden, hidden, shortcut, kernels=(1, 3)),
            repeats,
            expansion=expansion,
        )


class C3k(SplitBlock):
    """YOLO11's: bottlenecks of two 3×3 convolutions."""

    def __init__(self, inputs: int, outputs: int, repeats: int = 2, shortcut: bool = True) -> None:
        super().__init__(inputs, outputs, lambda hidden: Bottleneck(hidden, hidden, shortcut), repeats)


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
    ) -> None:
        hidden = int(outputs * expansion)

        def narrow() -> nn.Module:
            return Bottleneck(hidden, hidden, shortcut, expansion=0.5)

        def stage() -> nn.Module:
            if attention:
                return nn.Sequential(narrow(), PSABlock(hidden))
            return C3k(hidden, hidden, 2, shortcut) if c3k else narrow()

        super().__init__(inputs, outputs, stage, repeats, hidden)


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
    ) -> None:
        hidden = int(outputs * expansion)

        def stage() -> nn.Module:
            if not area_attention:
                return C3k(hidden, hidden, 2, shortcut)
            return nn.Sequential(*(ABlock(hidden, areas, mlp_ratio) for _ in range(2)))

        super().__init__(inputs, outputs, stage, repeats, hidden, parts=1)
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
    ) -> None:
        super().__init__()
        hidden = inputs // 2
        self.cv1 = Conv(inputs, hidden, activate=activate_first)
        self.cv2 = Conv((pools + 1) * hidden, outputs)
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


class LargeKernelDWConv(nn.Module):
    """Two parallel depthwise convolutions, 7×7 and 3×3, added and activated (RepVGG, Ding et al., 2021).

    `fuse` merges them into one 7×7 convolution.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv: nn.Module = DWConv(channels, channels, 7, activate=False)
        self.conv1: nn.Module | None = DWConv(channels, channels, 3, activate=False)
        self.act = nn.SiLU(inplace=True)

    def forward(self, x: Tensor) -> Tensor:
        y = self.conv(x) if self.conv1 is None else self.conv(x) + self.conv1(x)
        activated: Tensor = self.act(y)
        return activated

    def fuse(self) -> None:
        large, small = self.conv, self.conv1
        if not isinstance(large, Conv) or not isinstance(small, Conv):
            return
        self.conv, self.conv1 = merged_convolution(large, small), None


def merged_convolution(large: Conv, small: Conv) -> nn.Conv2d:
    """One convolution with the sum of two parallel ones without activation, normalisation folded."""
    large.fuse()
    small.fuse()
    margin = (large.conv.kernel_size[0] - small.conv.kernel_size[0]) // 2
    with torch.no_grad():
        large.conv.weight += nn.functional.pad(small.conv.weight, [margin] * 4)
        assert large.conv.bias is not None
        assert small.conv.bias is not None
        large.conv.bias += small.conv.bias
    return large.conv


class CIB(nn.Module):
    """YOLOv10's compact inverted block: depthwise and 1×1 convolutions in turn, added to the input."""

    def __init__(self, channels: int, shortcut: bool, large_kernel: bool) -> None:
        super().__init__()
        wide = 2 * channels
        self.cv1 = nn.Sequential(
            DWConv(channels, channels, 3),
            Conv(channels, wide),
            LargeKernelDWConv(wide) if large_kernel else DWConv(wide, wide, 3),
            Conv(wide, channels),
            DWConv(channels, channels, 3),
        )
        self.add = shortcut

    def forward(self, x: Tensor) -> Tensor:
        y: Tensor = self.cv1(x)
        return x + y if self.add else y


class C2fCIB(GrowingBlock):
    """YOLOv10's: C2f with compact inverted blocks for stages."""

    def __init__(
        self, inputs: int, outputs: int, repeats: int = 1, shortcut: bool = False, large_kernel: bool = False
    ) -> None:
        hidden = outputs // 2
        super().__init__(inputs, outputs, lambda: CIB(hidden, shortcut, large_kernel), repeats, hidden)


class SCDown(nn.Module):
    """YOLOv10's downsampling: channels by a 1×1 convolution, size by a depthwise one."""

    def __init__(self, inputs: int, outputs: int, kernel: int = 3, stride: int = 2) -> None:
        super().__init__()
        self.cv1 = Conv(inputs, outputs)
        self.cv2 = DWConv(outputs, outputs, kernel, stride, activate=False)

    def forward(self, x: Tensor) -> Tensor:
        y: Tensor = self.cv2(self.cv1(x))
        return y
