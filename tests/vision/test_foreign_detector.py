"""Files of other exporters: recognised, run and decoded to the boxes that are in them."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from companion.cli import app
from tests.vision.foreign_files import (
    constant_onnx,
    stated,
    ultralytics_onnx,
    ultralytics_openvino,
    ultralytics_torchscript,
)
from tests.vision.runtimes.conftest import NAMES, lively_model, make_image, needs
from vision.detections import Detections
from vision.detector import Detector, class_names_of
from vision.foreign.class_names import COCO_NAMES, names_beside
from vision.foreign.layouts import Port, recognise
from vision.runtimes.base import RuntimeUnusableError, installed
from vision.runtimes.selection import RuntimeChoice
from vision.runtimes.source import read_source
from vision.yolo.checkpoint import save_checkpoint

pytest.importorskip("onnx", reason="onnx is an optional extra")
pytest.importorskip("onnxruntime", reason="onnxruntime is an optional extra")

SIZE = (64, 96)
TWO = ("car", "dog")


@pytest.fixture(scope="module")
def exports(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """One network as a checkpoint and as Ultralytics' exports of it."""
    folder = tmp_path_factory.mktemp("exports")
    save_checkpoint(folder / "net.pt", lively_model(), metadata={})
    # The checkpoint has the weights in half precision.
    from vision.yolo.checkpoint import load_checkpoint

    def model() -> Any:
        return load_checkpoint(folder / "net.pt").model

    fixed = ultralytics_onnx(folder / "fixed.onnx", model(), SIZE)
    found = {
        "checkpoint": folder / "net.pt",
        "fixed": fixed,
        "dynamic": ultralytics_onnx(folder / "dynamic.onnx", model(), SIZE, dynamic=True),
        "torchscript": ultralytics_torchscript(folder / "net.torchscript", model(), SIZE),
    }
    if installed("openvino"):
        found["folder"] = ultralytics_openvino(folder / "net_openvino_model", fixed, NAMES, SIZE)
    return found


OPTIONS: dict[str, Any] = {"image_size": 96, "confidence": 0.3, "threads": 1, "precision": "float32"}


@pytest.fixture(scope="module")
def image() -> Any:
    """Without padding, so that a fixed size and a multiple of the stride are the same input."""
    return make_image(64, 96, seed=3)


@pytest.fixture(scope="module")
def expected(exports: dict[str, Path], image: Any) -> Detections:
    """The boxes of the checkpoint."""
    return Detector(exports["checkpoint"], square=False, **OPTIONS).detect(image)


def assert_same_boxes(expected: Detections, found: Detections) -> None:
    assert len(expected) == len(found)
    np.testing.assert_allclose(expected.xyxy, found.xyxy, atol=0.05)
    np.testing.assert_allclose(expected.confidence, found.confidence, atol=1e-3)
    assert expected.class_id.tolist() == found.class_id.tolist()


@pytest.mark.parametrize(
    ("kind", "runtime"),
    [
        ("fixed", "onnxruntime"),
        ("fixed", "openvino"),
        ("dynamic", "onnxruntime"),
        ("folder", "openvino"),
        ("torchscript", "torch"),
    ],
)
def test_export_has_the_boxes_of_its_checkpoint(
    exports: dict[str, Path], image: Any, expected: Detections, kind: str, runtime: RuntimeChoice
) -> None:
    if runtime == "openvino":
        needs("openvino")
    # Without a name on the runtime of its kind.
    named = runtime if (kind, runtime) == ("fixed", "openvino") else None
    export = Detector(exports[kind], runtime=named, **OPTIONS)
    assert len(expected) > 3
    assert_same_boxes(expected, export.detect(image))
    assert (export.class_names, export.runtime) == (NAMES, runtime)
    assert export.foreign is not None
    assert export.foreign.layout == "cells"
    assert export.foreign.fixed_size == (None if kind == "dynamic" else SIZE)


def test_classes_are_filtered_after_the_best_is_known(exports: dict[str, Path], image: Any) -> None:
    every = Detector(exports["fixed"], confidence=0.3, runtime="onnxruntime").detect(image)
    wanted = every.class_names[int(every.class_id[0])]
    some = Detector(exports["fixed"], classes=[wanted], confidence=0.3, runtime="onnxruntime").detect(image)
    assert_same_boxes(every[every.class_id == every.class_id[0]], some)
    assert class_names_of(exports["fixed"], "onnxruntime") == NAMES


