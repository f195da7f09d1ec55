"""Checkpoints: ours, Ultralytics', damaged ones, hostile ones.

The Ultralytics-like file is made here: classes of that library's names, pickled by `torch.save` as it would.
"""

from __future__ import annotations

import collections
import contextlib
import copy
import dataclasses
import io
import pathlib
import pickle
import struct
import sys
import types
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

from vision.yolo import torch_archive
from vision.yolo.architecture import ModelDescription, YoloModel, build, yolov8_description
from vision.yolo.checkpoint import (
    FORMAT,
    CheckpointError,
    UnsafeCheckpointError,
    load_checkpoint,
    save_checkpoint,
)
from vision.yolo.layers import Conv
from vision.yolo.published import SCALES, published_description
from vision.yolo.safe_pickle import Admitted, unpickle

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
# What is called otherwise there.
FOREIGN_NAMES = {"AreaAttention": "AAttn", "LargeKernelDWConv": "RepVGGDW"}


def trained_model(description: ModelDescription | None = None, seed: int = 0) -> YoloModel:
    """A small network whose normalisations have seen something."""
    torch.manual_seed(seed)
    model = build(description or yolov8_description(SMALL, NAMES))
    for _ in range(2):
        model(torch.rand(2, 3, 64, 64))
    return model.eval()


@pytest.fixture
def foreign(monkeypatch: pytest.MonkeyPatch) -> dict[str, type[nn.Module]]:
    """Classes of the foreign library's names, importable only while a test runs."""
    return foreign_classes(monkeypatch, FOREIGN)


@pytest.fixture
def early_foreign(monkeypatch: pytest.MonkeyPatch) -> dict[str, type[nn.Module]]:
    """As the first releases had them: all layers in one file."""
    places = {
        name: "ultralytics.nn.modules" if place.startswith("ultralytics.nn.modules") else place
        for name, place in FOREIGN.items()
    }
    return foreign_classes(monkeypatch, places)


def foreign_classes(monkeypatch: pytest.MonkeyPatch, places: dict[str, str]) -> dict[str, type[nn.Module]]:
    classes = {}
    for name, module_name in places.items():
        parts = module_name.split(".")
        for end in range(1, len(parts) + 1):
            package = ".".join(parts[:end])
            if package not in sys.modules:
                monkeypatch.setitem(sys.modules, package, types.ModuleType(package))
        made = type(name, (nn.Module,), {"__module__": module_name})
        monkeypatch.setattr(sys.modules[module_name], name, made, raising=False)
        classes[name] = made
    return classes


def as_foreign(model: YoloModel, classes: dict[str, type[nn.Module]], **attributes: Any) -> nn.Module:
    """Our network's modules, relabelled as the foreign library's."""

    def relabelled(module: nn.Module) -> nn.Module:
        module = copy.copy(module)
        name = type(module).__name__
        name = FOREIGN_NAMES.get(name, name)
        if name in classes:
            stranger = nn.Module.__new__(classes[name])
            stranger.__dict__ = dict(module.__dict__)
            module = stranger
        module.__dict__["_modules"] = {key: relabelled(child) for key, child in module._modules.items()}
        return module

    model = copy.deepcopy(model)
    table = model.description.to_plain()
    whole = classes["DetectionModel"]()
    whole.model = nn.Sequential(*[relabelled(layer) for layer in model.model])
    head = whole.model[-1]
    head.stride, head.reg_max = torch.tensor([8.0, 16.0, 32.0]), model.reg_max
    whole.yaml = {key: table[key] for key in ("nc", "backbone", "head", "depth_multiple", "width_multiple")}
    whole.yaml |= {"max_channels": table["max_channels"], "yaml_file": "yolov8.yaml", "ch": 3}
    whole.names = dict(enumerate(model.class_names))
    whole.stride = torch.tensor([8.0, 16.0, 32.0])
    for name, value in attributes.items():
        setattr(whole, name, value)
    return whole.half()


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
    """Pickles as a mere mention of `module.name`, whether or not that exists."""

    def __init__(self, module: str, name: str) -> None:
        self.module, self.name = module, name


class Mentioning(pickle._Pickler):
    """A pickler that writes `Global` by name and storages as torch does."""

    def persistent_id(self, value: Any) -> Any:
        return value[1] if isinstance(value, tuple) and value[:1] == ("PERSISTENT",) else None

    def save(self, value: Any, save_persistent_id: bool = True) -> Any:
        if isinstance(value, Global):
            self.write(b"c" + f"{value.module}\n{value.name}\n".encode())
            return None
        return super().save(value, save_persistent_id)


def archive(path: Path, pickled: bytes, members: dict[str, bytes] | None = None) -> Path:
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("model/data.pkl", pickled)
        for name, data in (members or {"version": b"3\n"}).items():
            file.writestr(f"model/{name}", data)
    return path


