"""Every family and scale: parameters, names, outputs, the checkpoints of old and new releases.

The counts and output sums are facts of the published networks, measured on the reference implementation
by `tools/ultralytics_parity.py` and `tools/golden_maps.py`; no test needs it.
"""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.vision.dense_decoding import decoded
from vision.training.published import SCALES, _scale, describe, model_family_of, published_description
from vision.yolo.architecture import ModelDescription, YoloModel, build, build_shapes
from vision.yolo.postprocess import select_boxes

COCO_SIZED = [f"class {index}" for index in range(80)]
FEW = ("car", "dog", "boat")
PARAMETERS = {
    "YOLOv5u": {"n": 2_654_816, "s": 9_153_152, "m": 25_111_456, "l": 53_225_024, "x": 97_276_448},
    "YOLOv8": {"n": 3_157_200, "s": 11_166_560, "m": 25_902_640, "l": 43_691_520, "x": 68_229_648},
    "YOLOv10": {
        "n": 2_775_520,
        "s": 8_128_272,
        "m": 16_576_768,
        "b": 20_574_384,
        "l": 25_888_688,
        "x": 31_808_960,
    },
    "YOLO11": {"n": 2_624_080, "s": 9_458_752, "m": 20_114_688, "l": 25_372_160, "x": 56_966_176},
    "YOLO12": {"n": 2_602_288, "s": 9_284_096, "m": 20_199_168, "l": 26_450_784, "x": 59_210_784},
    "YOLO26": {"n": 2_572_280, "s": 10_009_784, "m": 21_896_248, "l": 26_299_704, "x": 58_993_368},
}
# Published, at 640 pixels; YOLO12's omit the products of attention, which are counted here.
GFLOPS = {"YOLOv5u": 7.7, "YOLOv8": 8.7, "YOLOv10": 6.7, "YOLO11": 6.5, "YOLO12": 7.5, "YOLO26": 5.4}
# Mean, root mean square and weighted sum of the outputs of `filled(small(…))` for `make_image()`.
GOLDEN = {
    ("YOLOv5u", "n"): (-0.0132937, 0.248442, 0.00280242),
    ("YOLOv8", "n"): (0.0403146, 0.225783, -0.0172437),
    ("YOLOv10", "n"): (0.0107275, 0.252185, 0.0230324),
    ("YOLOv10", "x"): (-0.00945716, 0.233676, 0.0011423),
    ("YOLO11", "n"): (-0.00551932, 0.239667, 0.00416131),
    ("YOLO11", "x"): (0.00853016, 0.206515, 0.00811196),
    ("YOLO12", "n"): (3.76203, 42.2215, -2.81803),
    ("YOLO12", "x"): (-1.33743, 17.9955, 0.623783),
    ("YOLO26", "n"): (0.0705329, 0.281783, 0.0281515),
    ("YOLO26", "x"): (0.00213748, 0.288321, 0.000241054),
}
EVERY = [(model_family, scale) for model_family, scales in PARAMETERS.items() for scale in scales]


def small(model_family: str, scale: str) -> ModelDescription:
    """The rows of a published network, with the multipliers of a small one, which is fast."""
    description = published_description(model_family, scale, FEW)
    return dataclasses.replace(description, depth_multiple=0.34, width_multiple=0.25, max_channels=1024)


def fill(state: dict[str, Tensor], seed: int = 7) -> None:
    """Weights that depend only on the names: the same numbers for any network with these names."""
    generator = torch.Generator().manual_seed(seed)
    for name in sorted(state):
        tensor = state[name]
        if name.endswith("num_batches_tracked") or ".dfl." in name:
            continue
        random = torch.rand(tensor.shape, generator=generator)
        if name.endswith("running_var"):
            tensor.copy_(0.5 + random)
        elif name.endswith(("bn.weight", "gamma")):
            tensor.copy_(0.6 + 0.5 * random)
        elif tensor.dim() == 4:
            tensor.copy_((random - 0.5) * (30 / tensor[0].numel()) ** 0.5)
        else:
            tensor.copy_(0.4 * random - 0.2)


def make_image() -> Tensor:
    """(1, 3, 64, 96): waves, a different one for each colour."""
    y, x = torch.meshgrid(torch.arange(64.0), torch.arange(96.0), indexing="ij")
    waves = [torch.sin(x / (3 + colour) + y / (7 - colour)) for colour in range(3)]
    return torch.stack(waves)[None] / 2 + 0.5


def facts(maps: list[Tensor]) -> tuple[float, float, float]:
    """The mean of all outputs, their root mean square, and a sum with distinct weights."""
    flat = torch.cat([level.flatten(2) for level in maps], dim=2).double().flatten()
    weights = torch.linspace(-1, 1, len(flat), dtype=torch.float64)
    return flat.mean().item(), flat.square().mean().sqrt().item(), (flat * weights).mean().item()


def filled(description: ModelDescription) -> YoloModel:
    model = build(description).eval()
    state = model.state_dict()
    fill(state)
    model.load_state_dict(state)
    return model