def detect(path: Path, width: int = 96, height: int = 64, **options: Any) -> Detections:
    image = np.zeros((height, width, 3), np.uint8)
    return Detector(path, runtime="onnxruntime", **options).detect(image)


def columns(*rows: list[float], cells: int = 126) -> Any:
    """(1, channels, cells): the rows are the first cells, the others are zero."""
    array = np.zeros((1, len(rows[0]), cells), np.float32)
    array[0, :, : len(rows)] = np.transpose(rows)
    return array


def test_cells_are_suppressed_and_scaled_to_the_frame(tmp_path: Path) -> None:
    cells = columns([30, 20, 20, 10, 0.1, 0.9], [31, 20, 20, 10, 0, 0.8], [70, 40, 10, 10, 0.6, 0.2])
    path = constant_onnx(tmp_path / "a.onnx", {"output0": cells}, metadata=stated(TWO, SIZE))
    found = detect(path, width=192, height=128)
    np.testing.assert_allclose(found.xyxy, [[40, 30, 80, 50], [130, 70, 150, 90]])
    np.testing.assert_allclose(found.confidence, [0.9, 0.6])
    assert found.class_id.tolist() == [1, 0]


@pytest.mark.parametrize("marked", [{"args": {"nms": True}}, {"end2end": True}, {}])
def test_selected_boxes_are_taken_as_they_are(tmp_path: Path, marked: dict[str, Any]) -> None:
    rows = np.zeros((1, 300, 6), np.float32)
    rows[0, :3] = [[10, 10, 20, 20, 0.9, 2], [11, 10, 20, 20, 0.8, 2], [0, 0, 5, 5, 0.2, 1]]
    metadata = stated(("a", "b", "c"), SIZE, **marked)
    found = detect(constant_onnx(tmp_path / "a.onnx", {"output0": rows}, metadata=metadata))
    np.testing.assert_allclose(found.xyxy, [[10, 10, 20, 20], [11, 10, 20, 20]])
    assert found.class_id.tolist() == [2, 2]


@pytest.mark.parametrize("classes", [1, 2])
def test_objectness_multiplies_the_classes(tmp_path: Path, classes: int) -> None:
    """As of YOLOv5's own exporter, which states only names and stride."""
    rows = np.zeros((1, 126, 7), np.float32)
    rows[0, :2] = [[30, 20, 20, 10, 0.5, 0.2, 0.8], [50, 50, 4, 4, 0.1, 1, 0]]
    rows = rows[..., [0, 1, 2, 3, 4, *((5, 6) if classes == 2 else (6,))]]
    metadata = {"names": dict(enumerate(TWO[:classes])), "stride": 32}
    found = detect(constant_onnx(tmp_path / "a.onnx", {"output": rows}, metadata=metadata))
    np.testing.assert_allclose(found.xyxy, [[20, 15, 40, 25]])
    np.testing.assert_allclose(found.confidence, [0.4])
    assert found.class_id.tolist() == [classes - 1]


YOLOV5: dict[str, Any] = {"stride": 32}
ULTRALYTICS: dict[str, Any] = {"stride": 32, "task": "detect"}


@pytest.mark.parametrize(
    ("shape", "classes", "others", "layout"),
    [
        ((1, 25200, 6), 1, YOLOV5, "objectness"),
        ((1, None, 6), 1, YOLOV5, "objectness"),
        ((1, 25200, 7), 2, YOLOV5, "objectness"),
        ((1, None, 7), 2, YOLOV5, "objectness"),
        ((1, 5, 84), 1, ULTRALYTICS, "cells"),
        ((1, 6, None), 2, ULTRALYTICS, "cells"),
        ((1, 84, 84), 80, ULTRALYTICS, "cells"),
        ((1, 300, 6), 1, ULTRALYTICS, "selected"),
        ((1, 300, 6), 2, {**ULTRALYTICS, "end2end": True}, "selected"),
        ((1, 300, 6), 2, {**ULTRALYTICS, "args": {"nms": True}}, "selected"),
        ((1, 300, 6), 2, {**ULTRALYTICS, "head": "v10Detect"}, "selected"),
        ((1, 300, 5), 1, ULTRALYTICS, "queries"),
        ((1, 300, 6), 2, {**ULTRALYTICS, "head": "RTDETRDecoder"}, "queries"),
    ],
)
def test_few_classes_are_not_taken_for_another_layout(
    shape: tuple[int | None, ...], classes: int, others: dict[str, Any], layout: str
) -> None:
    metadata = {"names": dict.fromkeys(range(classes), "a"), **others}
    facts = recognise(Path("a.onnx"), metadata, [Port("images", (1, 3, None, None))], [Port("out", shape)])
    assert facts.layout == layout


