"""Valid checkpoints: ours, and those of every release and family of Ultralytics."""

from __future__ import annotations

import collections
import dataclasses
import pathlib
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from tests.vision.foreign_checkpoints import (
    NAMES,
    SMALL,
    Classes,
    archive,
    as_foreign,
    assert_same_maps,
    save_foreign,
    trained_model,
)
from vision.training.published import SCALES, published_description, yolov8_description
from vision.yolo.architecture import ModelDescription, build
from vision.yolo.checkpoint import (
    FORMAT,
    CheckpointError,
    load_checkpoint,
    save_checkpoint,
)
from vision.yolo.checkpoint_file import read_archive
from vision.yolo.layers import Conv

pytestmark = pytest.mark.usefixtures("untried")


def test_a_saved_model_comes_back_the_same(tmp_path: Path) -> None:
    """It is readable by torch without trust, and can be trained further."""
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
    content = torch.load(tmp_path / "m.pt", weights_only=True)
    assert content["format"] == FORMAT
    floating = {tensor.dtype for tensor in content["state_dict"].values() if tensor.is_floating_point()}
    assert floating == {torch.float16}
    sum(level.square().sum() for level in loaded.model.train()(torch.rand(2, 3, 64, 64))).backward()
    assert loaded.model.model[0].get_parameter("conv.weight").grad is not None


def test_a_model_with_folded_normalisation_comes_back_folded(tmp_path: Path) -> None:
    model = trained_model().fuse()
    save_checkpoint(tmp_path / "m.pt", model, metadata={})
    loaded = load_checkpoint(tmp_path / "m.pt").model
    assert isinstance(loaded.model[0].bn, nn.Identity)
    assert_same_maps(model, loaded)


def test_a_weight_beyond_float16_keeps_its_value(tmp_path: Path) -> None:
    model = trained_model()
    model.model[0].get_buffer("bn.running_var")[0] = 1e6
    save_checkpoint(tmp_path / "m.pt", model, metadata={})
    assert load_checkpoint(tmp_path / "m.pt").model.model[0].get_buffer("bn.running_var")[0] == 1e6