def dumped(value: Any) -> bytes:
    buffer = io.BytesIO()
    Mentioning(buffer, protocol=2).dump(value)
    return buffer.getvalue()


# Our own format


def test_a_saved_model_comes_back_the_same(tmp_path: Path) -> None:
    model = trained_model()
    save_checkpoint(tmp_path / "m.pt", model, metadata={"licence": "Apache-2.0", "score": {"map50": 0.9}})
    loaded = load_checkpoint(tmp_path / "m.pt")
    assert loaded.class_names == NAMES
    assert loaded.description == model.description
    assert loaded.metadata == {"licence": "Apache-2.0", "score": {"map50": 0.9}}
    assert not loaded.model.training
    assert {parameter.dtype for parameter in loaded.model.parameters()} == {torch.float32}
    assert_same_maps(model, loaded.model)
    assert [path.name for path in tmp_path.iterdir()] == ["m.pt"]


def test_a_saved_model_is_readable_by_torch_without_trust(tmp_path: Path) -> None:
    save_checkpoint(tmp_path / "m.pt", trained_model(), metadata={})
    content = torch.load(tmp_path / "m.pt", weights_only=True)
    assert content["format"] == FORMAT
    floating = {tensor.dtype for tensor in content["state_dict"].values() if tensor.is_floating_point()}
    assert floating == {torch.float16}


def test_a_loaded_model_can_be_trained_further(tmp_path: Path) -> None:
    save_checkpoint(tmp_path / "m.pt", trained_model(), metadata={})
    model = load_checkpoint(tmp_path / "m.pt").model.train()
    sum(level.square().sum() for level in model(torch.rand(2, 3, 64, 64))).backward()
    assert model.model[0].conv.weight.grad is not None


def test_a_model_with_folded_normalisation_comes_back_folded(tmp_path: Path) -> None:
    model = trained_model().fuse()
    save_checkpoint(tmp_path / "m.pt", model, metadata={})
    loaded = load_checkpoint(tmp_path / "m.pt").model
    assert isinstance(loaded.model[0].bn, nn.Identity)
    assert_same_maps(model, loaded)


def test_a_weight_beyond_float16_keeps_its_value(tmp_path: Path) -> None:
    model = trained_model()
    model.model[0].bn.running_var[0] = 1e6
    save_checkpoint(tmp_path / "m.pt", model, metadata={})
    assert load_checkpoint(tmp_path / "m.pt").model.model[0].bn.running_var[0] == 1e6


def test_metadata_must_be_plain_values(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="plain values"):
        save_checkpoint(tmp_path / "m.pt", trained_model(), metadata={"when": object()})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        pytest.param({"format": "mavlink-companion.yolo.v9"}, "has format .*v9", id="a later format"),
        pytest.param({"description": None}, "has no description", id="no description"),
        pytest.param({"description": {"names": ["a"]}}, "needs 1..128 rows", id="an empty description"),
        pytest.param({"state_dict": {}}, "missing", id="no weights"),
        pytest.param({"state_dict": [1]}, "no state_dict", id="weights of another kind"),
        pytest.param({"metadata": 3}, "has no metadata", id="metadata of another kind"),
    ],
)
def test_our_format_with_a_part_wrong_is_refused(
    tmp_path: Path, change: dict[str, Any], expected: str
) -> None:
    save_checkpoint(tmp_path / "m.pt", trained_model(), metadata={})
    torch.save(torch.load(tmp_path / "m.pt", weights_only=True) | change, tmp_path / "m.pt")
    with pytest.raises(CheckpointError, match=expected):
        load_checkpoint(tmp_path / "m.pt")


@pytest.mark.parametrize(
    ("key", "tensor", "expected"),
    [
        ("model.0.conv.weight", torch.zeros(8, 3, 5, 5), r"should have the shape \(8, 3, 3, 3\)"),
        ("model.0.conv.weight", torch.zeros(8, 3, 3, 3, dtype=torch.int64), "should be torch.float32"),
        ("model.0.bn.running_var", torch.full((8,), float("nan")), "not finite"),
        ("model.99.extra", torch.zeros(1), r"1 unknown \(model.99.extra\)"),
    ],
    ids=["shape", "type", "not a number", "unknown"],
)
def test_weights_that_do_not_fit_are_named(tmp_path: Path, key: str, tensor: Tensor, expected: str) -> None:
    save_checkpoint(tmp_path / "m.pt", trained_model(), metadata={})
    content = torch.load(tmp_path / "m.pt", weights_only=True)
    content["state_dict"][key] = tensor
    torch.save(content, tmp_path / "m.pt")
    with pytest.raises(CheckpointError, match=expected):
        load_checkpoint(tmp_path / "m.pt")


# Ultralytics' format