@pytest.mark.parametrize("others", [YOLOV5, ULTRALYTICS, {**ULTRALYTICS, "end2end": False}])
def test_two_classes_of_an_unknown_head_are_refused(others: dict[str, Any]) -> None:
    """RT-DETR's queries and selected boxes have 6 columns each."""
    metadata = {"names": {0: "a", 1: "b"}, **others}
    with pytest.raises(RuntimeUnusableError, match=r"output0 \(1, 300, 6\).* 2 classes: .*head"):
        recognise(Path("a.onnx"), metadata, [Port("images", (1, 3, 64, 64))], [Port("output0", (1, 300, 6))])


def test_queries_are_stretched_and_not_suppressed(tmp_path: Path) -> None:
    """As of Ultralytics' RT-DETR: centre and size in 0..1 of a frame that is not padded."""
    queries = np.zeros((1, 300, 6), np.float32)
    queries[0, :2] = [[0.5, 0.5, 0.2, 0.4, 0.9, 0.1], [0.5, 0.5, 0.2, 0.4, 0.8, 0.1]]
    metadata = stated(TWO, SIZE, head="RTDETRDecoder")
    found = detect(constant_onnx(tmp_path / "a.onnx", {"output0": queries}, metadata=metadata), 100, 200)
    np.testing.assert_allclose(found.xyxy, [[40, 60, 60, 140]] * 2, rtol=1e-5)
    np.testing.assert_allclose(found.confidence, [0.9, 0.8])


@pytest.mark.parametrize(
    ("boxes", "logits", "classes"),
    [("dets", "labels", 91), ("pred_boxes", "logits", 80), ("pred_boxes", "logits", 4)],
)
def test_logits_of_queries_give_each_class_above_the_threshold(
    tmp_path: Path, boxes: str, logits: str, classes: int
) -> None:
    places, values = np.zeros((1, 9, 4), np.float32), np.full((1, 9, classes), -9, np.float32)
    places[0, 3] = [0.5, 0.25, 0.5, 0.5]
    values[0, 3, [1, 3]] = [2, 1]
    outputs = {boxes: places, logits: values}
    if boxes == "pred_boxes":
        outputs = {logits: values, boxes: places}
    if classes == 4:
        (tmp_path / "a.txt").write_text("a\nb\nc\nd\n")
    path = constant_onnx(tmp_path / "a.onnx", outputs)
    found = detect(path, 100, 200)
    np.testing.assert_allclose(found.xyxy, [[25, 0, 75, 100]] * 2, rtol=1e-5)
    np.testing.assert_allclose(found.confidence, 1 / (1 + np.exp([-2.0, -1.0])), rtol=1e-5)
    names = {91: ("person", "car"), 80: ("bicycle", "motorcycle"), 4: ("b", "d")}[classes]
    assert [record["class_name"] for record in found.records()] == list(names)


def test_rf_detr_is_normalised_by_the_statistics_of_imagenet(tmp_path: Path) -> None:
    boxes, logits = np.zeros((1, 9, 4), np.float32), np.zeros((1, 9, 91), np.float32)
    path = constant_onnx(tmp_path / "a.onnx", {"labels": logits, "dets": boxes}, red_at=(0, 5, 7))
    image = np.empty((64, 96, 3), np.uint8)
    image[:] = (10, 20, 30)
    found = Detector(path, runtime="onnxruntime", confidence=0).detect(image)
    red = (30 / 255 - 0.485) / 0.229
    np.testing.assert_allclose(found.confidence[0], 1 / (1 + np.exp(-red)), rtol=1e-5)


def test_labels_boxes_and_scores_are_taken_as_they_are(tmp_path: Path) -> None:
    """As the authors of RT-DETR and D-FINE export it: the file scales boxes to the size that it is given."""
    outputs: dict[str, Any] = {
        "labels": np.array([[2, 0, 0]], np.int64),
        "boxes": np.array([[[48, 16, 96, 32], [0, 0, 9, 9], [0, 0, 9, 9]]], np.float32),
        "scores": np.array([[0.9, 0.2, 0.1]], np.float32),
    }
    path = constant_onnx(tmp_path / "a.onnx", outputs, takes_size=True)
    found = detect(path, 192, 64)
    np.testing.assert_allclose(found.xyxy, [[96, 16, 192, 32]])
    assert [record["class_name"] for record in found.records()] == ["car"]