def test_metadata_must_be_plain_values(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="plain values"):
        save_checkpoint(tmp_path / "m.pt", trained_model(), metadata={"when": object()})
    assert list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The content of a model that we saved."""
    path = tmp_path_factory.mktemp("saved") / "m.pt"
    save_checkpoint(path, trained_model(), metadata={})
    content: dict[str, Any] = torch.load(path, weights_only=True)
    return content


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
def test_our_format_with_a_part_wrong_is_rejected(
    tmp_path: Path, saved: dict[str, Any], change: dict[str, Any], expected: str
) -> None:
    torch.save(saved | change, tmp_path / "m.pt")
    with pytest.raises(CheckpointError, match=expected):
        load_checkpoint(tmp_path / "m.pt")


@pytest.mark.parametrize(
    ("key", "tensor", "expected"),
    [
        ("model.0.conv.weight", torch.zeros(8, 3, 5, 5), r"\(8, 3, 3, 3\)"),
        ("model.0.conv.weight", torch.zeros(8, 3, 3, 3, dtype=torch.int64), "torch.float32"),
        ("model.0.bn.running_var", torch.full((8,), float("nan")), "not finite"),
        ("model.99.extra", torch.zeros(1), r"1 unknown \(model.99.extra\)"),
    ],
    ids=["shape", "type", "not a number", "unknown"],
)
def test_weights_that_do_not_fit_are_named(
    tmp_path: Path, saved: dict[str, Any], key: str, tensor: Tensor, expected: str
) -> None:
    torch.save(saved | {"state_dict": saved["state_dict"] | {key: tensor}}, tmp_path / "m.pt")
    with pytest.raises(CheckpointError, match=expected):
        load_checkpoint(tmp_path / "m.pt")


# Ultralytics' format


def test_a_foreign_checkpoint_gives_the_network_that_was_trained(tmp_path: Path, foreign: Classes) -> None:
    """Without the library; leftovers of training are ignored, and the names may be a list."""
    model = trained_model()
    norm = model.model[0].get_submodule("bn")
    assert isinstance(norm, nn.BatchNorm2d)
    norm.eps = 0.02
    path = save_foreign(
        tmp_path / "f.pt",
        as_foreign(model, foreign, names=list(NAMES)),
        best_fitness=np.float64(0.5),
        train_args={"save_dir": pathlib.PurePosixPath("runs/train"), "imgsz": 640, "seed": 2**40},
        optimizer={"state": {0: {"momentum_buffer": torch.zeros(3)}}},
        note=b"\x00\xff",
        classes={"a", "b"},
    )
    before = {name: module for name, module in sys.modules.items() if name.startswith("ultralytics")}
    for name in before:
        del sys.modules[name]
    try:
        loaded = load_checkpoint(path)
        assert not any(name.startswith("ultralytics") for name in sys.modules)
    finally:
        sys.modules.update(before)
    assert loaded.class_names == NAMES
    assert loaded.metadata["licence"] == "AGPL-3.0"
    assert loaded.metadata["origin"] == "Ultralytics 8.0.0"
    assert loaded.model.model[0].get_submodule("bn").eps == 0.02
    assert_same_maps(model, loaded.model)


def test_the_averaged_weights_are_preferred(tmp_path: Path, foreign: Classes) -> None:
    model, averaged = trained_model(seed=1), trained_model(seed=2)
    path = save_foreign(
        tmp_path / "f.pt", as_foreign(model, foreign), ema=as_foreign(averaged, foreign), updates=5
    )
    loaded = load_checkpoint(path)
    assert loaded.class_names == NAMES
    assert_same_maps(averaged, loaded.model)


def test_the_activation_is_the_one_that_was_trained(tmp_path: Path, foreign: Classes) -> None:
    model = trained_model()
    for module in model.modules():
        if isinstance(module, Conv):
            module.act = nn.ReLU()
    path = save_foreign(tmp_path / "f.pt", as_foreign(model, foreign))
    loaded = load_checkpoint(path)
    assert loaded.description.activation == "ReLU"
    assert_same_maps(model, loaded.model)


@pytest.mark.parametrize(
    ("attributes", "expected"),
    [
        pytest.param({"names": {0: "car", 2: "dog"}}, "not numbered from 0", id="a gap in the names"),
        pytest.param({"names": None}, "no class names", id="no names"),
        pytest.param({"names": ["car"]}, "1 classes, .* 2", id="too few names"),
        pytest.param({"yaml": None}, "has no yaml", id="no description"),
        pytest.param({"yaml": {"nc": 2}}, "needs 1..128 rows", id="no rows"),
    ],
)
def test_a_foreign_model_with_a_part_missing_is_rejected(
    tmp_path: Path, foreign: Classes, attributes: dict[str, Any], expected: str
) -> None:
    path = save_foreign(tmp_path / "f.pt", as_foreign(trained_model(), foreign, **attributes))
    with pytest.raises(CheckpointError, match=expected):
        load_checkpoint(path)


def test_a_layer_that_is_not_known_is_named_with_its_row(tmp_path: Path, foreign: Classes) -> None:
    whole = as_foreign(trained_model(), foreign)
    whole.yaml["backbone"][4] = [-1, 3, "GhostConv", [256, True]]
    with pytest.raises(CheckpointError, match=r"row 4: .*'GhostConv'"):
        load_checkpoint(save_foreign(tmp_path / "f.pt", whole))


def test_segmentation_without_its_head_is_rejected(tmp_path: Path, foreign: Classes) -> None:
    classes = foreign | {"DetectionModel": foreign["SegmentationModel"]}
    path = save_foreign(tmp_path / "f.pt", as_foreign(trained_model(), classes))
    with pytest.raises(CheckpointError, match=r" Segment, Pose, .*got"):
        load_checkpoint(path)


def test_a_class_that_is_not_on_the_list_is_rejected_by_name(tmp_path: Path, foreign: Classes) -> None:
    path = save_foreign(tmp_path / "f.pt", foreign["C3Ghost"]())
    expected = r"'ultralytics\.nn\.modules\.block\.C3Ghost', which is not supported.*nothing was run"
    with pytest.raises(CheckpointError, match=expected):
        load_checkpoint(path)


def test_modules_that_contain_each_other_are_rejected(tmp_path: Path, foreign: Classes) -> None:
    whole = as_foreign(trained_model(), foreign)
    whole._modules["itself"] = whole
    with pytest.raises(CheckpointError, match=r"modules contain "):
        load_checkpoint(save_foreign(tmp_path / "f.pt", whole))


# Every family, as old and new releases wrote it


def shrunk(model_family: str, scale: str) -> ModelDescription:
    description = published_description(model_family, scale, NAMES)
    return dataclasses.replace(description, depth_multiple=0.34, width_multiple=0.25, max_channels=None)


def terse(whole: Any) -> None:
    """The table as published, with the values implied by scale and layers left out."""
    for row in whole.yaml["backbone"] + whole.yaml["head"]:
        if row[2] == "C3k2" and len(row[3]) < 4:
            row[3][1:2] = [False]
        if row[2] == "A2C2f":
            del row[3][3:]
        if row[2] == "SPPF":
            del row[3][4:]


@pytest.mark.parametrize(
    ("model_family", "scale"),
    [
        *((model_family, "n") for model_family in SCALES),
        *(
            pytest.param(*each, marks=pytest.mark.slow)
            for each in (("YOLOv10", "x"), ("YOLO11", "m"), ("YOLO12", "l"), ("YOLO26", "x"))
        ),
    ],
)
def test_every_family_is_built_from_its_pickled_layers(
    tmp_path: Path, foreign: Classes, model_family: str, scale: str
) -> None:
    torch.manual_seed(0)
    model = build(shrunk(model_family, scale)).eval()
    for tensor in model.state_dict().values():
        if tensor.is_floating_point():
            tensor.copy_(torch.rand_like(tensor))
    whole = as_foreign(model, foreign)
    terse(whole)
    if (model_family, scale) == ("YOLO26", "n"):
        whole.model[-1]._end2end = False  # a dual head is end-to-end in any state
    loaded = load_checkpoint(save_foreign(tmp_path / "f.pt", whole))
    assert loaded.model.end_to_end == model.end_to_end
    assert loaded.description.rows == model.description.rows
    assert loaded.description.light_classes == model.description.light_classes
    weights, written = loaded.model.state_dict(), model.state_dict()
    assert weights.keys() == written.keys()
    for name, tensor in written.items():
        assert torch.equal(weights[name].half(), tensor.half()), name


@pytest.mark.parametrize("model_family", ["YOLOv5u", "YOLOv8"])
def test_a_checkpoint_of_the_first_releases_is_read(
    tmp_path: Path, early_foreign: Classes, model_family: str
) -> None:
    model = trained_model(shrunk(model_family, "n"))
    whole = as_foreign(model, early_foreign)
    del whole.model[-1].reg_max
    settings: Any = early_foreign["DictConfig"]()
    content: dict[str, object] = collections.defaultdict(dict, {"imgsz": 640})
    settings._content = content
    whole.args = settings
    loaded = load_checkpoint(save_foreign(tmp_path / "f.pt", whole))
    assert_same_maps(model, loaded.model)


@pytest.mark.parametrize(
    "model_family", [pytest.param("YOLOv8", marks=pytest.mark.slow), "YOLOv10", "YOLO26"]
)
def test_a_checkpoint_saved_folded_is_read(tmp_path: Path, foreign: Classes, model_family: str) -> None:
    model = trained_model(shrunk(model_family, "s"))
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
def test_channels_equal_to_classes_are_scaled_as_trained(
    tmp_path: Path, foreign: Classes, unscaled: bool
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
    tmp_path: Path, foreign: Classes, change: dict[str, Any]
) -> None:
    """Until 8.1 class branches of many classes were wider; 8.3.0 gave YOLOv8 the light ones of YOLO11."""
    model = trained_model(dataclasses.replace(yolov8_description(SMALL, NAMES), **change))
    loaded = load_checkpoint(save_foreign(tmp_path / "f.pt", as_foreign(model, foreign)))
    assert_same_maps(model, loaded.model)


def test_another_stride_than_the_layers_give_is_rejected(tmp_path: Path, foreign: Classes) -> None:
    whole = as_foreign(trained_model(), foreign)
    whole.model[-1].stride = torch.tensor([4.0, 8.0, 16.0])
    with pytest.raises(CheckpointError, match=r"strides \[4.0, 8.0, 16.0\], not \(8, 16, 32\)"):
        load_checkpoint(save_foreign(tmp_path / "f.pt", whole))


def test_a_set_named_by_its_type_is_read(tmp_path: Path) -> None:
    program = b"\x80\x02cdill._dill\n_load_type\nX\x03\x00\x00\x00set\x85R]K\x01a\x85R."
    assert read_archive(archive(tmp_path / "set.pt", program)) == {1}