def test_a_foreign_checkpoint_gives_the_network_that_was_trained(
    tmp_path: Path, foreign: dict[str, type[nn.Module]]
) -> None:
    model = trained_model()
    path = save_foreign(tmp_path / "f.pt", as_foreign(model, foreign))
    loaded = load_checkpoint(path)
    assert loaded.class_names == NAMES
    assert loaded.metadata["licence"] == "AGPL-3.0"
    assert loaded.metadata["origin"] == "Ultralytics 8.0.0"
    assert_same_maps(model, loaded.model)


def test_a_foreign_checkpoint_is_read_where_the_library_is_not_installed(
    tmp_path: Path, foreign: dict[str, type[nn.Module]]
) -> None:
    path = save_foreign(tmp_path / "f.pt", as_foreign(trained_model(), foreign))
    before = {name: module for name, module in sys.modules.items() if name.startswith("ultralytics")}
    for name in before:
        del sys.modules[name]
    try:
        load_checkpoint(path)
        assert not any(name.startswith("ultralytics") for name in sys.modules)
    finally:
        sys.modules.update(before)


def test_the_averaged_weights_are_preferred(tmp_path: Path, foreign: dict[str, type[nn.Module]]) -> None:
    model, averaged = trained_model(seed=1), trained_model(seed=2)
    path = save_foreign(
        tmp_path / "f.pt", as_foreign(model, foreign), ema=as_foreign(averaged, foreign), updates=5
    )
    assert_same_maps(averaged, load_checkpoint(path).model)


def test_what_a_training_run_leaves_in_the_file_does_no_harm(
    tmp_path: Path, foreign: dict[str, type[nn.Module]]
) -> None:
    path = save_foreign(
        tmp_path / "f.pt",
        as_foreign(trained_model(), foreign),
        best_fitness=np.float64(0.5),
        train_args={"save_dir": pathlib.PurePosixPath("runs/train"), "imgsz": 640, "seed": 2**40},
        optimizer={"state": {0: {"momentum_buffer": torch.zeros(3)}}},
        note=b"\x00\xff",
        classes={"a", "b"},
    )
    assert load_checkpoint(path).class_names == NAMES


def test_the_epsilon_of_each_normalisation_is_kept(
    tmp_path: Path, foreign: dict[str, type[nn.Module]]
) -> None:
    model = trained_model()
    model.model[0].bn.eps = 0.02
    path = save_foreign(tmp_path / "f.pt", as_foreign(model, foreign))
    loaded = load_checkpoint(path).model
    assert loaded.model[0].bn.eps == 0.02
    assert_same_maps(model, loaded)


def test_the_activation_is_the_one_that_was_trained(
    tmp_path: Path, foreign: dict[str, type[nn.Module]]
) -> None:
    model = trained_model()
    for module in model.modules():
        if isinstance(module, Conv):
            module.act = nn.ReLU()
    path = save_foreign(tmp_path / "f.pt", as_foreign(model, foreign))
    assert load_checkpoint(path).description.activation == "ReLU"
    assert_same_maps(model, load_checkpoint(path).model)


def test_names_may_be_a_list(tmp_path: Path, foreign: dict[str, type[nn.Module]]) -> None:
    path = save_foreign(tmp_path / "f.pt", as_foreign(trained_model(), foreign, names=list(NAMES)))
    assert load_checkpoint(path).class_names == NAMES


@pytest.mark.parametrize(
    ("attributes", "expected"),
    [
        pytest.param({"names": {0: "car", 2: "dog"}}, "not numbered from 0", id="a gap in the names"),
        pytest.param({"names": None}, "no class names", id="no names"),
        pytest.param({"names": ["car"]}, "names 1 classes, its network has 2", id="too few names"),
        pytest.param({"yaml": None}, "has no yaml", id="no description"),
        pytest.param({"yaml": {"nc": 2}}, "needs 1..128 rows", id="no rows"),
    ],
)
def test_a_foreign_model_with_a_part_missing_is_refused(
    tmp_path: Path, foreign: dict[str, type[nn.Module]], attributes: dict[str, Any], expected: str
) -> None:
    path = save_foreign(tmp_path / "f.pt", as_foreign(trained_model(), foreign, **attributes))
    with pytest.raises(CheckpointError, match=expected):
        load_checkpoint(path)


def test_a_layer_that_is_not_known_is_named_with_its_row(
    tmp_path: Path, foreign: dict[str, type[nn.Module]]
) -> None:
    whole = as_foreign(trained_model(), foreign)
    whole.yaml["backbone"][4] = [-1, 3, "GhostConv", [256, True]]
    with pytest.raises(CheckpointError, match="row 4: unknown layer 'GhostConv'"):
        load_checkpoint(save_foreign(tmp_path / "f.pt", whole))


def test_a_model_of_another_task_is_refused(tmp_path: Path, foreign: dict[str, type[nn.Module]]) -> None:
    path = save_foreign(tmp_path / "f.pt", foreign["SegmentationModel"]())
    with pytest.raises(CheckpointError, match="holds a SegmentationModel; only detection models"):
        load_checkpoint(path)