def test_class_without_a_name_is_refused_and_names_may_be_given(tmp_path: Path) -> None:
    """The number of classes is not in the file: the names of COCO are assumed."""
    outputs: dict[str, Any] = {
        "labels": np.array([[200]], np.int64),
        "boxes": np.array([[[48, 16, 96, 32]]], np.float32),
        "scores": np.array([[0.9]], np.float32),
    }
    path = constant_onnx(tmp_path / "a.onnx", outputs, takes_size=True)
    facts = read_source(path).foreign
    assert facts is not None
    assert facts.names_from.startswith("COCO, assumed")
    with pytest.raises(RuntimeUnusableError, match=r"class 200, 80 .*NAME\.txt") as caught:
        detect(path)
    assert str(caught.value).startswith(f"{path}: ")
    (tmp_path / "a.txt").write_text("\n".join(f"class {number}" for number in range(201)))
    assert [record["class_name"] for record in detect(path).records()] == ["class 200"]


@pytest.mark.parametrize("task", ["segment", "pose", "obb"])
def test_other_tasks_give_their_boxes(tmp_path: Path, task: str) -> None:
    turned = float(np.pi / 2)
    extra = {"segment": [7.0] * 32, "pose": [5.0] * 51, "obb": [turned]}[task]
    cells = columns([30, 20, 20, 10, 0.1, 0.9, *extra], cells=400)
    outputs = {"output0": cells} | (
        {"output1": np.zeros((1, 32, 4, 4), np.float32)} if task == "segment" else {}
    )
    path = constant_onnx(tmp_path / "a.onnx", outputs, metadata=stated(TWO, SIZE, task=task))
    expected = [[25, 10, 35, 30]] if task == "obb" else [[20, 15, 40, 25]]
    np.testing.assert_allclose(detect(path).xyxy, expected, atol=1e-4)


@pytest.mark.parametrize(("channel", "value"), [(0, 30 / 255), (1, 20 / 255), (2, 10 / 255)])
@pytest.mark.parametrize("kind", ["FLOAT", "FLOAT16"])
def test_input_is_rgb_in_0_to_1(tmp_path: Path, channel: int, value: float, kind: str) -> None:
    rows = np.zeros((1, 1, 6), np.float32 if kind == "FLOAT" else np.float16)
    path = constant_onnx(
        tmp_path / "a.onnx",
        {"output0": rows},
        red_at=(channel, 5, 7),
        input_type=kind,
        metadata=stated(TWO, SIZE, end2end=True),
    )
    image = np.empty((64, 96, 3), np.uint8)
    image[:] = (10, 20, 30)
    found = Detector(path, runtime="onnxruntime", confidence=0).detect(image)
    np.testing.assert_allclose(found.confidence, [value], rtol=1e-3)


def test_export_for_classification_is_refused(tmp_path: Path) -> None:
    path = constant_onnx(
        tmp_path / "a.onnx",
        {"output0": np.zeros((1, 2), np.float32)},
        metadata=stated(TWO, SIZE, task="classify"),
    )
    with pytest.raises(RuntimeUnusableError, match=r"'classify'; .*detect") as caught:
        read_source(path)
    assert str(caught.value).startswith(f"{path}: ")


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        ("{0: 'a', 2: 'b'}", "numbered from 0"),
        ("{0: 'a\\n', 1: 'b'}", "printable"),
        ("[" * 500, "printable texts"),
        ("__import__('os').system('id')", "printable texts"),
        ("{}", "printable texts"),
    ],
)
def test_invalid_names_in_metadata_are_refused(tmp_path: Path, names: str, expected: str) -> None:
    path = constant_onnx(
        tmp_path / "a.onnx",
        {"output0": np.zeros((1, 6, 126), np.float32)},
        metadata={**stated(TWO, SIZE), "names": names},
    )
    with pytest.raises(RuntimeUnusableError, match=expected) as caught:
        read_source(path)
    assert str(caught.value).isprintable()


