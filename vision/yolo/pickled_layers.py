"""Corrections of a checkpoint's model table by its pickled layers.

A table is interpreted by the release that builds the network, and releases differ: 8.3.0 gave YOLOv8 the
light class branches of YOLO11, 8.4.0 omitted an activation that later returned, a channel count equal to the
number of classes was scaled or not. The layers in the file were trained, so they take precedence.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from torch import Tensor

from vision.yolo.description import ModelDescription
from vision.yolo.layer_spec import (
    A2C2F_DEFAULTS,
    C3K2_DEFAULTS,
    PUBLISHED_MLP_RATIOS,
    SPPF_DEFAULTS,
    LayerSpec,
)
from vision.yolo.safe_pickle import CheckpointError, Stub, shown

Modules = Mapping[str, Stub]
"""Dotted name → module, `model.<row>` for the rows."""

# The last convolution of each layer, by its name: its channels are the layer's output.
_LAST_CONVOLUTIONS = ("cv3.conv", "cv2.conv", "conv")


def as_trained(description: ModelDescription, modules: Modules) -> ModelDescription:
    """The description corrected by the layers. Raises `CheckpointError`, `ArchitectureError`."""
    rows = tuple(_corrected(row, f"model.{index}", modules) for index, row in enumerate(description.rows))
    in_backbone = len(description.backbone)
    description = dataclasses.replace(description, backbone=rows[:in_backbone], head=rows[in_backbone:])
    description = _with_head(description, f"model.{len(rows) - 1}", modules)
    activation = _activation(modules) or description.activation
    return dataclasses.replace(
        description, activation=activation, unscaled_channels=_unscaled(description, modules)
    )


def kind(modules: Modules, name: str) -> str:
    """The class name of a module, without its package; empty if there is no such module."""
    module = modules.get(name)
    return "" if module is None else module.name.rpartition(".")[2]


def _tensor(modules: Modules, name: str, parameter: str = "weight") -> Tensor | None:
    module = modules.get(name)
    tensors = {} if module is None else module.state.get("_parameters")
    tensor = tensors.get(parameter) if isinstance(tensors, dict) else None
    return tensor if isinstance(tensor, Tensor) and tensor.dim() > 0 else None


def _corrected(row: LayerSpec, name: str, modules: Modules) -> LayerSpec:
    first = kind(modules, f"{name}.m.0")
    if row.layer == "C3k2" and first:
        if first == "Sequential":
            return row.with_argument(3, True, C3K2_DEFAULTS)
        return row.with_argument(3, False, C3K2_DEFAULTS).with_argument(1, first == "C3k", C3K2_DEFAULTS)
    if row.layer == "A2C2f" and first == "Sequential":
        row = row.with_argument(1, True, A2C2F_DEFAULTS)
        row = row.with_argument(3, _tensor(modules, name, "gamma") is not None, A2C2F_DEFAULTS)
        mlp_weight = _tensor(modules, f"{name}.m.0.0.mlp.0.conv")
        if mlp_weight is not None and mlp_weight.dim() == 4:
            row = row.with_argument(4, _mlp_ratio(row, mlp_weight), A2C2F_DEFAULTS)
        return row
    if row.layer == "SPPF" and kind(modules, f"{name}.cv1.act"):
        return row.with_argument(4, kind(modules, f"{name}.cv1.act") != "Identity", SPPF_DEFAULTS)
    return row


def _mlp_ratio(row: LayerSpec, mlp_weight: Tensor) -> Any:
    """The row's ratio, or a published one, if it fits the trained layer; else the trained layer's ratio."""
    outputs, inputs = mlp_weight.shape[:2]
    given = row.arguments[4] if len(row.arguments) > 4 else A2C2F_DEFAULTS[4]
    for ratio in (given, *PUBLISHED_MLP_RATIOS):
        if type(ratio) in (int, float) and 0 < ratio < 64 and int(inputs * ratio) == outputs:
            return ratio
    # Inverse of rounding down: half a channel more avoids losing one.
    return (outputs + 0.5) / max(inputs, 1)


def _with_head(description: ModelDescription, name: str, modules: Modules) -> ModelDescription:
    head = modules.get(name)
    if head is None:
        return description
    branches = "cv3" if kind(modules, f"{name}.cv3.0") else "one2one_cv3"
    light = kind(modules, f"{name}.{branches}.0.0") == "Sequential"
    last = _tensor(modules, f"{name}.{branches}.0.2")
    width = last.shape[1] if last is not None and last.dim() == 4 else None
    bins = head.state.get("reg_max", description.reg_max)
    if type(bins) is not int:
        raise CheckpointError(f"its head has the reg_max {shown(bins)}, expected a whole number")
    return dataclasses.replace(
        description,
        reg_max=bins,
        light_classes=light,
        # Late releases also store which head was used last, often the other one, after a validation with NMS.
        end_to_end=bool(kind(modules, f"{name}.one2one_cv3")),
        class_width=width,
    )


def _activation(modules: Modules) -> str | None:
    activations = {
        kind(modules, name)
        for name, module in modules.items()
        if name.endswith(".act") and ".activation." in module.name
    }
    if len(activations) > 1:
        raise CheckpointError(f"mixes the activations {', '.join(sorted(activations))}")
    return next(iter(activations), None)


def _unscaled(description: ModelDescription, modules: Modules) -> tuple[int, ...]:
    """The number of classes, if a row with that many channels was not scaled."""
    count = len(description.class_names)
    for index, row in enumerate(description.rows):
        if not row.arguments or row.arguments[0] != count or type(row.arguments[0]) is not int:
            continue
        for convolution in _LAST_CONVOLUTIONS:
            weight = _tensor(modules, f"model.{index}.{convolution}")
            if weight is not None:
                return (count,) if weight.shape[0] == count else ()
    return ()
