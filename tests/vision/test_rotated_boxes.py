"""Checkpoints of rotated boxes: the network gives the boxes that enclose them."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from tests.vision.foreign_checkpoints import (
    FOREIGN,
    NAMES,
    SMALL,
    as_foreign,
    foreign_classes,
    rotated,
    save_foreign,
    trained_model,
)
from tests.vision.runtimes.conftest import make_image, needs
from tests.vision.small_network import small_description
from vision.detector import Detector
from vision.exports.export import export
from vision.foreign.layouts import TASKS
from vision.runtimes.base import RuntimeUnusableError
from vision.runtimes.network import Network
from vision.runtimes.source import runtime_of_file
from vision.training.fine_tuning import extend_classes
from vision.training.published import published_description
from vision.yolo.architecture import ArchitectureError, build
from vision.yolo.heads import OBB

OBB_FOREIGN = FOREIGN | {"OBB": "ultralytics.nn.modules.head", "OBBModel": "ultralytics.nn.tasks"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("rotated")


def checkpoint(folder: Path, family: str) -> Path:
    """With the head of this family."""
    path = folder / f"{family}.pt"
    if path.exists():
        return path
    description = replace(small_description(NAMES), light_classes=family == "YOLO11")
    model = trained_model(rotated(description))
    with pytest.MonkeyPatch.context() as patch:
        classes = foreign_classes(patch, OBB_FOREIGN)
        whole = as_foreign(model, classes | {"DetectionModel": classes["OBBModel"]})
        return save_foreign(path, whole)


@pytest.mark.parametrize("degrees", [-44, -20, 0, 30, 45, 90, 134])
def test_head_gives_the_box_around_the_rotated_one(degrees: float) -> None:
    head = OBB(2, (8,)).eval()
    left, top, right, bottom = 1, 4, 2, 7
    bins = torch.full((4, 16), -50.0)
    bins[range(4), (left, top, right, bottom)] = 50.0
    share = 0.25 + degrees / 180
    angle = torch.tensor([math.log(share / (1 - share))])
    for branch, bias in ((head.cv2, bins.flatten()), (head.cv4, angle)):
        *_, last = next(branch.children()).children()
        last.get_parameter("weight").data.zero_()
        last.get_parameter("bias").data.copy_(bias)
    (level,) = head([torch.rand(1, 8, 3, 5)])
    assert level.shape == (1, 4 + 2, 3, 5)
    # The corners, turned about the centre of the cell, clockwise in an image.
    x, y = np.array([-left, right, right, -left]), np.array([-top, -top, bottom, bottom])
    cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    turned_x, turned_y = x * cos - y * sin, x * sin + y * cos
    expected = [-turned_x.min(), -turned_y.min(), turned_x.max(), turned_y.max()]
    for cell in level[0, :4].detach().flatten(1).T:
        np.testing.assert_allclose(cell, expected, atol=1e-5)


@pytest.mark.parametrize("family", ["YOLOv8", pytest.param("YOLO11", marks=pytest.mark.slow)])
def test_checkpoint_and_its_export_find_the_same_boxes(
    folder: Path, family: str, caplog: pytest.LogCaptureFixture
) -> None:
    for package in ("onnx", "onnxruntime"):
        pytest.importorskip(package, reason=f"{package} is an optional extra")
    path = checkpoint(folder, family)
    image = make_image(64, 96)
    detector = Detector(path, image_size=96, confidence=0, precision="float32", threads=1)
    found = detector.detect(image)
    assert len(found) > 0
    assert detector.metadata["task"] == f"obb; {TASKS['obb']}"
    assert TASKS["obb"] in caplog.text
    assert "rotated boxes" in TASKS["obb"]
    exported = export(path, "onnx", image_size=96)
    again = Detector(exported, image_size=96, confidence=0, runtime="onnxruntime", threads=1).detect(image)
    np.testing.assert_allclose(again.xyxy, found.xyxy, atol=0.05)
    np.testing.assert_array_equal(again.class_id, found.class_id)


def test_openvino_in_bfloat16_gives_nearly_the_sides(folder: Path) -> None:
    needs("openvino")
    exported = export(checkpoint(folder, "YOLOv8"), "openvino", image_size=96)
    image = make_image(64, 96)
    try:
        rounded = runtime_of_file("openvino", exported, precision="bfloat16").infer(image)
    except RuntimeUnusableError as error:
        pytest.skip(str(error))
    exact = runtime_of_file("openvino", exported, precision="float32").infer(image)
    for found, expected in zip(rounded, exact, strict=True):
        assert found.sides is not None
        assert expected.sides is not None
        # In cells, of sides of about 10; a single rounding to bfloat16 would be up to 0.03.
        np.testing.assert_allclose(found.sides, expected.sides, atol=0.03)


def test_int8_export_keeps_sides_angles_and_classes_in_float(tmp_path: Path) -> None:
    onnx = pytest.importorskip("onnx", reason="onnx is an optional extra")
    pytest.importorskip("onnxruntime", reason="onnxruntime is an optional extra")
    photographs = tmp_path / "photographs"
    photographs.mkdir()
    for number in range(16):
        assert cv2.imwrite(str(photographs / f"{number:02}.png"), make_image(64, 64, seed=number))
    exported = export(checkpoint(tmp_path, "YOLO11"), "onnx", image_size=64, calibrate=photographs)
    graph = onnx.load(str(exported)).graph
    shapes = {weights.name: tuple(weights.dims) for weights in graph.initializer}
    quantised = {node.output[0]: node.input[0] for node in graph.node if node.op_type == "DequantizeLinear"}
    weights = [node.input[1] for node in graph.node if node.op_type == "Conv"]
    # The last ones of angles, classes and sides, at three levels.
    in_float = [shapes[name] for name in weights if name not in quantised]
    assert sorted(shape[0] for shape in in_float) == [1] * 3 + [len(NAMES)] * 3 + [4 * 16] * 3
    assert {shape[2:] for shape in in_float} == {(1, 1)}
    int8 = [shapes[quantised[name]] for name in weights if name in quantised]
    assert len([shape for shape in int8 if shape[1:] == (1, 3, 3)]) >= 2 * 3  # depthwise, of the classes


def test_network_gives_distances_of_all_cells() -> None:
    model = build(rotated(published_description("YOLOv8", SMALL, NAMES)))
    head = Network(model, sparse_boxes=True).head
    assert (head.reg_max, head.boxes, head.kinds) == (1, None, ("sides", "classes"))


def test_other_heads_of_rotated_boxes_are_refused() -> None:
    description = rotated(published_description("YOLO11", SMALL, NAMES))
    with pytest.raises(ArchitectureError, match="end-to-end"):
        build(replace(description, end_to_end=True))
    last = replace(description.head[-1], arguments=("nc", 2))
    with pytest.raises(ArchitectureError, match="and 1, got"):
        build(replace(description, head=(*description.head[:-1], last)))


def test_network_of_rotated_boxes_is_not_trained() -> None:
    model = build(rotated(published_description("YOLO11", SMALL, NAMES)))
    with pytest.raises(ValueError, match=r"OBB .*not.* trained"):
        extend_classes(model, ("boat",))