def test_a_class_that_is_not_on_the_list_is_refused_by_name(
    tmp_path: Path, foreign: dict[str, type[nn.Module]]
) -> None:
    path = save_foreign(tmp_path / "f.pt", foreign["C3Ghost"]())
    with pytest.raises(UnsafeCheckpointError, match=r"ultralytics\.nn\.modules\.block\.C3Ghost"):
        load_checkpoint(path)


def test_modules_that_contain_each_other_are_refused(
    tmp_path: Path, foreign: dict[str, type[nn.Module]]
) -> None:
    whole = as_foreign(trained_model(), foreign)
    whole._modules["itself"] = whole
    with pytest.raises(CheckpointError, match="contain each other"):
        load_checkpoint(save_foreign(tmp_path / "f.pt", whole))


# Every generation, as releases old and new wrote it


def shrunk(generation: str, scale: str) -> ModelDescription:
    description = published_description(generation, scale, NAMES)
    return dataclasses.replace(description, depth_multiple=0.34, width_multiple=0.25, max_channels=None)


def terse(whole: nn.Module) -> None:
    """The table as it is published: what scale and layers imply is left unsaid."""
    for row in whole.yaml["backbone"] + whole.yaml["head"]:
        if row[2] == "C3k2":
            row[3][1:2] = [False]
        if row[2] == "A2C2f":
            del row[3][3:]
        if row[2] == "SPPF":
            del row[3][4:]


@pytest.mark.parametrize(
    ("generation", "scale"),
    [
        *((generation, "n") for generation in SCALES),
        ("YOLOv10", "x"),
        ("YOLO11", "m"),
        ("YOLO12", "l"),
        ("YOLO26", "x"),
    ],
)
def test_every_generation_is_built_from_what_the_pickled_layers_show(
    tmp_path: Path, foreign: dict[str, type[nn.Module]], generation: str, scale: str
) -> None:
    model = trained_model(shrunk(generation, scale))
    whole = as_foreign(model, foreign)
    terse(whole)
    loaded = load_checkpoint(save_foreign(tmp_path / "f.pt", whole))
    assert loaded.model.end_to_end == model.end_to_end
    assert loaded.description.rows == model.description.rows
    assert loaded.description.light_classes == model.description.light_classes
    assert loaded.model.state_dict().keys() == model.state_dict().keys()
    for name, tensor in model.state_dict().items():
        assert torch.equal(loaded.model.state_dict()[name].half(), tensor.half()), name


@pytest.mark.parametrize("generation", ["YOLOv5u", "YOLOv8"])
def test_a_checkpoint_of_the_first_releases_is_read(
    tmp_path: Path, early_foreign: dict[str, type[nn.Module]], generation: str
) -> None:
    model = trained_model(shrunk(generation, "n"))
    whole = as_foreign(model, early_foreign)
    del whole.model[-1].reg_max
    settings = early_foreign["DictConfig"]()
    settings._content = collections.defaultdict(dict, {"imgsz": 640})
    whole.args = settings
    loaded = load_checkpoint(save_foreign(tmp_path / "f.pt", whole))
    assert_same_maps(model, loaded.model)


def test_a_head_of_two_is_end_to_end_whichever_answered_last(
    tmp_path: Path, foreign: dict[str, type[nn.Module]]
) -> None:
    whole = as_foreign(trained_model(shrunk("YOLO26", "n")), foreign)
    whole.model[-1]._end2end = False
    assert load_checkpoint(save_foreign(tmp_path / "f.pt", whole)).model.end_to_end


@pytest.mark.parametrize("generation", ["YOLOv8", "YOLOv10", "YOLO26"])
def test_a_checkpoint_saved_folded_is_read(
    tmp_path: Path, foreign: dict[str, type[nn.Module]], generation: str
) -> None:
    model = trained_model(shrunk(generation, "s"))
    model.fuse()
    whole = as_foreign(model, foreign)
    layer = whole.model[0]
    layer.bn = None

    def forward_fuse(self: nn.Module, x: Tensor) -> Tensor:
        return x

    type(layer).forward_fuse = forward_fuse
    layer.forward = layer.forward_fuse
    loaded = load_checkpoint(save_foreign(tmp_path / "f.pt", whole))
    assert not any(".bn." in name for name in loaded.model.state_dict())
    assert_same_maps(model, loaded.model)


@pytest.mark.parametrize("unscaled", [True, False])
def test_as_many_channels_as_classes_are_scaled_or_not_as_they_were_trained(
    tmp_path: Path, foreign: dict[str, type[nn.Module]], unscaled: bool
) -> None:
    names = tuple(f"class {index}" for index in range(64))
    description = dataclasses.replace(
        yolov8_description(SMALL, names), unscaled_channels=(64,) if unscaled else ()
    )
    model = trained_model(description)
    loaded = load_checkpoint(save_foreign(tmp_path / "f.pt", as_foreign(model, foreign)))
    assert loaded.description.unscaled_channels == description.unscaled_channels
    assert_same_maps(model, loaded.model)


