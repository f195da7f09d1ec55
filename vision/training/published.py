"""The published networks of YOLOv5u, YOLOv8, YOLOv10, YOLO11, YOLO12 and YOLO26, and the facts of a network.

All have one structure: a backbone that halves the image five times, a path up that concatenates finer
features, a path down, and a head at strides 8, 16 and 32 (feature pyramid, Lin et al., 2017; path
aggregation, Liu et al., 2018). They differ in the blocks.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch.utils.flop_counter import FlopCounterMode

from vision.yolo.architecture import YoloModel, build_shapes
from vision.yolo.description import ArchitectureError, ModelDescription

Scale = tuple[float, float, int]
"""Depth multiple, width multiple, largest channel count before the width multiple."""

Block = tuple[int, str, tuple[Any, ...]]
"""Repeats, layer, its arguments after the channels."""

_LATE_SCALES: dict[str, Scale] = {
    "n": (0.50, 0.25, 1024),
    "s": (0.50, 0.50, 1024),
    "m": (0.50, 1.00, 512),
    "l": (1.00, 1.00, 512),
    "x": (1.00, 1.50, 512),
}
SCALES: Mapping[str, Mapping[str, Scale]] = {
    "YOLOv5u": {
        "n": (0.33, 0.25, 1024),
        "s": (0.33, 0.50, 1024),
        "m": (0.67, 0.75, 1024),
        "l": (1.00, 1.00, 1024),
        "x": (1.33, 1.25, 1024),
    },
    "YOLOv8": {
        "n": (0.33, 0.25, 1024),
        "s": (0.33, 0.50, 1024),
        "m": (0.67, 0.75, 768),
        "l": (1.00, 1.00, 512),
        "x": (1.00, 1.25, 512),
    },
    "YOLOv10": {
        "n": (0.33, 0.25, 1024),
        "s": (0.33, 0.50, 1024),
        "m": (0.67, 0.75, 768),
        "b": (0.67, 1.00, 512),
        "l": (1.00, 1.00, 512),
        "x": (1.00, 1.25, 512),
    },
    "YOLO11": _LATE_SCALES,
    "YOLO12": _LATE_SCALES,
    "YOLO26": _LATE_SCALES,
}
"""Model family → scale letter → its multipliers, as published."""
# YOLOv9 has a table of rows per scale, without multipliers: channels of the first convolution and of SPPELAN.
_YOLOV9_SCALES: dict[tuple[object, object], str] = {
    (16, 128): "t",
    (32, 256): "s",
    (32, 480): "m",
    (64, 512): "c",
}

_USUAL_STRIDES = (8, 16, 32)


def published_description(
    model_family: str, scale: str | Scale, class_names: Sequence[str]
) -> ModelDescription:
    """The published network of a model family, a key of `SCALES`.

    Args:
        scale: a letter of the family, or other multipliers for the blocks of all its letters.
        class_names: id → name.

    Raises `ArchitectureError` for an unknown family or scale.
    """
    if model_family not in SCALES:
        raise ArchitectureError(f"unknown model family {model_family!r:.100}; known: {', '.join(SCALES)}")
    scales = SCALES[model_family]
    if isinstance(scale, str) and scale not in scales:
        raise ArchitectureError(f"{model_family} has no scale {scale!r:.100}; known: {', '.join(scales)}")
    letter, multipliers = (scale, scales[scale]) if isinstance(scale, str) else ("own", scale)
    backbone, head = _rows(_blocks(model_family, letter))
    table = {
        "backbone": backbone,
        "head": head,
        "scales": {letter: multipliers},
        "reg_max": 1 if model_family == "YOLO26" else 16,
        "end2end": model_family in ("YOLOv10", "YOLO26"),
    }
    return ModelDescription.from_plain(table, class_names)


def yolov8_description(scale: str | Scale, class_names: Sequence[str]) -> ModelDescription:
    """The published YOLOv8 network; see `published_description`."""
    return published_description("YOLOv8", scale, class_names)


@dataclass(frozen=True, slots=True)
class _Blocks:
    """The blocks at each position of the common structure.

    Attributes:
        stages: the blocks at strides 4, 8, 16, 32.
        deepest: the blocks after the last stage.
        up, down: the blocks at strides 16 and 8 on the path up, at 16 and 32 on the path down.
        stem: arguments of the first convolution after its channels.
        stage_channels: output channels of the stages, before scaling.
        halving: downsampling layer to strides 16 and 32 in the backbone, and to 32 on the path down.
        narrow_first: YOLOv5's: a 1×1 convolution halves the channels before each upsampling.
        head: the name of the head's layer.
    """

    stages: tuple[Block, Block, Block, Block]
    deepest: tuple[Block, ...]
    up: tuple[Block, Block]
    down: tuple[Block, Block]
    stem: tuple[int, ...] = (3, 2)
    stage_channels: tuple[int, int, int, int] = (256, 512, 512, 1024)
    halving: str = "Conv"
    narrow_first: bool = False
    head: str = "Detect"


def _blocks(model_family: str, scale: str) -> _Blocks:
    sppf: Block = (1, "SPPF", (5,))
    if model_family == "YOLOv5u":
        c3: Block = (3, "C3", (False,))
        return _Blocks(
            stem=(6, 2, 2),
            stages=((3, "C3", ()), (6, "C3", ()), (9, "C3", ()), (3, "C3", ())),
            stage_channels=(128, 256, 512, 1024),
            deepest=(sppf,),
            up=(c3, c3),
            down=(c3, c3),
            narrow_first=True,
        )
    if model_family == "YOLOv8":
        c2f: Block = (3, "C2f", ())
        return _Blocks(
            stages=((3, "C2f", (True,)), (6, "C2f", (True,)), (6, "C2f", (True,)), (3, "C2f", (True,))),
            stage_channels=(128, 256, 512, 1024),
            deepest=(sppf,),
            up=(c2f, c2f),
            down=(c2f, c2f),
        )
    if model_family == "YOLOv10":
        return _yolov10(scale, sppf)
    narrow: Block = (2, "C3k2", (False, 0.25))
    usual: Block = (2, "C3k2", (False,))
    deep: Block = (2, "C3k2", (True,))
    attention: Block = (2, "C2PSA", ())
    if model_family == "YOLO11":
        return _Blocks(
            stages=(narrow, narrow, deep, deep),
            deepest=(sppf, attention),
            up=(usual, usual),
            down=(usual, deep),
        )
    if model_family == "YOLO12":
        plain: Block = (2, "A2C2f", (False, -1))
        return _Blocks(
            stages=(narrow, narrow, (4, "A2C2f", (True, 4)), (4, "A2C2f", (True, 1))),
            deepest=(),
            up=(plain, plain),
            down=(plain, deep),
        )
    return _Blocks(
        stages=(narrow, narrow, deep, deep),
        deepest=((1, "SPPF", (5, 3, True)), attention),
        up=(deep, deep),
        down=(deep, (1, "C3k2", (True, 0.5, True))),
    )


def _yolov10(scale: str, sppf: Block) -> _Blocks:
    """Larger scales have more compact inverted blocks; n and s have large kernels."""
    usual: Block = (3, "C2f", ())
    compact: Block = (3, "C2fCIB", (True,))
    large: Block = (3, "C2fCIB", (True, True))
    fourth = {"n": (3, "C2f", (True,)), "s": large}.get(scale, compact)
    third: Block = (6, "C2fCIB", (True,)) if scale == "x" else (6, "C2f", (True,))
    return _Blocks(
        stages=((3, "C2f", (True,)), (6, "C2f", (True,)), third, fourth),
        stage_channels=(128, 256, 512, 1024),
        halving="SCDown",
        deepest=(sppf, (1, "PSA", ())),
        up=(compact if scale in ("b", "l", "x") else usual, usual),
        down=(usual if scale in ("n", "s") else compact, large if scale in ("n", "s") else compact),
        head="v10Detect",
    )


def _rows(blocks: _Blocks) -> tuple[list[Any], list[Any]]:
    """Backbone and head, rows as `LayerSpec.to_plain` writes them."""
    rows: list[Any] = []

    def add(layer: str, arguments: Sequence[Any], repeats: int = 1, source: int | list[int] = -1) -> int:
        rows.append([source, repeats, layer, list(arguments)])
        return len(rows) - 1

    def block(channels: int, kind: Block) -> int:
        repeats, layer, arguments = kind
        return add(layer, (channels, *arguments), repeats)

    add("Conv", (64, *blocks.stem))
    stages = []
    for index, (channels, reached, kind) in enumerate(
        zip(blocks.stage_channels, (128, 256, 512, 1024), blocks.stages, strict=True)
    ):
        add("Conv" if index < 2 else blocks.halving, (reached, 3, 2))
        stages.append(block(channels, kind))
    for kind in blocks.deepest:
        block(1024, kind)
    deepest = len(rows) - 1
    in_backbone = len(rows)
    joined = []
    for channels, finer, kind in zip((512, 256), (stages[2], stages[1]), blocks.up, strict=True):
        joined.append(add("Conv", (channels, 1, 1)) if blocks.narrow_first else len(rows) - 1)
        add("nn.Upsample", (None, 2, "nearest"))
        add("Concat", (1,), source=[-1, finer])
        finest = block(channels, kind)
    # The path down concatenates the inputs of the path up's upsamplings.
    levels = [finest]
    coarser = (joined[1], joined[0] if blocks.narrow_first else deepest)
    for channels, halving, other, kind in zip(
        (256, 512), ("Conv", blocks.halving), coarser, blocks.down, strict=True
    ):
        add(halving, (channels, 3, 2))
        add("Concat", (1,), source=[-1, other])
        levels.append(block(2 * channels, kind))
    add(blocks.head, ("nc",), source=list(levels))
    return rows[:in_backbone], rows[in_backbone:]


@dataclass(frozen=True, slots=True)
class ModelFacts:
    """Result of `describe`.

    Attributes:
        model_family: as `YOLOv8`, `YOLO11`; with `-P2` or `-P6` if the head also reads a finer or a coarser
            level; `unknown` for a custom network.
        scale: the letter, if the multipliers are the published ones of that family; empty for YOLOv3-tiny,
            which has one size; else None.
        parameters: of the network as given. Folding batch normalisation reduces them, and so does dropping
            the training-only branches of an end-to-end head.
        gflops: 10⁹ floating-point operations per image (a multiplication and an addition are two) of
            convolutions and attention, after `fuse`.
        end_to_end: whether it needs no NMS.
    """

    model_family: str
    scale: str | None
    parameters: int
    gflops: float
    end_to_end: bool


def describe(model: YoloModel, image_size: int = 640) -> ModelFacts:
    """Determine the facts of a network.

    Args:
        image_size: side of the square image for `gflops`, pixels, a multiple of the largest stride.

    Raises:
        ValueError: `image_size` is not a multiple.
    """
    largest = max(model.strides)
    if image_size < largest or image_size % largest:
        raise ValueError(f"image_size must be a multiple of {largest}, got {image_size}")
    model_family = model_family_of(model)
    return ModelFacts(
        model_family=model_family,
        scale=_scale(model.description, model_family),
        parameters=sum(parameter.numel() for parameter in model.parameters()),
        gflops=_gflops(model.description, image_size),
        end_to_end=model.end_to_end,
    )


def model_family_of(model: YoloModel) -> str:
    """Determine only `ModelFacts.model_family`, which is fast."""
    description, strides = model.description, model.strides
    layers = {row.layer for row in description.rows}
    if layers & {"v10Detect", "SCDown", "C2fCIB"}:
        model_family = "YOLOv10"
    elif "A2C2f" in layers:
        model_family = "YOLO12"
    elif "C3k2" in layers:
        model_family = "YOLO26" if description.reg_max == 1 else "YOLO11"
    elif layers & {"RepNCSPELAN4", "ELAN1"}:
        model_family = "YOLOv9"
    elif "nn.ZeroPad2d" in layers:
        return "YOLOv3-tiny"
    elif "C2f" in layers:
        model_family = "YOLOv8"
    elif "C3" in layers:
        model_family = "YOLOv5u"
    else:
        return "unknown"
    if strides == _USUAL_STRIDES:
        return model_family
    finest, coarsest = strides[0].bit_length() - 1, strides[-1].bit_length() - 1
    return f"{model_family}-P{finest if finest < 3 else coarsest}"


def _scale(description: ModelDescription, model_family: str) -> str | None:
    if model_family == "YOLOv3-tiny":
        return ""
    if model_family == "YOLOv9":
        first, pooling = (
            next((row.arguments[0] for row in description.rows if row.layer == layer), None)
            for layer in ("Conv", "SPPELAN")
        )
        letter = _YOLOV9_SCALES.get((first, pooling))
        two_backbones = any(row.layer == "CBLinear" for row in description.rows)
        return "e" if two_backbones and letter == "c" else letter
    for letter, (depth, width, most) in SCALES.get(model_family.partition("-")[0], {}).items():
        # The first releases had a table per scale, with channels limited in the rows.
        if (description.depth_multiple, description.width_multiple) == (depth, width) and (
            description.max_channels in (None, most)
        ):
            return letter
    return None


def _gflops(description: ModelDescription, image_size: int) -> float:
    # On the meta device: nothing is computed, and the caller's network is unchanged.
    model = build_shapes(description).fuse()
    with torch.device("meta"):
        image = torch.empty(1, description.channels, image_size, image_size)
    counter = FlopCounterMode(display=False)
    with torch.inference_mode(), counter:
        model(image)
    return counter.get_total_flops() / 1e9
