"""YOLOv9 and YOLOv3-tiny: outputs of the reference, its checkpoints, and tables that cannot be built.

The figures were measured with Ultralytics 8.4.190 on networks of the same rows and weights.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.vision.foreign_checkpoints import (
    FOREIGN,
    as_foreign,
    assert_same_maps,
    foreign_classes,
    save_foreign,
    trained_model,
)
from tests.vision.test_model_families import FEW, facts, filled, make_image
from vision.training.published import _scale, describe
from vision.yolo.architecture import ArchitectureError, ModelDescription, build_shapes
from vision.yolo.checkpoint import load_checkpoint

FOREIGN_YOLOV9 = {
    **FOREIGN,
    **dict.fromkeys(
        (
            "AConv",
            "ADown",
            "CBFuse",
            "CBLinear",
            "ELAN1",
            "RepBottleneck",
            "RepCSP",
            "RepNCSPELAN4",
            "SPPELAN",
        ),
        "ultralytics.nn.modules.block",
    ),
    "RepConv": "ultralytics.nn.modules.conv",
}
Row = tuple[int | list[int], str, list[Any]]


def table(*rows: Row) -> dict[str, Any]:
    plain = [[source, 1, layer, arguments] for source, layer, arguments in rows]
    return {"nc": len(FEW), "backbone": plain, "head": []}


def yolov9(down: str, first: str) -> dict[str, Any]:
    """The rows of the scales t to c, narrow: `down` halves the size, `first` is the block at stride 4."""

    def block(channels: int) -> list[int]:
        return [channels, channels, channels // 2, 2 if first == "ELAN1" else 1]

    return table(
        (-1, "Conv", [8, 3, 2]),
        (-1, "Conv", [16, 3, 2]),
        (-1, first, block(16)[: 3 if first == "ELAN1" else 4]),
        (-1, down, [24]),
        (-1, "RepNCSPELAN4", block(24)),
        (-1, down, [32]),
        (-1, "RepNCSPELAN4", block(32)),
        (-1, down, [48]),
        (-1, "RepNCSPELAN4", block(48)),
        (-1, "SPPELAN", [48, 24]),
        (-1, "nn.Upsample", [None, 2, "nearest"]),
        ([-1, 6], "Concat", [1]),
        (-1, "RepNCSPELAN4", block(32)),
        (-1, "nn.Upsample", [None, 2, "nearest"]),
        ([-1, 4], "Concat", [1]),
        (-1, "RepNCSPELAN4", block(24)),
        (-1, down, [16]),
        ([-1, 12], "Concat", [1]),
        (-1, "RepNCSPELAN4", block(32)),
        (-1, down, [24]),
        ([-1, 9], "Concat", [1]),
        (-1, "RepNCSPELAN4", block(48)),
        ([15, 18, 21], "Detect", ["nc"]),
    )


def yolov9_e() -> dict[str, Any]:
    """Two backbones, the second fed by maps of the first, as in the largest scale."""
    return table(
        (-1, "nn.Identity", []),
        (-1, "Conv", [8, 3, 2]),
        (-1, "Conv", [16, 3, 2]),
        (-1, "ADown", [24]),
        (-1, "ADown", [32]),
        (-1, "ADown", [40]),
        (1, "CBLinear", [[8]]),
        (3, "CBLinear", [[8, 16]]),
        (5, "CBLinear", [[8, 16, 24]]),
        (0, "Conv", [8, 3, 2]),
        ([6, 7, 8, -1], "CBFuse", [[0, 0, 0]]),
        (-1, "Conv", [16, 3, 2]),
        ([7, 8, -1], "CBFuse", [[1, 1]]),
        (-1, "ADown", [24]),
        ([8, -1], "CBFuse", [[2]]),
        (-1, "RepNCSPELAN4", [24, 16, 8, 1]),
        (-1, "ADown", [32]),
        (-1, "ADown", [40]),
        ([15, 16, 17], "Detect", ["nc"]),
    )


def yolov3_tiny() -> dict[str, Any]:
    rows: list[Row] = []
    for channels in (8, 16, 24, 32, 40):
        rows += [(-1, "Conv", [channels, 3, 1]), (-1, "nn.MaxPool2d", [2, 2, 0])]
    return table(
        *rows,
        (-1, "Conv", [48, 3, 1]),
        (-1, "nn.ZeroPad2d", [[0, 1, 0, 1]]),
        (-1, "nn.MaxPool2d", [2, 1, 0]),
        (-1, "Conv", [48, 3, 1]),
        (-2, "Conv", [16, 1, 1]),
        (-1, "nn.Upsample", [None, 2, "nearest"]),
        ([-1, 8], "Concat", [1]),
        (-1, "Conv", [32, 3, 1]),
        ([17, 13], "Detect", ["nc"]),
    )


TABLES = {
    "YOLOv9, t to m": yolov9("AConv", "ELAN1"),
    "YOLOv9, c": yolov9("ADown", "RepNCSPELAN4"),
    "YOLOv9, e": yolov9_e(),
    "YOLOv3-tiny": yolov3_tiny(),
}
# The parts of "c" are also in the others.
READ = [pytest.param(name, marks=pytest.mark.slow) if name == "YOLOv9, c" else name for name in TABLES]
# As in `test_model_families`.
GOLDEN: dict[str, tuple[float, float, float]] = {
    "YOLOv9, t to m": (0.0320455, 0.211631, 0.0188872),
    "YOLOv9, c": (-0.0185499, 0.203102, -0.00218473),
    "YOLOv9, e": (-0.00725681, 0.225987, -0.0108867),
    "YOLOv3-tiny": (-0.0159809, 0.18707, 0.0010488),
}


def described(name: str) -> ModelDescription:
    return ModelDescription.from_plain(TABLES[name], FEW)


@pytest.mark.parametrize("name", TABLES)
def test_outputs_match_the_reference(name: str) -> None:
    model = filled(described(name))
    with torch.inference_mode():
        maps = model(make_image())
        folded = model.fuse()(make_image())
    expected = GOLDEN[name]
    assert facts(maps) == pytest.approx(expected, rel=0, abs=1e-4 * expected[1])
    assert facts(folded) == pytest.approx(expected, rel=0, abs=1e-3 * expected[1])


@pytest.mark.parametrize("name", READ)
def test_checkpoint_of_the_reference_is_read(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = trained_model(described(name))
    path = save_foreign(tmp_path / "net.pt", as_foreign(model, foreign_classes(monkeypatch, FOREIGN_YOLOV9)))
    assert_same_maps(load_checkpoint(path).model, model)


@pytest.mark.parametrize("name", READ)
def test_family_and_strides_are_recognised(name: str) -> None:
    model = build_shapes(described(name))
    tiny, found = name == "YOLOv3-tiny", describe(model, 64)
    assert found.model_family == name.partition(",")[0]
    assert model.strides == ((16, 32) if tiny else (8, 16, 32))
    assert found.gflops > 0
    assert found.scale == ("" if tiny else None)
    assert ModelDescription.from_plain(model.description.to_plain()) == model.description


@pytest.mark.parametrize(
    ("scale", "first", "pooling"),
    [("t", 16, 128), ("s", 32, 256), ("m", 32, 480), ("c", 64, 512), (None, 16, 256)],
)
def test_scale_is_known_by_its_channels(scale: str | None, first: int, pooling: int) -> None:
    rows = yolov9("AConv", "ELAN1")
    rows["backbone"][0][3] = [first, 3, 2]
    rows["backbone"][9][3] = [pooling, 64]
    assert _scale(ModelDescription.from_plain(rows, FEW), "YOLOv9") == scale


def test_scale_e_has_two_backbones() -> None:
    rows = yolov9_e()
    rows["backbone"][1][3] = [64, 3, 2]
    rows["backbone"].insert(18, [-1, 1, "SPPELAN", [512, 64]])
    assert describe(build_shapes(ModelDescription.from_plain(rows, FEW)), 64).scale == "e"


@pytest.mark.parametrize(
    ("name", "row", "changed", "expected"),
    [
        ("YOLOv9, t to m", 2, ("ELAN1", [16, 15, 8]), "even channels, got 15"),
        ("YOLOv9, t to m", 4, ("RepNCSPELAN4", [24, 24, 12, 5]), r"repeats .* 1\.\.4, got 5"),
        ("YOLOv9, t to m", 3, ("AConv", [24, 3]), "at most 1 arguments"),
        ("YOLOv9, e", 7, ("CBLinear", [[8, 0]]), "whole numbers from 1"),
        ("YOLOv9, e", 7, ("CBLinear", [8]), "must be a list"),
        ("YOLOv9, e", 12, ("CBFuse", [[0, 1]]), "map of 16 channels"),
        ("YOLOv9, e", 12, ("CBFuse", [[1, 9]]), "map of 16 channels"),
        ("YOLOv9, e", 12, ("CBFuse", [[1]]), "map of 16 channels"),
        ("YOLOv9, e", 0, ("nn.Identity", [1]), "at most 0 arguments"),
        ("YOLOv3-tiny", 1, ("nn.MaxPool2d", [3, 2, 0]), "pools 2×2"),
        ("YOLOv3-tiny", 1, ("nn.MaxPool2d", [2, 1, 0]), "must read a padding"),
        ("YOLOv3-tiny", 11, ("nn.ZeroPad2d", [[1, 1, 1, 1]]), "by one"),
        ("YOLOv3-tiny", 12, ("nn.MaxPool2d", [2, 2, 0]), "must read a padding"),
    ],
)
def test_row_that_cannot_be_built_is_named(
    name: str, row: int, changed: tuple[str, Sequence[Any]], expected: str
) -> None:
    rows = [list(each) for each in TABLES[name]["backbone"]]
    rows[row][2:] = [changed[0], list(changed[1])]
    with pytest.raises(ArchitectureError, match=rf"row {row} .*{expected}"):
        build_shapes(ModelDescription.from_plain(TABLES[name] | {"backbone": rows}, FEW))