@pytest.mark.parametrize("change", [{"class_width": 24}, {"light_classes": True}])
def test_the_head_is_the_one_that_was_trained(
    tmp_path: Path, foreign: dict[str, type[nn.Module]], change: dict[str, Any]
) -> None:
    """Until 8.1 class branches of many classes were wider; 8.3.0 gave YOLOv8 the light ones of YOLO11."""
    model = trained_model(dataclasses.replace(yolov8_description(SMALL, NAMES), **change))
    loaded = load_checkpoint(save_foreign(tmp_path / "f.pt", as_foreign(model, foreign)))
    assert_same_maps(model, loaded.model)


def test_another_stride_than_the_layers_give_is_refused(
    tmp_path: Path, foreign: dict[str, type[nn.Module]]
) -> None:
    whole = as_foreign(trained_model(), foreign)
    whole.model[-1].stride = torch.tensor([4.0, 8.0, 16.0])
    with pytest.raises(CheckpointError, match=r"strides \[4.0, 8.0, 16.0\], not \(8, 16, 32\)"):
        load_checkpoint(save_foreign(tmp_path / "f.pt", whole))


def test_a_set_named_by_its_type_is_read() -> None:
    program = b"\x80\x02cdill._dill\n_load_type\nX\x03\x00\x00\x00set\x85R]K\x01a\x85R."
    admitted = {"dill._dill._load_type": Admitted("dill._dill._load_type", torch_archive._type_by_name)}
    assert unpickle(program, admitted, lambda identity: None) == {1}


# Hostile files


def hostile(marker: Path) -> dict[str, Any]:
    import builtins
    import os
    import subprocess

    touch = f"touch {marker}"
    return {
        "posix.system": Calls(os.system, touch),
        "subprocess.Popen": Calls(subprocess.Popen, ["touch", str(marker)]),
        "eval": Calls(builtins.eval, f"open({str(marker)!r}, 'w')"),
        "exec": Calls(builtins.exec, f"open({str(marker)!r}, 'w')"),
        "open": Calls(open, str(marker), "w"),
        "getattr": Calls(getattr, "a text", "upper"),
        "torch.serialization.load": Calls(torch.load, str(marker)),
        "torch.hub.load": Calls(torch.hub.load, "x", "y"),
        "builtins.__import__": Global("builtins", "__import__"),
        "torch.nn.modules.module.Module.__setattr__": Global("torch.nn.modules.module", "Module.__setattr__"),
        "ultralytics.nn.tasks.torch_safe_load": Global("ultralytics.nn.tasks", "torch_safe_load"),
    }