@pytest.mark.parametrize("key", ["names", "stride", "args"])
def test_long_text_in_metadata_is_not_parsed(key: str) -> None:
    metadata = {"names": "['a']", "stride": "32", "args": "{}", key: "[" + "1," * (1 << 15) + "]"}
    ports = [Port("images", (1, 3, 64, 64))], [Port("output0", (1, 5, 84))]
    with pytest.raises(RuntimeUnusableError, match=r"a\.onnx: .*65538 characters"):
        recognise(Path("a.onnx"), metadata, *ports)


def test_unknown_outputs_are_refused_with_their_shapes(tmp_path: Path) -> None:
    outputs = {"out": np.zeros((1, 5, 5), np.float32)}
    path = constant_onnx(tmp_path / "a.onnx", outputs, metadata=stated(TWO, SIZE))
    with pytest.raises(RuntimeUnusableError, match=r"^\S+: .*out \(1, 5, 5\) float32, .*2 classes"):
        read_source(path)
    with pytest.raises(RuntimeUnusableError, match=r"\(1, 5, 5\) float32, .*models export"):
        read_source(constant_onnx(tmp_path / "b.onnx", outputs))
    batch = constant_onnx(tmp_path / "c.onnx", outputs, size=(64, 96), input_type="UINT8")
    with pytest.raises(RuntimeUnusableError, match=r"expected .*\(1, 3, height, width\)"):
        read_source(batch)


def denied_for(name: str, read: Callable[..., Any]) -> Callable[..., Any]:
    """A function that opens files, and may not open those of this name."""

    def reads(path: Any, *arguments: Any, **options: Any) -> Any:
        if Path(path).name == name:
            raise PermissionError(13, "Permission denied")
        return read(path, *arguments, **options)

    return reads


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"caf\xe9\nb\n", "is not UTF-8"),
        (b"\x1b[31mred\nb\n", "is not printable"),
        (b"a\n", "1 names, .* 2 classes"),
        (b"a\n" * (1 << 20), "the limit is"),
        (None, r"\(Permission denied\)"),
    ],
)
def test_unusable_names_beside_are_refused_with_their_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: bytes | None, expected: str
) -> None:
    monkeypatch.chdir(tmp_path)
    outputs = {"pred_boxes": np.zeros((1, 9, 4), np.float32), "logits": np.zeros((1, 9, 2), np.float32)}
    path = constant_onnx(Path("rel.onnx"), outputs)
    Path("rel.txt").write_bytes(content or b"a\nb\n")

    if content is None:
        monkeypatch.setattr("os.open", denied_for("rel.txt", os.open))
    with pytest.raises(RuntimeUnusableError, match=expected) as caught:
        read_source(path)
    assert str(caught.value).startswith("rel.txt: ")
    assert str(caught.value).isprintable()