def lively(model_family: str = "YOLO26", scale: str = "n", **changes: object) -> YoloModel:
    return filled(dataclasses.replace(small(model_family, scale), **changes))  # type: ignore[arg-type]


@pytest.mark.parametrize(("model_family", "scale"), EVERY)
def test_each_scale_has_the_published_facts(model_family: str, scale: str) -> None:
    model = build_shapes(published_description(model_family, scale, COCO_SIZED))
    assert sum(parameter.numel() for parameter in model.parameters()) == PARAMETERS[model_family][scale]
    assert model_family_of(model) == model_family
    assert _scale(model.description, model_family) == scale
    if scale == "n":
        found = describe(model)
        assert (found.model_family, found.scale) == (model_family, scale)
        assert found.parameters == PARAMETERS[model_family][scale]
        assert found.end_to_end == (model_family in ("YOLOv10", "YOLO26"))
        assert found.gflops == pytest.approx(GFLOPS[model_family], abs=0.1)


def test_every_published_network_is_counted() -> None:
    assert {model_family: set(scales) for model_family, scales in SCALES.items()} == {
        model_family: set(scales) for model_family, scales in PARAMETERS.items()
    }


@pytest.mark.parametrize(("model_family", "scale"), GOLDEN)
def test_outputs_match_the_reference(model_family: str, scale: str) -> None:
    model = filled(small(model_family, scale))
    with torch.inference_mode():
        maps = model(make_image())
        folded = model.fuse()(make_image())
    expected = GOLDEN[model_family, scale]
    assert facts(maps) == pytest.approx(expected, rel=0, abs=1e-4 * expected[1])
    assert facts(folded) == pytest.approx(expected, rel=0, abs=1e-3 * expected[1])


@pytest.mark.parametrize(
    ("model_family", "scale", "names"),
    [
        ("YOLOv5u", "n", ("model.0.conv.weight", "model.2.cv3.conv.weight", "model.2.m.0.cv2.bn.bias")),
        (
            "YOLOv10",
            "n",
            ("model.5.cv2.conv.weight", "model.10.attn.pe.conv.weight", "model.10.ffn.1.bn.bias"),
        ),
        ("YOLOv10", "s", ("model.8.m.0.cv1.2.conv.conv.weight", "model.8.m.0.cv1.2.conv1.bn.bias")),
        (
            "YOLO11",
            "n",
            (
                *("model.2.m.0.cv1.conv.weight", "model.10.m.0.attn.qkv.conv.weight"),
                *("model.23.cv3.0.0.0.conv.weight", "model.23.cv3.0.1.1.bn.bias", "model.23.cv3.0.2.bias"),
            ),
        ),
        ("YOLO11", "m", ("model.2.m.0.cv3.conv.weight", "model.2.m.0.m.1.cv2.conv.weight")),
        (
            "YOLOv8",
            "n",
            (
                *("model.0.bn.running_var", "model.2.m.0.cv1.conv.weight", "model.9.cv2.bn.bias"),
                *("model.22.cv2.0.0.conv.weight", "model.22.cv3.2.2.bias", "model.22.dfl.conv.weight"),
            ),
        ),
        ("YOLO12", "n", ("model.6.m.0.0.attn.qkv.conv.weight", "model.6.m.0.1.mlp.1.bn.bias")),
        ("YOLO12", "l", ("model.6.gamma", "model.8.gamma", "model.6.m.3.1.attn.pe.conv.weight")),
        (
            "YOLO26",
            "n",
            (
                *("model.22.m.0.0.cv1.conv.weight", "model.22.m.0.1.attn.proj.conv.weight"),
                *("model.23.one2one_cv2.0.2.bias", "model.23.one2one_cv3.2.1.0.conv.weight"),
            ),
        ),
    ],
)
def test_parameter_names_match_published_checkpoints(
    model_family: str, scale: str, names: tuple[str, ...]
) -> None:
    state = build_shapes(published_description(model_family, scale, COCO_SIZED)).state_dict()
    assert set(names) <= set(state)


def test_a_head_without_distributions_has_no_bins() -> None:
    model = build_shapes(published_description("YOLO26", "n", COCO_SIZED))
    assert model.reg_max == 1
    assert not any(".dfl." in name for name in model.state_dict())


@pytest.mark.parametrize("model_family", SCALES)
def test_published_description_survives_the_round_trip(model_family: str) -> None:
    for scale in SCALES[model_family]:
        description = published_description(model_family, scale, FEW)
        assert ModelDescription.from_plain(description.to_plain()) == description


# Facts of a network


def test_gflops_grow_with_image_size_not_with_folding() -> None:
    model = build_shapes(published_description("YOLOv8", "n", COCO_SIZED))
    whole, quarter = describe(model, 640), describe(model, 320)
    assert whole.gflops == pytest.approx(4 * quarter.gflops)
    folded = describe(model.fuse(), 640)
    assert folded.gflops == whole.gflops
    assert folded.parameters < whole.parameters
    with pytest.raises(ValueError, match="multiple of 32, got 100"):
        describe(model, 100)