@pytest.mark.parametrize("name", list(hostile(Path())))
def test_a_pickle_that_calls_something_is_refused_by_name_and_not_run(tmp_path: Path, name: str) -> None:
    marker = tmp_path / "it-ran"
    pickled = dumped({"model": None, "innocent": hostile(marker)[name]})
    path = archive(tmp_path / "evil.pt", pickled)
    with pytest.raises(UnsafeCheckpointError, match=name.rpartition(".")[2]) as caught:
        load_checkpoint(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert not marker.exists()


def test_a_real_checkpoint_with_a_call_hidden_in_it_is_refused_and_not_run(
    tmp_path: Path, foreign: dict[str, type[nn.Module]]
) -> None:
    import os

    marker = tmp_path / "it-ran"
    whole = as_foreign(trained_model(), foreign, callback=Calls(os.system, f"touch {marker}"))
    path = save_foreign(tmp_path / "evil.pt", whole)
    with pytest.raises(UnsafeCheckpointError, match=r"posix\.system"):
        load_checkpoint(path)
    assert not marker.exists()
    torch.load(path, weights_only=False)  # The file was truly armed.
    assert marker.exists()


@pytest.mark.parametrize(
    "program",
    [
        pytest.param(b"\x80\x02ctorch.nn.modules.conv\nConv2d\n}b.", id="state set on a class"),
        pytest.param(b"\x80\x02ccollections\nOrderedDict\n}b.", id="state set on a type"),
        pytest.param(b"\x80\x02ccollections\nOrderedDict\n)\x81.", id="an instance of a function"),
        pytest.param(b"\x80\x02X\x01\x00\x00\x00a)R.", id="a text is called"),
        pytest.param(b"\x80\x02ctorch.nn.modules.conv\nConv2d\n)\x81)R.", id="a record is called"),
        pytest.param(b"\x80\x02]}b.", id="state set on a list"),
        pytest.param(b"\x80\x02ccollections\nOrderedDict\n]\x85R.", id="a dictionary filled by a call"),
        pytest.param(b"\x80\x02ccollections\ndefaultdict\n]\x85R.", id="a default dictionary, filled"),
        pytest.param(b"\x80\x02cdill._dill\n_load_type\nX\x04\x00\x00\x00type\x85R.", id="a type by name"),
        pytest.param(b"\x80\x02cdill._dill\n_load_type\n]\x85R.", id="a type by no name"),
        pytest.param(
            b"\x80\x02c__builtin__\ngetattr\nctorch.nn.modules.conv\nConv2d\n)\x81"
            b"X\x09\x00\x00\x00__class__\x86R.",
            id="another method than the folded layer's own",
        ),
        pytest.param(
            b"\x80\x02c__builtin__\ngetattr\nctorch.nn.modules.conv\nConv2d\n"
            b"X\x0c\x00\x00\x00forward_fuse\x86R.",
            id="a method of something else than a layer",
        ),
    ],
)
def test_tricks_with_admitted_names_are_refused(tmp_path: Path, program: bytes) -> None:
    with pytest.raises(UnsafeCheckpointError, match="nothing was run"):
        load_checkpoint(archive(tmp_path / "evil.pt", program))


def tensor_call(*arguments: Any) -> Any:
    return [Global("torch._utils", "_rebuild_tensor_v2"), arguments]


def storage(kind: str = "FloatStorage", key: str = "0", count: int = 4) -> Any:
    return ("PERSISTENT", ("storage", Global("torch", kind), key, "cpu", count))


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        pytest.param((storage(), 0, (5,), (1,)), "larger than its storage", id="too long"),
        pytest.param((storage(), 1, (4,), (1,)), "larger than its storage", id="offset too far"),
        pytest.param((storage(), -1, (1,), (1,)), "impossible shape", id="before the storage"),
        pytest.param((storage(), 0, (2,), (-1,)), "impossible shape", id="backwards"),
        pytest.param((storage(), 0, (10**9,), (0,)), "larger than its storage", id="one number repeated"),
        pytest.param((storage(), 0, (2, 2), (1,)), "impossible shape", id="a stride missing"),
        pytest.param((storage(), 0, (True,), (1,)), "impossible shape", id="a size that is no number"),
        pytest.param((storage(), 0), "without a shape", id="no shape"),
        pytest.param(((1, 2), 0, (1,), (1,)), "impossible shape", id="no storage"),
        pytest.param((storage(count=5), 0, (1,), (1,)), "should have 5 numbers", id="storage too short"),
        pytest.param((storage(count=10**15), 0, (1,), (1,)), "should have", id="a storage without end"),
        pytest.param((storage(key="7"), 0, (1,), (1,)), "'7' is missing", id="storage missing"),
        pytest.param((storage(key="../version"), 0, (1,), (1,)), "is missing", id="another member"),
        pytest.param((storage(kind="Generator"), 0, (1,), (1,)), "torch.Generator", id="another kind"),
    ],
)
def test_a_tensor_outside_its_storage_is_refused(
    tmp_path: Path, arguments: tuple[Any, ...], expected: str
) -> None:
    function, call = tensor_call(*arguments)
    pickled = dumped((function, call))[:-1]
    # Unpack the pair and call it: TUPLE2 at the end becomes REDUCE.
    assert pickled.endswith(b"\x86q" + pickled[-1:])
    program = pickled[:-3] + b"R."
    path = archive(tmp_path / "t.pt", program, {"data/0": bytes(16), "version": b"3"})
    with pytest.raises(CheckpointError, match=expected):
        load_checkpoint(path)


def test_numbers_repeated_without_end_are_refused(tmp_path: Path) -> None:
    function, call = tensor_call(storage(count=1000), 0, (1000,), (1,))
    one = dumped((function, call))[2:-1]
    program = b"\x80\x02](" + (one[:-3] + b"R") * 2000 + b"e."
    path = archive(tmp_path / "t.pt", program, {"data/0": bytes(4000)})
    size = path.stat().st_size
    with pytest.raises(CheckpointError, match="repeat the same numbers"):
        load_checkpoint(path)
    assert 1000 * 2000 > 4 * size


def test_a_network_larger_than_its_file_costs_no_memory(tmp_path: Path) -> None:
    description = yolov8_description((1.0, 16.0, 1 << 14), NAMES).to_plain()
    torch.save(
        {"format": FORMAT, "description": description, "state_dict": {}, "metadata": {}}, tmp_path / "m.pt"
    )
    with pytest.raises(CheckpointError, match="missing"):
        load_checkpoint(tmp_path / "m.pt")


@pytest.mark.parametrize("depth", [5, 14, 60, 50_000])
def test_a_maze_of_references_is_refused_at_once(tmp_path: Path, depth: int) -> None:
    """Each tuple holds the one before twice: a few bytes whose copy or text would never be finished."""
    program = dumped({"format": FORMAT})[:-1] + b"(" + dumped("description")[2:-1]
    program += b"]q\x09" + b"h\x09h\x09\x86q\x09" * depth + b"u."
    with pytest.raises(CheckpointError):
        load_checkpoint(archive(tmp_path / "m.pt", program))