def test_names_beside_may_begin_with_a_byte_order_mark(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_bytes(b"\xef\xbb\xbfcar\r\ndog\r\n")
    assert names_beside(tmp_path / "a.onnx", 2) == (("car", "dog"), "a.txt")


def test_boxes_and_scores_of_yolo_nas_are_not_logits(tmp_path: Path) -> None:
    outputs = {"boxes": np.zeros((1, 126, 4), np.float32), "scores": np.zeros((1, 126, 80), np.float32)}
    with pytest.raises(RuntimeUnusableError, match=r"no metadata .*boxes \(1, 126, 4\)"):
        read_source(constant_onnx(tmp_path / "a.onnx", outputs))


def test_objectness_of_one_everywhere_is_not_yolox(tmp_path: Path) -> None:
    """YOLOv6's export has YOLOX's shapes, but takes RGB in 0..1 from the middle."""
    rows = np.zeros((1, 126, 85), np.float32)
    rows[..., 4] = 1
    path = constant_onnx(tmp_path / "a.onnx", {"outputs": rows})
    with pytest.raises(RuntimeUnusableError, match=r"YOLOX, .*YOLOv6, ") as caught:
        Detector(path, runtime="onnxruntime")
    assert str(caught.value).startswith(f"{path}: ")


@pytest.mark.parametrize("head", [b"", b"<?xml version='1.0'?>"])
def test_damaged_openvino_file_is_refused_without_openvino(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, head: bytes
) -> None:
    monkeypatch.setitem(sys.modules, "openvino", None)  # It would print its own lines.
    (tmp_path / "g.xml").write_bytes(head + np.random.default_rng(0).bytes(2000))
    (tmp_path / "g.bin").write_bytes(bytes(64))
    (tmp_path / "metadata.yaml").write_text("names: {0: car}\nstride: 32\n")
    result = CliRunner().invoke(app, ["models", "show", str(tmp_path)])
    assert result.exit_code == 2
    assert f"{tmp_path / 'g.xml'}: " in result.stderr
    assert "OpenVINO model: " in result.stderr
    assert "<net" in result.stderr
    assert len(result.stderr.splitlines()) == 1


def test_torchscript_must_give_what_it_states(tmp_path: Path) -> None:
    path = ultralytics_torchscript(tmp_path / "a.torchscript", lively_model(), SIZE, args={"nms": True})
    facts = read_source(path).foreign
    assert facts is not None
    assert facts.layout == "selected"
    with pytest.raises(RuntimeUnusableError, match=r"network gave .*\(selected\): "):
        Detector(path, runtime="torch").detect(make_image(64, 96))


def test_torchscript_that_calls_nms_says_how_to_export(
    exports: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    def load(*_: Any, **__: Any) -> None:
        raise RuntimeError("\nUnknown builtin op: torchvision::nms.\nCould not find")

    monkeypatch.setattr("torch.jit.load", load)
    with pytest.raises(RuntimeUnusableError, match=r"NMS; .*nms=True"):
        Detector(exports["torchscript"], runtime="torch")


REAL = os.environ.get("COMPANION_TEST_EXPORTS")


@pytest.mark.parametrize(
    ("marked", "precision"),
    [
        ({}, "float32"),
        ({"args": {"half": True}}, "float16"),
        ({"args": {"quantize": 8}}, "int8"),
        ({"onnx.infer": "onnxruntime.quant"}, "int8"),
    ],
)
def test_precision_of_a_file_is_its_own(tmp_path: Path, marked: dict[str, Any], precision: str) -> None:
    metadata = stated(NAMES, (64, 96), **marked)
    cells = np.zeros((1, 4 + len(NAMES), 126), np.float32)
    source = read_source(constant_onnx(tmp_path / "net.onnx", {"output0": cells}, metadata=metadata))
    assert source.foreign is not None
    assert source.foreign.precision == precision
    assert source.fixed_precision == (precision != "float32")


@pytest.mark.skipif(REAL is None, reason="COMPANION_TEST_EXPORTS names no folder of real exports")
def test_real_exports_are_recognised() -> None:
    for path in sorted(Path(REAL or "").iterdir()):
        if path.suffix in (".onnx", ".torchscript") or path.is_dir():
            source = read_source(path)
            assert source.foreign is not None, path
            assert source.class_names, path


def test_yolox_cells_are_decoded_here_or_in_the_file(tmp_path: Path) -> None:
    """Strides 8, 16 and 32: 96 + 24 + 6 cells of an input of 96x64 pixels; BGR bytes, at the upper left."""
    raw = np.zeros((1, 126, 85), np.float32)
    raw[0, :, :2] = 0.4
    raw[0, 96 + 7, :7] = [0.5, 0.25, np.log(2), np.log(1), 0.9, 0.0, 0.8]
    decoded = np.zeros_like(raw)
    first = 0
    for stride, rows, across in ((8, 8, 12), (16, 4, 6), (32, 2, 3)):
        y, x = np.divmod(np.arange(rows * across), across)
        part = slice(first, first + rows * across)
        decoded[0, part, 0], decoded[0, part, 1] = (
            (raw[0, part, 0] + x) * stride,
            (raw[0, part, 1] + y) * stride,
        )
        decoded[0, part, 2:4] = np.exp(raw[0, part, 2:4]) * stride
        first += rows * across
    decoded[0, :, 4:] = raw[0, :, 4:]
    for name, array, layout in (("raw", raw, "yolox"), ("decoded", decoded, "objectness")):
        path = constant_onnx(tmp_path / f"{name}.onnx", {"output": array})
        detector = Detector(path, runtime="onnxruntime")
        assert detector.foreign is not None
        assert detector.foreign.layout == layout
        assert detector.class_names == COCO_NAMES
        found = detector.detect(np.zeros((128, 96, 3), np.uint8))
        # Cell (1, 1) of stride 16; the frame is shown at half its size.
        np.testing.assert_allclose(found.xyxy, [[16, 24, 80, 56]], rtol=1e-5)
        np.testing.assert_allclose(found.confidence, [0.72], rtol=1e-5)
        assert found.class_id.tolist() == [1]
