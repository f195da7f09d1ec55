"""All layers of detection networks, re-exported."""

from __future__ import annotations

from vision.yolo.attention import C2PSA, PSA, ABlock, AreaAttention, Attention, PSABlock
from vision.yolo.blocks import (
    C2,
    C3,
    SPPF,
    A2C2f,
    Bottleneck,
    C2f,
    C3k,
    C3k2,
    Concat,
)
from vision.yolo.compact_blocks import CIB, C2fCIB, LargeKernelDWConv, SCDown
from vision.yolo.convolution import ACTIVATIONS, Conv, DWConv, same_padding
from vision.yolo.heads import DFL, Detect

__all__ = [
    "ACTIVATIONS",
    "C2",
    "C2PSA",
    "C3",
    "CIB",
    "DFL",
    "PSA",
    "SPPF",
    "A2C2f",
    "ABlock",
    "AreaAttention",
    "Attention",
    "Bottleneck",
    "C2f",
    "C2fCIB",
    "C3k",
    "C3k2",
    "Concat",
    "Conv",
    "DWConv",
    "Detect",
    "LargeKernelDWConv",
    "PSABlock",
    "SCDown",
    "same_padding",
]
