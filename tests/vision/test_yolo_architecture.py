"""The network built from its description."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest
import torch

from vision.training.published import yolov8_description
from vision.yolo.architecture import ArchitectureError, LayerSpec, ModelDescription, build

SMALL = (0.1, 0.01, 64)


def small_table(**changes: Any) -> dict[str, Any]:
    return yolov8_description(SMALL, ("car", "dog")).to_plain() | changes


def test_outputs_have_one_size_per_stride() -> None:
    model = build(yolov8_description(SMALL, ("car", "dog", "boat"))).eval()
    with torch.inference_mode():
        maps = model(torch.rand(2, 3, 96, 160))
    assert [tuple(level.shape) for level in maps] == [(2, 67, 12, 20), (2, 67, 6, 10), (2, 67, 3, 5)]


def test_training_reaches_every_parameter_but_the_bins() -> None:
    model = build(yolov8_description(SMALL, ("car", "dog")))
    sum(level.square().sum() for level in model(torch.rand(2, 3, 64, 64))).backward()
    without = [name for name, parameter in model.named_parameters() if parameter.grad is None]
    assert without == ["model.22.dfl.conv.weight"]


def test_description_survives_the_round_trip() -> None:
    description = dataclasses.replace(
        yolov8_description("m", ("a", "b")), activation="ReLU", reg_max=8, unscaled_channels=(64,)
    )
    assert ModelDescription.from_plain(description.to_plain()) == description


def test_the_table_of_scales_and_the_letter_choose_the_multiples() -> None:
    table = small_table(scales={"n": [0.33, 0.25, 1024], "x": [1.0, 1.25, 512]}, scale="x")
    description = ModelDescription.from_plain(table)
    assert (description.depth_multiple, description.width_multiple) == (1.0, 1.25)
    assert description.max_channels == 512
    del table["scale"]
    assert ModelDescription.from_plain(table).width_multiple == 0.25


def test_a_channel_count_that_is_declared_unscaled_stays() -> None:
    description = dataclasses.replace(yolov8_description("n", ("a",)), unscaled_channels=(64,))
    with torch.device("meta"):
        model = build(description)
    assert model.state_dict()["model.0.conv.weight"].shape[0] == 64
    assert model.state_dict()["model.1.conv.weight"].shape[:2] == (32, 64)


@pytest.mark.parametrize(
    ("position", "row", "expected"),
    [
        pytest.param(3, [-1, 1, "Quantum", [64]], r"row 3: .*'Quantum'", id="layer"),
        pytest.param(2, [-1, 1, "C2f", ["wide"]], r"row 2 \(C2f\): channels .*'wide'", id="channels"),
        pytest.param(2, [-1, 1, "C2f", [64, 3]], r"row 2 \(C2f\): the shortcut", id="shortcut"),
        pytest.param(2, [-1, 64, "C2f", [64]], r"", id="many repeats are cut by the depth multiple"),
        pytest.param(2, [-1, 10**9, "C2f", [64]], r"row 2: repeats", id="endless repeats"),
        pytest.param(1, [7, 1, "Conv", [64, 3, 2]], r"row 1 \(Conv\) reads \(7,\)", id="reads ahead"),
        pytest.param(1, ["x", 1, "Conv", [64]], r"row 1: 'from'", id="from"),
        pytest.param(1, [-1, 1, "Conv"], r"row 1 must be", id="short row"),
        pytest.param(1, [-1, 1, "Conv", [64, 2, 2]], r"row 1 \(Conv\): the kernel", id="even"),
        pytest.param(10, [-1, 1, "C2f", [64]], r"row 11 \(Concat\) .*sizes", id="not enlarged"),
        pytest.param(
            21,
            [[18, 15, 12], 1, "Detect", ["nc"]],
            r"row 21: Detect .*smaller",
            id="order",
        ),
        pytest.param(1, [-1, 1, "Conv", [64, 3, 2, 3]], r"its stride", id="padding"),
        pytest.param(1, [-1, 1, "C3k2", [64, 1]], r"row 1 \(C3k2\): .* C3k\b", id="C3k"),
        pytest.param(1, [-1, 1, "C3k2", [64, False, 0]], r"expansion ", id="ratio"),
        pytest.param(1, [-1, 1, "C3k2", [64, False, 0.5, False, 2]], r" groups", id="groups"),
        pytest.param(1, [-1, 1, "A2C2f", [8]], r"multiples of 32.* got 4", id="area heads"),
        pytest.param(12, [-1, 1, "C2PSA", [64]], r"16, got 8", id="attended"),
        pytest.param(2, [-1, 1, "PSA", [64, 1]], r"takes at most 1", id="PSA"),
        pytest.param(1, [-1, 1, "Detect", ["nc"]], r"row 1 is 'Detect'", id="early head"),
        pytest.param(9, [-1, 1, "SPPF", [64, 5, 1, 1, 1, 1]], r"row 9 \(SPPF\): .* most 5", id="arguments"),
    ],
)
def test_a_row_that_cannot_be_built_is_named(position: int, row: list[Any], expected: str) -> None:
    table = small_table()
    rows = table["backbone"] + table["head"]
    if position == 21:
        rows = rows[:21]
    rows[position : position + 1] = [row]
    table |= {"backbone": rows, "head": []}
    with torch.device("meta"):
        if not expected:
            build(ModelDescription.from_plain(table))
            return
        with pytest.raises(ArchitectureError, match=expected):
            build(ModelDescription.from_plain(table))


@pytest.mark.parametrize(
    "changes",
    [
        {"names": []},
        {"names": "car"},
        {"names": [1, 2]},
        {"depth_multiple": 0.0},
        {"width_multiple": "wide"},
        {"width_multiple": float("nan")},
        {"max_channels": -1},
        {"channels": 10**9},
        {"activation": "os.system"},
        {"backbone": None},
        {"head": "rows"},
        {"backbone": [], "head": []},
        {"scales": {"n": [1, 2]}},
        {"scales": {"n": [0.3, 0.3, 64]}, "scale": "q"},
        {"scales": 3},
        {"end2end": "yes"},
        {"light_classes": 1},
        {"class_width": 0},
        {"unscaled_channels": 3},
        {"unscaled_channels": ["x"]},
    ],
    ids=str,
)
def test_invalid_table_is_rejected_by_name(changes: dict[str, Any]) -> None:
    with torch.device("meta"), pytest.raises(ArchitectureError):
        build(ModelDescription.from_plain(small_table(**changes)))


def test_a_head_must_come_last() -> None:
    description = yolov8_description(SMALL, ("a",))
    cut = dataclasses.replace(description, head=description.head[:-1])
    with torch.device("meta"), pytest.raises(ArchitectureError, match=r"row 21 is 'C2f'"):
        build(cut)


def test_a_single_source_is_written_as_a_number() -> None:
    assert LayerSpec((-1,), 1, "Conv", (8,)).to_plain() == [-1, 1, "Conv", [8]]
    assert LayerSpec((-1, 6), 1, "Concat", (1,)).to_plain() == [[-1, 6], 1, "Concat", [1]]
