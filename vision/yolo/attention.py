"""Attention over the cells of a feature map: YOLOv10's and YOLO11's, and YOLO12's over areas.

References: attention (Vaswani et al., 2017); partial self-attention (YOLOv10, Wang et al., 2024); area
attention (YOLOv12, Tian et al., 2025). In both, a convolution of the values adds the cell's position, which
attention alone ignores.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from vision.yolo.convolution import Conv

CHANNELS_PER_HEAD = 64
CHANNELS_PER_AREA_HEAD = 32


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
        self.qkv = Conv(channels, channels + 2 * heads * self.key_width, activation=None)
        self.proj = Conv(channels, channels, activation=None)
        self.pe = Conv(channels, channels, 3, groups=channels, activation=None)

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
        self.qkv = Conv(channels, 3 * channels, activation=None)
        self.proj = Conv(channels, channels, activation=None)
        self.pe = Conv(channels, channels, 7, groups=channels, activation=None)

    def forward(self, x: Tensor) -> Tensor:
        batch, channels, height, width = x.shape
        mixed = self.qkv(x).reshape(batch, self.heads, 3 * channels // self.heads, self.areas, -1)
        query, key, value = mixed.chunk(3, dim=2)
        attended = attend(query.transpose(2, 3), key.transpose(2, 3), value.transpose(2, 3)).transpose(2, 3)
        attended = attended.reshape(batch, channels, height, width)
        y: Tensor = self.proj(attended + self.pe(value.reshape(batch, channels, height, width)))
        return y


def feed_forward(channels: int, hidden: int, activation: str) -> nn.Sequential:
    """Two 1×1 convolutions, the second without activation."""
    return nn.Sequential(
        Conv(channels, hidden, activation=activation), Conv(hidden, channels, activation=None)
    )


class PSABlock(nn.Module):
    """Attention, then a feed-forward network, each added to its input."""

    def __init__(self, channels: int, *, activation: str = "SiLU") -> None:
        super().__init__()
        self.attn = Attention(channels, max(channels // CHANNELS_PER_HEAD, 1))
        self.ffn = feed_forward(channels, 2 * channels, activation)

    def forward(self, x: Tensor) -> Tensor:
        x = x + self.attn(x)
        y: Tensor = x + self.ffn(x)
        return y


class PSA(PSABlock):
    """YOLOv10's: half of the channels pass one attention block, the other half bypasses it."""

    def __init__(self, channels: int, *, activation: str = "SiLU") -> None:
        hidden = channels // 2
        super().__init__(hidden, activation=activation)
        self.cv1 = Conv(channels, 2 * hidden, activation=activation)
        self.cv2 = Conv(2 * hidden, channels, activation=activation)

    def forward(self, x: Tensor) -> Tensor:
        bypass, through = self.cv1(x).chunk(2, dim=1)
        y: Tensor = self.cv2(torch.cat((bypass, super().forward(through)), dim=1))
        return y


class C2PSA(nn.Module):
    """YOLO11's: as `PSA`, with `repeats` attention blocks."""

    def __init__(self, channels: int, repeats: int = 1, *, activation: str = "SiLU") -> None:
        super().__init__()
        hidden = channels // 2
        self.cv1 = Conv(channels, 2 * hidden, activation=activation)
        self.cv2 = Conv(2 * hidden, channels, activation=activation)
        self.m = nn.Sequential(*(PSABlock(hidden, activation=activation) for _ in range(repeats)))

    def forward(self, x: Tensor) -> Tensor:
        bypass, through = self.cv1(x).chunk(2, dim=1)
        y: Tensor = self.cv2(torch.cat((bypass, self.m(through)), dim=1))
        return y


class ABlock(nn.Module):
    """Area attention, then a feed-forward network `mlp_ratio` times as wide, each added to its input."""

    def __init__(
        self, channels: int, areas: int = 1, mlp_ratio: float = 2.0, *, activation: str = "SiLU"
    ) -> None:
        super().__init__()
        self.attn = AreaAttention(channels, channels // CHANNELS_PER_AREA_HEAD, areas)
        self.mlp = feed_forward(channels, int(channels * mlp_ratio), activation)

    def forward(self, x: Tensor) -> Tensor:
        x = x + self.attn(x)
        y: Tensor = x + self.mlp(x)
        return y