@pytest.mark.parametrize("name", ["", "\x1b[2Jcar", "a\nb"])
def test_a_class_name_that_could_steer_a_terminal_is_refused(tmp_path: Path, name: str) -> None:
    save_checkpoint(tmp_path / "m.pt", trained_model(), metadata={})
    content = torch.load(tmp_path / "m.pt", weights_only=True)
    content["description"]["names"] = [name, "dog"]
    content["state_dict"]["\x1b\n"] = torch.zeros(1)
    torch.save(content, tmp_path / "m.pt")
    with pytest.raises(CheckpointError, match="class name must be printable") as caught:
        load_checkpoint(tmp_path / "m.pt")
    assert str(caught.value).isprintable()
    content["description"]["names"] = ["car", "dog"]
    torch.save(content, tmp_path / "m.pt")
    with pytest.raises(CheckpointError, match="1 unknown") as caught:
        load_checkpoint(tmp_path / "m.pt")
    assert str(caught.value).isprintable()


# Damaged files


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        pytest.param(b"", "is empty", id="empty"),
        pytest.param(b"hello", "not a checkpoint", id="text"),
        pytest.param(pickle.dumps({"model": 1}), "not a checkpoint", id="a bare pickle"),
        pytest.param(
            b"PK\x03\x04" + bytes(100), "truncated or damaged", id="only the beginning of an archive"
        ),
    ],
)
def test_a_file_of_another_kind_is_refused_in_one_line(tmp_path: Path, content: bytes, expected: str) -> None:
    path = tmp_path / "x.pt"
    path.write_bytes(content)
    with pytest.raises(CheckpointError, match=expected) as caught:
        load_checkpoint(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"no such file; give the path of a \.pt"):
        load_checkpoint(tmp_path / "none.pt")
    with pytest.raises(CheckpointError, match="is a folder"):
        load_checkpoint(tmp_path)


def test_an_archive_without_a_model_is_refused(tmp_path: Path) -> None:
    for value in ({"weights": 1}, [1, 2], {"model": None}, {"model": torch.zeros(2)}, {"ema": {"a": 1}}, 5):
        torch.save(value, tmp_path / "x.pt")
        with pytest.raises(CheckpointError, match="model"):
            load_checkpoint(tmp_path / "x.pt")


def test_a_compressed_archive_is_refused(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "bomb.pt", "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("model/data.pkl", bytes(50_000_000))
    with pytest.raises(CheckpointError, match="is compressed"):
        load_checkpoint(tmp_path / "bomb.pt")


def test_two_members_that_share_their_bytes_are_refused(tmp_path: Path) -> None:
    """Overlapping members make a small file large."""
    path = tmp_path / "overlap.pt"
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("model/data.pkl", bytes(5000))
        for number in range(20):
            info = copy.copy(file.filelist[0])
            info.filename = f"model/data/{number}"
            file.filelist.append(info)
    with pytest.raises(CheckpointError, match="larger than the file"):
        load_checkpoint(path)


def test_a_program_for_torchscript_is_refused_as_such(tmp_path: Path) -> None:
    path = archive(tmp_path / "s.pt", dumped({}), {"code/__torch__.py": b""})
    with pytest.raises(CheckpointError, match="TorchScript"):
        load_checkpoint(path)


def test_numbers_of_the_other_byte_order_are_refused(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="big-endian"):
        load_checkpoint(archive(tmp_path / "b.pt", dumped({}), {"byteorder": b"big"}))


@pytest.fixture(scope="module")
def own_bytes(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("own") / "m.pt"
    save_checkpoint(path, trained_model(), metadata={"licence": "Apache-2.0"})
    return path.read_bytes()


@pytest.fixture(scope="module")
def foreign_pickle(tmp_path_factory: pytest.TempPathFactory) -> tuple[bytes, dict[str, bytes]]:
    """The pickle of a foreign checkpoint and the other members of its archive."""
    with pytest.MonkeyPatch.context() as patch:
        classes = foreign_classes(patch, FOREIGN)
        path = save_foreign(tmp_path_factory.mktemp("foreign") / "f.pt", as_foreign(trained_model(), classes))
    with zipfile.ZipFile(path) as file:
        members = {name.partition("/")[2]: file.read(name) for name in file.namelist()}
    return members.pop("data.pkl"), members


def test_a_truncated_file_is_refused_at_every_length(tmp_path: Path, own_bytes: bytes) -> None:
    path = tmp_path / "cut.pt"
    lengths = {
        *range(0, 200, 7),
        *range(0, len(own_bytes), 1999),
        *range(len(own_bytes) - 60, len(own_bytes)),
    }
    for length in sorted(lengths):
        path.write_bytes(own_bytes[:length])
        with pytest.raises(CheckpointError) as caught:
            load_checkpoint(path)
        assert type(caught.value) is CheckpointError
        assert str(path) in str(caught.value)


def test_a_truncated_pickle_is_refused_at_every_length(
    tmp_path: Path, foreign_pickle: tuple[bytes, dict[str, bytes]]
) -> None:
    pickled, members = foreign_pickle
    for length in range(0, len(pickled), 997):
        with pytest.raises(CheckpointError):
            load_checkpoint(archive(tmp_path / "cut.pt", pickled[:length], members))


EDITS = st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)), min_size=1, max_size=12)
UNHURRIED = settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def loads_or_names_the_reason(path: Path) -> None:
    reason = ""
    try:
        load_checkpoint(path)
    except CheckpointError as error:
        reason = str(error)
    assert not reason or reason.startswith(str(path))
    assert "\n" not in reason


