"""Model facts: family and scale, recognised from the layers, and number of parameters and operations."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch.utils.flop_counter import FlopCounterMode

from vision.yolo.architecture import YoloModel, build_shapes
from vision.yolo.description import ModelDescription
from vision.yolo.published import SCALES

_USUAL_STRIDES = (8, 16, 32)


@dataclass(frozen=True, slots=True)
class ModelFacts:
    """Result of `describe`.

    Attributes:
        model_family: as `YOLOv8`, `YOLO11`; with `-P2` or `-P6` if the head also reads a finer or a coarser
            level; `unknown` for a custom network.
        scale: the letter, if the multipliers are the published ones of that family; else None.
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