def test_folding_drops_the_branches_that_only_train() -> None:
    model = lively()
    with torch.inference_mode():
        before = model(make_image())
        after = model.fuse()(make_image())
    for a, b in zip(before, after, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-4)
    assert not any(".cv3." in name and "model.23." in name for name in model.state_dict())
    # The published count of YOLO26n as it runs.
    published = build_shapes(published_description("YOLO26", "n", COCO_SIZED)).fuse()
    assert sum(parameter.numel() for parameter in published.parameters()) == 2_408_932


def test_custom_networks_differ_from_published_ones() -> None:
    assert describe(lively("YOLO11"), 64).scale is None
    down = [[-1, 1, "Conv", [16, 3, 2]] for _ in range(6)]
    head = [-1, 1, "Detect", ["nc"]]
    for block, source, expected in (
        ("C2f", (2, 3, 4), "YOLOv8-P2"),
        ("C3", (3, 4, 5, 6), "YOLOv5u-P6"),
        ("C2", (3, 4, 5), "unknown"),
    ):
        rows = [*down[:2], [-1, 1, block, [16]], *down[2:]]
        table = {"backbone": rows, "head": [[list(source), *head[1:]]]}
        model = build(ModelDescription.from_plain(table, FEW))
        assert describe(build_shapes(model.description), 64).model_family == expected
        assert [tuple(level.shape[2:]) for level in model(torch.zeros(2, 3, 64, 64))] == [
            (64 // stride, 64 // stride) for stride in model.strides
        ]


# End-to-end heads


def reference_boxes(
    model: YoloModel, maps: list[Tensor], confidence: float, most: int
) -> list[tuple[int, int]]:
    """(cell, class) of the boxes, by sorting every pair of the best cells."""
    scores = decoded(model, maps)[0, :, 4:]
    cells = scores.max(dim=1).values.argsort(descending=True, stable=True)[:most]
    pairs = [(scores[cell, kind].item(), int(cell), kind) for cell in cells for kind in range(len(FEW))]
    best = sorted(pairs, reverse=True)[:most]
    return [(cell, kind) for score, cell, kind in best if score > confidence]


@cache
def lively_outputs() -> tuple[YoloModel, list[Tensor]]:
    """No test changes them."""
    model = lively()
    with torch.inference_mode():
        return model, model(make_image())


@pytest.mark.parametrize("most", [5, 20, 300])
def test_the_best_pairs_of_cell_and_class_are_selected(most: int) -> None:
    model, maps = lively_outputs()
    dense = decoded(model, maps)[0]
    confidence = dense[:, 4:].max(dim=1).values.median().item()
    boxes = select_boxes(model, maps, confidence=confidence, most=most)
    expected = reference_boxes(model, maps, confidence, most)
    assert len(boxes) == len(expected) > 0
    for index, (cell, kind) in enumerate(expected):
        assert boxes.class_id[index] == kind
        assert boxes.confidence[index] == pytest.approx(dense[cell, 4 + kind].item(), abs=1e-6)
        assert boxes.xyxy[index] == pytest.approx(dense[cell, :4].numpy(), abs=1e-3)


def test_overlapping_boxes_of_an_end_to_end_head_are_all_kept() -> None:
    model, maps = lively_outputs()
    many = select_boxes(model, maps, confidence=0.0, iou=0.0, most=1000)
    assert len(many) == sum(level.shape[2] * level.shape[3] for level in maps) * len(FEW)


def test_a_class_filter_gives_what_filtering_afterwards_gives() -> None:
    model, maps = lively_outputs()
    every = select_boxes(model, maps, confidence=0.3, most=1000)
    only = select_boxes(model, maps, confidence=0.3, most=1000, class_ids=(0, 2))
    kept = every.class_id != 1
    assert 0 < len(only) < len(every)
    np.testing.assert_array_equal(only.xyxy, every.xyxy[kept])
    np.testing.assert_array_equal(only.class_id, every.class_id[kept])


def test_no_box_above_the_confidence_is_an_empty_list() -> None:
    boxes = select_boxes(*lively_outputs(), confidence=1.0)
    assert (len(boxes), boxes.xyxy.shape) == (0, (0, 4))
    assert (boxes.confidence.dtype, boxes.class_id.dtype) == (np.dtype(np.float32), np.dtype(np.int64))


def test_end_to_end_head_trains_and_predicts_separately() -> None:
    model = lively()
    x = make_image()
    with torch.inference_mode():
        answered = model(x)
        model.detect.training = True  # Normalisation is unchanged, so that only the branches differ.
        learnt = model(x)
        model.detect.cv3, model.detect.one2one_cv3 = model.detect.one2one_cv3, model.detect.cv3
        model.detect.cv2, model.detect.one2one_cv2 = model.detect.one2one_cv2, model.detect.cv2
        exchanged = model(x)
    assert model.end_to_end
    for a, b, c in zip(answered, learnt, exchanged, strict=True):
        assert not torch.equal(a, b)
        assert torch.equal(a, c)
