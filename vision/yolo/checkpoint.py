"""Checkpoints: our own pair of files, and Ultralytics' `.pt`, both read without running code from them.

Our own is `NAME.safetensors` with `NAME.yaml` (`checkpoint_pair`). The first version was a dictionary that
`torch.load(weights_only=True)` also reads, `{"format", "description", "state_dict" (float16), "metadata"}`.
An Ultralytics checkpoint is a pickled `DetectionModel`; its description, class names and tensors are taken
from the stubs that `torch_archive` creates. Its model table is interpreted by the release that builds the
network, and releases differ: 8.3.0 gave YOLOv8 the light class branches of YOLO11, 8.4.0 omitted an
activation that later returned, a channel count equal to the number of classes was scaled or not. The layers
in the file were trained, so they take precedence.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from vision.foreign.layouts import TASKS
from vision.plain_yaml import numbered
from vision.runtimes.exported import kind_of
from vision.yolo.architecture import ArchitectureError, YoloModel, build_shapes
from vision.yolo.checkpoint_error import CheckpointError, UnsafeCheckpointError, one_line, shown
from vision.yolo.checkpoint_file import read_archive
from vision.yolo.checkpoint_pair import WEIGHTS_SUFFIX, is_pair, read_pair, write_pair
from vision.yolo.description import (
    A2C2F_DEFAULTS,
    C3K2_DEFAULTS,
    PUBLISHED_MLP_RATIOS,
    SPPF_DEFAULTS,
    LayerSpec,
    ModelDescription,
)
from vision.yolo.torch_archive import Stub

__all__ = [
    "FORMAT",
    "CheckpointError",
    "LoadedModel",
    "UnsafeCheckpointError",
    "load_checkpoint",
    "save_checkpoint",
]

FORMAT = "mavlink-companion.yolo.v1"
# Class of model → its task. Boxes of segmentation and pose come from the same branches as a detector's.
_MODELS = {
    "ultralytics.nn.tasks.DetectionModel": "detect",
    "ultralytics.nn.tasks.YOLOv10DetectionModel": "detect",  # As the authors of YOLOv10 published it.
    "ultralytics.nn.tasks.SegmentationModel": "segment",
    "ultralytics.nn.tasks.PoseModel": "pose",
    "ultralytics.nn.tasks.OBBModel": "obb",
}
_TASK_HEADS = ("Segment", "Pose")
# Branches of such a head that are read past: masks, their prototypes, key points.
_OTHER_BRANCHES = ("cv4", "proto", "one2one_cv4")
_DEEPEST = 16
_MOST_NODES = 100_000
_MOST_MODULES = 20_000
_LONGEST_NAME = 500
# Of all texts of a description together, each counted where it is used: a file can refer to one many times.
_LONGEST_TEXT = 1 << 20
# Of all layers together: the largest published networks have about eighty.
_MOST_REPEATS = 256

Modules = Mapping[str, Stub]
"""Dotted name → module, `model.<row>` for the rows."""
# The last convolution of each layer, by its name: its channels are the layer's output.
_LAST_CONVOLUTIONS = ("cv3.conv", "cv2.conv", "conv")


@dataclass(frozen=True, slots=True)
class LoadedModel:
    """A loaded checkpoint.

    Attributes:
        model: float32, on the CPU, in evaluation mode, batch normalisation not folded.
        class_names: id → name.
        description: the architecture it was built from.
        metadata: plain values of the file: licence, origin, score and others.
    """

    model: YoloModel
    class_names: tuple[str, ...]
    description: ModelDescription
    metadata: dict[str, Any]


def save_checkpoint(path: str | Path, model: YoloModel, *, metadata: Mapping[str, Any]) -> None:
    """Write `model` to `path` atomically, weights as float16 (those beyond its range as float32).

    Args:
        path: `NAME.safetensors` (its description goes to `NAME.yaml` beside it), or `.pt`.
        metadata: plain values only (dicts, lists, strings, numbers, booleans, None), else `TypeError`.
    """
    path = Path(path)
    try:
        plain_metadata = _plain(dict(metadata))
    except CheckpointError as error:
        raise TypeError(f"metadata must be plain values: {error}") from None
    description = model.description.to_plain()
    weights = {name: _compact(tensor) for name, tensor in model.state_dict().items()}
    if path.suffix == WEIGHTS_SUFFIX:
        write_pair(path, description, weights, plain_metadata)
        return
    content = {
        "format": FORMAT,
        "description": description,
        "state_dict": weights,
        "metadata": plain_metadata,
    }
    # A reader, or a start after a power failure, sees either the old or the new file.
    partial = path.with_name(f"{path.name}.partial")
    torch.save(content, partial)
    os.replace(partial, path)


def load_checkpoint(path: str | Path) -> LoadedModel:
    """Read our own checkpoint (either file of a pair, or a `.pt`) or an Ultralytics detection checkpoint.

    Of Ultralytics': YOLOv3-tiny, v5u, v8, v9, v10, 11, 12, 26.

    Raises:
        UnsafeCheckpointError: the file requests a function call, named in the message.
        CheckpointError: missing, damaged, an export, of another kind, or its weights do not fit.
    """
    if kind_of(Path(path)) is not None and Path(path).is_file():
        raise CheckpointError(
            one_line(f"{path}: is an exported file; a checkpoint is needed (.pt or .safetensors)")
        )
    pair = is_pair(Path(path))
    content = read_pair(Path(path)) if pair else read_archive(path)
    try:
        return _from_description(content) if pair else _interpret(content)
    except (CheckpointError, ArchitectureError) as error:
        kind = type(error) if isinstance(error, CheckpointError) else CheckpointError
        raise kind(one_line(f"{path}: {error}")) from None
    # Of values nested too deeply, and of tensors of an unusual kind.
    except (AttributeError, RuntimeError, TypeError) as error:
        raise CheckpointError(
            one_line(f"{path}: holds values that no checkpoint has ({type(error).__name__}: {error!s:.200})")
        ) from None


def _interpret(content: Any) -> LoadedModel:
    if not isinstance(content, dict):
        raise CheckpointError("not a detection checkpoint: expected a dictionary with a model in it")
    if "format" in content:
        if content["format"] != FORMAT:
            raise CheckpointError(f"has format {shown(content['format'])}, this version reads {FORMAT!r}")
        return _from_description(content)
    # The averaged weights, if training kept them, are the better ones.
    record = content["model"] if content.get("ema") is None and "model" in content else content.get("ema")
    if not isinstance(record, Stub):
        raise CheckpointError(
            "holds no model: expected our own format, or Ultralytics' with the model under 'ema' or 'model'"
        )
    return _interpret_ultralytics(record, content)


def _from_description(content: dict[Any, Any]) -> LoadedModel:
    """Build a network from `description`, `state_dict` and `metadata`."""
    description = ModelDescription.from_plain(_plain_dictionary(content, "description"))
    weights = content.get("state_dict")
    if not isinstance(weights, dict):
        raise CheckpointError("has no state_dict of tensors")
    model = _with_weights(description, weights)
    return LoadedModel(model, description.class_names, description, _plain_dictionary(content, "metadata"))


def _interpret_ultralytics(record: Stub, content: dict[Any, Any]) -> LoadedModel:
    task = _MODELS.get(record.name)
    if task is None:
        raise CheckpointError(f"holds a {record.name.rpartition('.')[2]}; only detection models can be used")
    table = _plain_dictionary(record.state, "yaml")
    modules = dict(_modules(record))
    if task in ("segment", "pose"):
        table, modules = _boxes_only(table, modules)
    description = ModelDescription.from_plain(table, _class_names(record, table))
    description = as_trained(description, modules)
    model = _with_weights(description, dict(_weights(modules)))
    stride = modules[f"model.{len(description.rows) - 1}"].state.get("stride")
    if isinstance(stride, Tensor):
        # Only the first few: a large tensor as a list of numbers would be many times as large.
        found = stride[:9].tolist() if stride.dim() == 1 else f"of the shape {tuple(stride.shape)}"
        if found != list(model.strides):
            raise CheckpointError(f"its head has strides {shown(found)}, not {model.strides}")
    for name, module in model.named_modules():
        trained = modules.get(name)
        if isinstance(module, nn.BatchNorm2d) and trained is not None:
            epsilon = trained.state.get("eps", module.eps)
            if type(epsilon) is not float or not 0 < epsilon < 1:
                raise CheckpointError(f"{name} has the epsilon {shown(epsilon)}, expected a small number")
            module.eps = epsilon
    metadata = {"origin": f"Ultralytics {_text(content, 'version')}".strip()}
    if task != "detect":
        metadata["task"] = f"{task}; {TASKS[task]}"
    for key, source in (("licence", "license"), ("date", "date")):
        if _text(content, source):
            metadata[key] = _text(content, source)
    return LoadedModel(model, description.class_names, description, metadata)


def _boxes_only(table: dict[Any, Any], modules: dict[str, Stub]) -> tuple[dict[Any, Any], dict[str, Stub]]:
    """The table and the modules of a segmentation or pose network as those of a detector."""
    rows = [*_rows(table, "backbone"), *_rows(table, "head")]
    last = rows[-1] if rows else None
    if not isinstance(last, list) or len(last) != 4 or last[2] not in _TASK_HEADS:
        raise CheckpointError(f"its last row must be one of {', '.join(_TASK_HEADS)}, got {shown(last)}")
    table = {**table, "head": [*_rows(table, "head")[:-1], [*last[:2], "Detect", ["nc"]]]}
    past = tuple(f"model.{len(rows) - 1}.{branch}" for branch in _OTHER_BRANCHES)
    kept = {
        name: module
        for name, module in modules.items()
        if not any(name == branch or name.startswith(f"{branch}.") for branch in past)
    }
    return table, kept


def _rows(table: dict[Any, Any], key: str) -> list[Any]:
    rows = table.get(key)
    if not isinstance(rows, list):
        raise CheckpointError(f"its `{key}` is not a list")
    return rows


def _text(content: dict[Any, Any], key: str) -> str:
    value = content.get(key)
    return _utf8(value[:200]) if isinstance(value, str) else ""


def _class_names(record: Stub, table: dict[Any, Any]) -> list[str]:
    names = _plain(record.state.get("names"))
    if isinstance(names, dict):
        names = numbered(names)
        if names is None:
            raise CheckpointError("its class names are not numbered from 0")
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise CheckpointError("has no class names")
    if table.get("nc") != len(names):
        raise CheckpointError(f"names {len(names)} classes, its network has {shown(table.get('nc'))}")
    return names


def _modules(record: Stub) -> Iterator[tuple[str, Stub]]:
    """Every module below `record` with its dotted name."""
    waiting = [("", record, 0)]
    seen = 0
    while waiting:
        name, module, depth = waiting.pop()
        seen += 1
        if depth > _DEEPEST or seen > _MOST_MODULES or len(waiting) > _MOST_MODULES:
            raise CheckpointError("its modules contain each other, or are too many")
        if len(name) > _LONGEST_NAME:
            raise CheckpointError(f"it has a module whose name has {len(name)} characters")
        yield name, module
        children = module.state.get("_modules", {})
        if not isinstance(children, dict):
            raise CheckpointError(f"the modules of {name or 'the model'} are not a dictionary")
        for key, child in children.items():
            if isinstance(child, Stub):
                waiting.append((f"{name}.{key}" if name else str(key), child, depth + 1))
            elif child is not None:
                raise CheckpointError(f"{name}.{key} is not a module")


def _weights(modules: dict[str, Stub]) -> Iterator[tuple[str, object]]:
    """Each tensor with its dotted name, removed from its module so that there is no second reference."""
    for name, module in modules.items():
        non_persistent = module.state.get("_non_persistent_buffers_set", set())
        for kind in ("_parameters", "_buffers"):
            tensors = module.state.get(kind, {})
            if not isinstance(tensors, dict):
                raise CheckpointError(f"{name}'s {kind} are not a dictionary")
            for key in list(tensors):
                _check_name(key)
                tensor = tensors.pop(key)
                if tensor is None or (isinstance(non_persistent, set) and key in non_persistent):
                    continue
                yield f"{name}.{key}", tensor


def _check_name(name: object) -> None:
    if not isinstance(name, str) or len(name) > _LONGEST_NAME:
        raise CheckpointError(f"has a weight named {shown(name)}")


def _with_weights(description: ModelDescription, weights: dict[Any, Any]) -> YoloModel:
    """Build the described network with exactly these weights; missing and unknown names are errors.

    Empties `weights`, so that no tensor is held twice for longer than its layer needs.
    """
    _check_sizes(description, weights)
    # Shapes only: a description larger than the file must not cost memory.
    model = build_shapes(description)
    if not any(name.endswith(".bn.weight") for name in weights):
        model.fuse()
    expected = model.state_dict()
    missing, unknown = sorted(expected.keys() - weights.keys()), sorted(weights.keys() - expected.keys())
    if missing or unknown:
        raise CheckpointError(
            f"its weights do not fit its description: {len(missing)} missing ({', '.join(missing[:3])}), "
            f"{len(unknown)} unknown ({', '.join(map(str, unknown[:3]))})"
        )
    for name, tensor in weights.items():
        if tensor.shape != expected[name].shape:
            raise CheckpointError(
                f"{name} should have the shape {tuple(expected[name].shape)}, it has {tuple(tensor.shape)}"
            )
        if tensor.is_floating_point() != expected[name].is_floating_point():
            raise CheckpointError(f"{name} should be {expected[name].dtype}, it is {tensor.dtype}")
        if tensor.is_floating_point() and not bool(tensor.isfinite().all()):
            raise CheckpointError(f"{name} has numbers that are not finite")
    converted = {}
    for name, target in expected.items():
        converted[name] = weights.pop(name).to(target.dtype, copy=True).contiguous()
    model.load_state_dict(converted, strict=True, assign=True)
    return model.eval()


def _check_sizes(description: ModelDescription, weights: dict[Any, Any]) -> None:
    """Reject what makes a small file large: repeated layers, and tensors that share storage."""
    repeats = sum(max(1, round(row.repeats * description.depth_multiple)) for row in description.rows)
    if repeats > _MOST_REPEATS:
        raise CheckpointError(f"describes {repeats} layers, the limit is {_MOST_REPEATS}")
    check_weights(weights)


def check_weights(weights: dict[Any, Any]) -> None:
    """Raise `CheckpointError` unless these are tensors by name, plain and each with numbers of its own.

    Parameters become tensors without a gradient.
    """
    for name, tensor in weights.items():
        _check_name(name)
        plain = type(tensor) in (Tensor, nn.Parameter) and tensor.layout is torch.strided
        if not plain or tensor.device.type != "cpu" or tensor.is_quantized:
            raise CheckpointError(f"{name} is not a tensor of numbers")
        weights[name] = Tensor.detach(tensor)
    storages = {tensor.untyped_storage().data_ptr(): tensor.untyped_storage() for tensor in weights.values()}
    if sum(tensor.nbytes for tensor in weights.values()) > sum(map(len, storages.values())):
        raise CheckpointError("uses the same numbers for several weights; it is not a checkpoint")


def _compact(tensor: Tensor) -> Tensor:
    tensor = tensor.detach().cpu()
    if not tensor.is_floating_point():
        return tensor.clone()
    half = tensor.half()
    return half if bool(half.isfinite().all()) else tensor.float().clone()


def _plain_dictionary(content: Mapping[Any, Any], key: str) -> dict[Any, Any]:
    value = _plain(content.get(key))
    if not isinstance(value, dict):
        raise CheckpointError(f"has no {key}: expected a table")
    return value


def _plain(value: Any) -> Any:
    """A bounded copy of containers and scalars, so that later code never follows shared references."""
    nodes_left, text_left = _MOST_NODES, _LONGEST_TEXT

    def copy(value: Any, depth: int) -> Any:
        nonlocal nodes_left, text_left
        nodes_left -= 1
        if isinstance(value, str):
            text_left -= len(value)
        if depth > _DEEPEST or nodes_left < 0 or text_left < 0:
            raise CheckpointError("its description is too deep or too long")
        if isinstance(value, str):
            return _utf8(value)
        if value is None or type(value) in (bool, int, float):
            return value
        if isinstance(value, dict):
            return {copy(key, depth + 1): copy(item, depth + 1) for key, item in value.items()}
        if isinstance(value, list | tuple):
            return [copy(item, depth + 1) for item in value]
        raise CheckpointError(f"has a {type(value).__name__} where a plain value belongs")

    return copy(value, 0)


def _utf8(text: str) -> str:
    """The text without halves of characters, which torch's reader accepts and nothing can print."""
    return text.encode("utf-8", "replace").decode()


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
