"""Checkpoints as Ultralytics writes them: classes of that library's names, pickled by `torch.save`."""

from __future__ import annotations

import copy
import io
import pickle
import sys
import types
import zipfile
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

from vision.training.published import yolov8_description
from vision.yolo.architecture import ModelDescription, YoloModel, build

Classes = dict[str, type[nn.Module]]
"""The foreign library's names, each with a class of that name."""

NAMES = ("car", "dog")
SMALL = (0.1, 0.01, 64)
BLOCKS = (
    *("A2C2f", "AAttn", "ABlock", "Attention", "Bottleneck", "C2", "C2PSA", "C2f", "C2fCIB", "C3", "C3Ghost"),
    *("C3k", "C3k2", "CIB", "DFL", "PSA", "PSABlock", "RepVGGDW", "SCDown", "SPPF"),
)
FOREIGN = {
    **dict.fromkeys(BLOCKS, "ultralytics.nn.modules.block"),
    **dict.fromkeys(("Concat", "Conv", "DWConv"), "ultralytics.nn.modules.conv"),
    **dict.fromkeys(("Detect", "v10Detect"), "ultralytics.nn.modules.head"),
    **dict.fromkeys(("DetectionModel", "SegmentationModel"), "ultralytics.nn.tasks"),
    "DictConfig": "omegaconf.dictconfig",
}
# Attributes with other names there.
FOREIGN_NAMES = {"AreaAttention": "AAttn", "LargeKernelDWConv": "RepVGGDW"}


def trained_model(description: ModelDescription | None = None, seed: int = 0) -> YoloModel:
    """A small network whose normalisations have statistics."""
    model = copy.deepcopy(_small(seed)) if description is None else _trained(description, seed)
    torch.manual_seed(seed)  # What the test draws next is the same whether or not the network was cached.
    return model


@cache
def _small(seed: int) -> YoloModel:
    return _trained(yolov8_description(SMALL, NAMES), seed)


def _trained(description: ModelDescription, seed: int) -> YoloModel:
    torch.manual_seed(seed)
    model = build(description)
    for _ in range(2):
        model(torch.rand(2, 3, 64, 64))
    return model.eval()


def rotated(description: ModelDescription) -> ModelDescription:
    """The same network with a head of rotated boxes."""
    *rows, last = description.head
    return replace(description, head=(*rows, replace(last, layer="OBB", arguments=("nc", 1))))


def foreign_classes(monkeypatch: pytest.MonkeyPatch, modules: dict[str, str]) -> Classes:
    classes = {}
    for name, module_name in modules.items():
        parts = module_name.split(".")
        for end in range(1, len(parts) + 1):
            package = ".".join(parts[:end])
            if package not in sys.modules:
                monkeypatch.setitem(sys.modules, package, types.ModuleType(package))
        made = type(name, (nn.Module,), {"__module__": module_name})
        monkeypatch.setattr(sys.modules[module_name], name, made, raising=False)
        classes[name] = made
    return classes


def as_foreign(model: YoloModel, classes: Classes, **attributes: Any) -> Any:
    """Our network's modules with the foreign library's class names and attributes."""

    def relabelled(module: nn.Module) -> nn.Module:
        module = copy.copy(module)
        name = type(module).__name__
        name = FOREIGN_NAMES.get(name, name)
        if name in classes:
            foreign = nn.Module.__new__(classes[name])
            foreign.__dict__ = dict(module.__dict__)
            module = foreign
        module.__dict__["_modules"] = {
            key: None if child is None else relabelled(child) for key, child in module._modules.items()
        }
        module.__dict__["_parameters"] = {
            key: None if weight is None else nn.Parameter(weight.detach().half())
            for key, weight in module._parameters.items()
        }
        module.__dict__["_buffers"] = {
            key: buffer.half() if buffer is not None and buffer.is_floating_point() else buffer
            for key, buffer in module._buffers.items()
        }
        return module

    table = model.description.to_plain()
    whole: Any = classes["DetectionModel"]()
    whole.model = nn.Sequential(*[relabelled(layer) for layer in model.model])
    head = whole.model[-1]
    strides = torch.tensor([float(stride) for stride in model.strides])
    head.stride, head.reg_max = strides, model.description.reg_max
    whole.yaml = {key: table[key] for key in ("nc", "backbone", "head", "depth_multiple", "width_multiple")}
    whole.yaml |= {"max_channels": table["max_channels"], "yaml_file": "yolov8.yaml", "ch": 3}
    whole.names = dict(enumerate(model.class_names))
    whole.stride = strides
    for name, value in attributes.items():
        setattr(whole, name, value)
    return whole


def save_foreign(path: Path, model: nn.Module, **content: Any) -> Path:
    whole = {"epoch": -1, "version": "8.0.0", "license": "AGPL-3.0", "model": model, "ema": None} | content
    torch.save(whole, path)
    return path


def assert_same_maps(ours: YoloModel, theirs: YoloModel) -> None:
    x = torch.rand(1, 3, 64, 96)
    with torch.inference_mode():
        for a, b in zip(ours(x), theirs(x), strict=True):
            torch.testing.assert_close(a, b, rtol=0.02, atol=0.02)  # The file holds float16.


class Calls:
    """Pickles as a call of `function` with `arguments`."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.call = (function, arguments)

    def __reduce__(self) -> Any:
        return self.call


class Global:
    """Pickles as a reference to `module.name`, whether or not that exists."""

    def __init__(self, module: str, name: str) -> None:
        self.module, self.name = module, name


class Mentioning(pickle._Pickler):
    """A pickler that writes `Global` by name and storages as torch does."""

    def persistent_id(self, value: Any) -> Any:
        return value[1] if isinstance(value, tuple) and value[:1] == ("PERSISTENT",) else None

    def save(self, value: Any, save_persistent_id: bool = True) -> Any:
        if isinstance(value, Global):
            self.write(b"c" + f"{value.module}\n{value.name}\n".encode())  # type: ignore[attr-defined]  # not in typeshed
            return None
        return super().save(value, save_persistent_id)  # type: ignore[misc]  # not in typeshed


def archive(path: Path, pickled: bytes, members: dict[str, bytes] | None = None) -> Path:
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("model/data.pkl", pickled)
        for name, data in ({"version": b"3\n"} | (members or {})).items():
            file.writestr(f"model/{name}", data)
    return path


def dumped(value: Any) -> bytes:
    buffer = io.BytesIO()
    Mentioning(buffer, protocol=2).dump(value)
    return buffer.getvalue()


# Our own format
