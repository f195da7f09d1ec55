"""YOLOv10's blocks, which reduce computation on redundant channels (Wang et al., 2024)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from vision.yolo.blocks import GrowingBlock
from vision.yolo.convolution import Conv, DWConv


class LargeKernelDWConv(nn.Module):
    """Two parallel depthwise convolutions, 7×7 and 3×3, added and activated (RepVGG, Ding et al., 2021).

    `fuse` merges them into one 7×7 convolution.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv: nn.Module = DWConv(channels, channels, 7, activation=None)
        self.conv1: nn.Module | None = DWConv(channels, channels, 3, activation=None)
        self.act = nn.SiLU(inplace=True)

    def forward(self, x: Tensor) -> Tensor:
        y = self.conv(x) if self.conv1 is None else self.conv(x) + self.conv1(x)
        activated: Tensor = self.act(y)
        return activated

    def fuse(self) -> None:
        large, small = self.conv, self.conv1
        if not isinstance(large, Conv) or not isinstance(small, Conv):
            return
        large.fuse()
        small.fuse()
        margin = (large.conv.kernel_size[0] - small.conv.kernel_size[0]) // 2
        with torch.no_grad():
            large.conv.weight += nn.functional.pad(small.conv.weight, [margin] * 4)
            assert large.conv.bias is not None
            assert small.conv.bias is not None
            large.conv.bias += small.conv.bias
        self.conv, self.conv1 = large.conv, None


class CIB(nn.Module):
    """YOLOv10's compact inverted block: depthwise and 1×1 convolutions in turn, added to the input."""

    def __init__(
        self, channels: int, shortcut: bool, large_kernel: bool, *, activation: str = "SiLU"
    ) -> None:
        super().__init__()
        wide = 2 * channels
        self.cv1 = nn.Sequential(
            DWConv(channels, channels, 3, activation=activation),
            Conv(channels, wide, activation=activation),
            LargeKernelDWConv(wide) if large_kernel else DWConv(wide, wide, 3, activation=activation),
            Conv(wide, channels, activation=activation),
            DWConv(channels, channels, 3, activation=activation),
        )
        self.add = shortcut

    def forward(self, x: Tensor) -> Tensor:
        y: Tensor = self.cv1(x)
        return x + y if self.add else y


class C2fCIB(GrowingBlock):
    """YOLOv10's: C2f with compact inverted blocks for stages."""

    def __init__(
        self,
        inputs: int,
        outputs: int,
        repeats: int = 1,
        shortcut: bool = False,
        large_kernel: bool = False,
        *,
        activation: str = "SiLU",
    ) -> None:
        hidden = outputs // 2

        def stage() -> nn.Module:
            return CIB(hidden, shortcut, large_kernel, activation=activation)

        super().__init__(inputs, outputs, stage, repeats, hidden, activation=activation)


class SCDown(nn.Module):
    """YOLOv10's downsampling: channels by a 1×1 convolution, size by a depthwise one."""

    def __init__(
        self, inputs: int, outputs: int, kernel: int = 3, stride: int = 2, *, activation: str = "SiLU"
    ) -> None:
        super().__init__()
        self.cv1 = Conv(inputs, outputs, activation=activation)
        self.cv2 = DWConv(outputs, outputs, kernel, stride, activation=None)

    def forward(self, x: Tensor) -> Tensor:
        y: Tensor = self.cv2(self.cv1(x))
        return y