@UNHURRIED
@given(edits=EDITS)
def test_a_file_with_changed_bytes_loads_or_is_refused(
    tmp_path: Path, own_bytes: bytes, edits: list[tuple[float, int]]
) -> None:
    changed = bytearray(own_bytes)
    for where, value in edits:
        # Headers and directory lie at the two ends; the numbers between are many and uninteresting.
        half = 30_000
        place = int(where * 2 * half)
        changed[place if place < half else len(changed) - 2 * half + place] = value
    (tmp_path / "changed.pt").write_bytes(changed)
    loads_or_names_the_reason(tmp_path / "changed.pt")


@UNHURRIED
@given(edits=EDITS)
def test_a_pickle_with_changed_bytes_loads_or_is_refused(
    tmp_path: Path, foreign_pickle: tuple[bytes, dict[str, bytes]], edits: list[tuple[float, int]]
) -> None:
    pickled, members = foreign_pickle
    changed = bytearray(pickled)
    for where, value in edits:
        changed[int(where * len(changed))] = value
    loads_or_names_the_reason(archive(tmp_path / "changed.pt", bytes(changed), members))


@settings(max_examples=300, deadline=None)
@given(program=st.binary(max_size=60))
def test_any_bytes_are_a_value_or_a_named_error(program: bytes) -> None:
    with contextlib.suppress(CheckpointError):
        unpickle(b"\x80\x02" + program, {}, lambda identity: None)


def refuse(identity: tuple[Any, ...]) -> Any:
    raise AssertionError(f"no storage was expected, got {identity}")


@pytest.mark.parametrize(
    "value",
    [
        None,
        [1, 255, 256, 65536, -1, 2**40, -(2**100), 0.5, True, False, "ä", "", ()],
        {"a": (1,), "b": (1, 2), "c": (1, 2, 3), "d": (1, 2, 3, 4), 5: []},
        [[]] * 3,
    ],
    ids=str,
)
def test_plain_values_are_read_as_python_reads_them(value: Any) -> None:
    assert unpickle(pickle.dumps(value, protocol=2), {}, refuse) == value


@pytest.mark.parametrize(
    ("program", "expected"),
    [
        (b"\x80\x04N.", "protocol 2"),
        (b"\x80\x02\x80\x02N.", "twice"),
        (b"\x80\x02NN.", "left over"),
        (b"\x80\x02.", "not there"),
        (b"\x80\x02e.", "no mark"),
        (b"\x80\x02(s.", "not there"),
        (b"\x80\x02h\x05.", "asks for value 5"),
        (b"\x80\x02}(Nu.", "without a value"),
        (b"\x80\x02}]Ns.", "key of type list"),
        (b"\x80\x02X\x01\x00\x00\x00\xff.", "not UTF-8"),
        (b"\x80\x02X" + struct.pack("<I", 2**32 - 1) + b"a", "ends in the middle"),
        (b"\x80\x02cno end", "without a name"),
        (b"\x80\x02V1\n.", "opcode b'V'"),
        (b"\x80\x02NQ.", "something else than a tuple"),
    ],
)
def test_a_senseless_program_is_refused(program: bytes, expected: str) -> None:
    with pytest.raises(CheckpointError, match=expected):
        unpickle(program, {}, refuse)


def test_a_huge_memo_number_costs_no_memory() -> None:
    assert unpickle(b"\x80\x02Nr\xff\xff\xff\xff.", {}, refuse) is None


def test_an_ordered_dictionary_becomes_a_plain_one(tmp_path: Path) -> None:
    model = trained_model()
    save_checkpoint(tmp_path / "m.pt", model, metadata={})
    content = torch.load(tmp_path / "m.pt", weights_only=True)
    content["state_dict"] = collections.OrderedDict(content["state_dict"])
    content["state_dict"]._metadata = {"version": 1}
    torch.save(content, tmp_path / "m.pt")
    assert_same_maps(model, load_checkpoint(tmp_path / "m.pt").model)
