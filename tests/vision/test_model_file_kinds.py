"""The table of file kinds in `docs/models.md`: each row is made here and read."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn
from typer.testing import CliRunner

from companion.cli import app
from tests.vision.checkpoint_bombs import named, pickled
from tests.vision.foreign_checkpoints import (
    SMALL,
    as_foreign,
    foreign_classes,
    rotated,
    save_foreign,
    trained_model,
)
from tests.vision.foreign_files import (
    constant_onnx,
    stated,
    ultralytics_openvino,
    ultralytics_torchscript,
)
from tests.vision.runtimes.conftest import lively_model, make_image, needs
from tests.vision.test_yolov9 import FOREIGN_YOLOV9, described
from tests.vision.test_yolox import save_yolox
from vision.detector import Detector
from vision.runtimes.source import read_source
from vision.training.published import yolov8_description
from vision.weights import DEFAULT_WEIGHTS

needs("onnx", "onnxruntime", "openvino")

SIZE = (64, 96)
TWO = ("car", "dog")
TABLE = Path(__file__).parent.parent.parent / "docs" / "models.md"
HEADS = dict.fromkeys(("Segment", "Pose", "OBB"), "ultralytics.nn.modules.head")


def rows() -> dict[str, str]:
    """Kind → result, of the table below its heading; a row has one kind or more."""
    text = TABLE.read_text().partition("## Kinds of files")[2].partition("\n## ")[0]
    found = re.findall(r"^\| (.+?) \| (.+?) \|$", text, re.MULTILINE)
    return {kind: result for kinds, result in found if kinds != "Files" for kind in kinds.split("; ")}


def checkpoint(
    folder: Path, model: str = "DetectionModel", head: str = "Detect", rows: str | None = None
) -> Path:
    """As Ultralytics saves one; other heads have further branches. `rows`: a network of `test_yolov9`."""
    if head == "OBB":
        trained = trained_model(rotated(yolov8_description(SMALL, TWO)))
    else:
        trained = trained_model(None if rows is None else described(rows))
    with pytest.MonkeyPatch.context() as patch:
        tasks = dict.fromkeys(("SegmentationModel", "PoseModel", "OBBModel"), "ultralytics.nn.tasks")
        classes = foreign_classes(patch, FOREIGN_YOLOV9 | tasks | HEADS)
        whole = as_foreign(trained, classes | {"DetectionModel": classes[model]})
        if head in ("Segment", "Pose"):
            last = whole.model[-1]
            other = nn.Module.__new__(classes[head])
            other.__dict__ = dict(last.__dict__)
            other.cv4 = nn.ModuleList([nn.Conv2d(8, 4, 1)])
            other.proto = nn.Conv2d(8, 4, 1)
            whole.model[-1] = other
            whole.yaml["head"][-1] = [*whole.yaml["head"][-1][:2], head, ["nc", 4, 8]]
        return save_foreign(folder / "net.pt", whole)


def naming(name: str) -> Callable[[Path], Path]:
    """A checkpoint of this class of model: the reader sees the name first."""
    return lambda folder: pickled(folder / "net.pt", b"}X\x05\x00\x00\x00model" + named(name) + b")\x81s")


def ultralytics(
    outputs: dict[str, Any], size: tuple[Any, Any] = SIZE, input_type: str = "FLOAT", **others: Any
) -> Callable[[Path], Path]:
    metadata = stated(TWO, size, **others)
    return lambda folder: constant_onnx(
        folder / "net.onnx", outputs, size=size, metadata=metadata, input_type=input_type
    )


def bare(outputs: dict[str, Any], **others: Any) -> Callable[[Path], Path]:
    return lambda folder: constant_onnx(folder / "net.onnx", outputs, **others)


def openvino_folder(folder: Path) -> Path:
    onnx = CONSTANT["Ultralytics ONNX"](folder)
    return ultralytics_openvino(folder / "net_openvino_model", onnx, TWO, SIZE)


def torchscript_with_nms(folder: Path) -> Path:
    """It calls torchvision's operator, which is there only while the file is made."""
    make: Any = torch.library.Library
    library = make("torchvision", "DEF")
    library.define("nms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
    library.impl("nms", lambda boxes, scores, iou: torch.zeros(1, dtype=torch.int64), "CPU")
    try:
        return ultralytics_torchscript(
            folder / "net.torchscript", lively_model(), SIZE, nms=True, args={"nms": True}
        )
    finally:
        library._destroy()


@cache
def torchscript() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        made = ultralytics_torchscript(Path(folder) / "net.torchscript", lively_model(), SIZE)
        return made.read_bytes()


def written(name: str, content: bytes) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        (folder / name).write_bytes(content)
        return folder / name

    return write


def yolox_pth(folder: Path) -> Path:
    save_yolox(folder / "x.pth")
    return folder / "x.pth"


def zeros(*shape: int) -> Any:
    return np.zeros(shape, np.float32)


def one(*row: float, rows: int, fill: float = 0) -> Any:
    """(1, rows, channels): the first row is this, the others are `fill`."""
    array = np.full((1, rows, len(row)), fill, np.float32)
    array[0, 0] = row
    return array


# The only object of the constant outputs: class 1, confidence 0.9, (left, top, right, bottom) in pixels.
BOX = (20, 15, 40, 25)
CENTRED = (30, 20, 20, 10)
IN_UNITS = (30 / 96, 20 / 64, 20 / 96, 10 / 64)
IN_CELLS = (30 / 8, 20 / 8, np.log(20 / 8), np.log(10 / 8))
CELLS = one(*CENTRED, 0, 0.9, rows=126).swapaxes(1, 2)
SCORED: dict[str, Any] = {
    "labels": np.array([[1] + [0] * 8], np.int64),
    "boxes": one(*BOX, rows=9),
    "scores": np.array([[0.9] + [0] * 8], np.float32),
}


def in_pixels() -> Any:
    """As YOLOX gives them: each cell its own box, the object's in the first."""
    cells = [
        (stride * (x + 0.5), stride * (y + 0.5), stride, stride, *[0] * 81)
        for stride in (8, 16, 32)
        for y in range(SIZE[0] // stride)
        for x in range(SIZE[1] // stride)
    ]
    cells[0] = (*CENTRED, 0.9, 0, 1, *[0] * 78)
    return np.array([cells], np.float32)


def logits(classes: int) -> Any:
    return one(-9, np.log(9), *[-9] * (classes - 2), rows=9, fill=-9)


CONSTANT: dict[str, Callable[[Path], Path]] = {
    "YOLOX `.onnx`, boxes in cells": bare({"output": one(*IN_CELLS, 0.9, 0, 1, *[0] * 78, rows=126)}),
    "… boxes decoded in the file": bare({"output": in_pixels()}),
    "Ultralytics ONNX": ultralytics({"output0": CELLS}),
    "… `dynamic=True`": ultralytics(
        {"output0": CELLS}, size=("height", "width"), args={"dynamic": True, "nms": None}
    ),
    "… `half=True`": ultralytics(
        {"output0": CELLS.astype(np.float16)}, input_type="FLOAT16", args={"half": True}
    ),
    "… of another size, also not square": ultralytics(
        {"output0": one(*np.multiply(CENTRED, 2), 0, 0.9, rows=504).swapaxes(1, 2)}, size=(128, 192)
    ),
    "… with `nms=True`, or of an end-to-end head": ultralytics(
        {"output0": one(*BOX, 0.9, 1, rows=300)}, args={"nms": True}
    ),
    "… segmentation, pose, oriented boxes": ultralytics(
        {"output0": one(*CENTRED, 0, 0.9, 0, rows=126).swapaxes(1, 2)}, task="obb"
    ),
    "… RT-DETR (ONNX)": ultralytics({"output0": one(*IN_UNITS, 0, 0.9, rows=300)}, head="RTDETRDecoder"),
    "YOLOv5 ONNX": bare(
        {"output": one(*CENTRED, 0.9, 0, 1, rows=126)}, metadata={"stride": 32, "names": list(TWO)}
    ),
    "RT-DETR, D-FINE ONNX of their authors": bare(SCORED, takes_size=True),
    "RF-DETR ONNX": bare({"dets": one(*IN_UNITS, rows=9), "labels": logits(91)}),
    "ONNX with boxes and logits": bare({"logits": logits(80), "pred_boxes": one(*IN_UNITS, rows=9)}),
    "Ultralytics OpenVINO folder": openvino_folder,
}
FILES: dict[str, Callable[[Path], Path]] = {
    "our pair, `.safetensors` and `.yaml`": lambda folder: DEFAULT_WEIGHTS,
    "Ultralytics `.pt`: YOLOv5u, v8, v10, 11, 12, 26": checkpoint,
    "… segmentation, v8 and 11": lambda folder: checkpoint(folder, "SegmentationModel", "Segment"),
    "… pose, v8 and 11": lambda folder: checkpoint(folder, "PoseModel", "Pose"),
    "… oriented boxes, v8 and 11": lambda folder: checkpoint(folder, "OBBModel", "OBB"),
    "… classification": naming("ultralytics.nn.tasks.ClassificationModel"),
    "… YOLO-World": naming("ultralytics.nn.tasks.WorldModel"),
    "… YOLOE": naming("ultralytics.nn.tasks.YOLOEModel"),
    "… RT-DETR": naming("ultralytics.nn.tasks.RTDETRDetectionModel"),
    "… YOLOv9": lambda folder: checkpoint(folder, rows="YOLOv9, t to m"),
    "… YOLOv3-tiny": lambda folder: checkpoint(folder, rows="YOLOv3-tiny"),
    "`.pt` of the repositories YOLOv5 (not YOLOv5u) and YOLOv7": naming("models.yolo.Model"),
    "`.pt` of YOLOv6": naming("yolov6.models.yolo.Model"),
    "`.pth` of YOLO-NAS": naming("super_gradients.training.models.YoloNAS"),
    "YOLOX `.pth`": yolox_pth,
    **{
        kind: CONSTANT[kind]
        for kind in (
            "YOLOX `.onnx`, boxes in cells",
            "… boxes decoded in the file",
            "Ultralytics ONNX",
            "… `dynamic=True`",
            "… `half=True`",
            "… of another size, also not square",
        )
    },
    "… with `nms=True`, or of an end-to-end head": CONSTANT["… with `nms=True`, or of an end-to-end head"],
    "… segmentation, pose, oriented boxes": CONSTANT["… segmentation, pose, oriented boxes"],
    "… classification (ONNX)": ultralytics({"output0": zeros(1, 2)}, task="classify"),
    "… RT-DETR (ONNX)": CONSTANT["… RT-DETR (ONNX)"],
    "YOLOv5 ONNX": CONSTANT["YOLOv5 ONNX"],
    "RT-DETR, D-FINE ONNX of their authors": CONSTANT["RT-DETR, D-FINE ONNX of their authors"],
    "RF-DETR ONNX": CONSTANT["RF-DETR ONNX"],
    "ONNX with boxes and logits": CONSTANT["ONNX with boxes and logits"],
    "other ONNX, also of YOLO-NAS": bare({"out": zeros(1, 5)}),
    "Ultralytics OpenVINO folder": CONSTANT["Ultralytics OpenVINO folder"],
    "Ultralytics TorchScript": lambda folder: written("net.torchscript", torchscript())(folder),
    "… with `nms=True` (TorchScript)": torchscript_with_nms,
    "TorchScript named `.pt`": lambda folder: written("net.pt", torchscript())(folder),
    "TensorRT plan of others": written("net.engine", bytes(64)),
    "`.tflite`": written("net.tflite", b"\x1c\x00\x00\x00TFL3"),
}


def test_every_kind_of_the_table_is_made_here() -> None:
    assert rows().keys() == FILES.keys()


@pytest.mark.usefixtures("untried")
@pytest.mark.parametrize("kind", list(FILES))
def test_file_of_each_kind_does_what_the_table_says(tmp_path: Path, kind: str) -> None:
    path, result = FILES[kind](tmp_path), rows()[kind]
    if result.startswith("works"):
        source = read_source(path)
        confidence = 0.5 if kind in CONSTANT else 0
        detector = Detector(
            path,
            runtime=source.runners()[0],
            image_size=96,
            threads=1,
            confidence=confidence,
            precision="auto" if source.fixed_precision else "float32",
        )
        found = detector.detect(make_image(64, 96))
        if kind in CONSTANT:
            np.testing.assert_allclose(found.xyxy, [BOX], rtol=1e-2)
            np.testing.assert_allclose(found.confidence, [0.9], rtol=1e-2)
            assert found.class_id.tolist() == [1]
        else:
            assert len(found) > 0
        return
    refused = CliRunner().invoke(app, ["models", "show", str(path)])
    assert refused.exit_code == 2
    (line,) = refused.stderr.splitlines()
    assert result.strip("`") in line
    assert str(path) in line
    assert "not use" not in line
    if kind in ("`.pt` of YOLOv6", "`.pth` of YOLO-NAS"):
        assert "export" not in line  # which is not supported either


def test_segmentation_has_the_boxes_of_its_detector(tmp_path: Path) -> None:
    path = checkpoint(tmp_path, "SegmentationModel", "Segment")
    image = make_image(64, 96)
    segmentation = Detector(path, image_size=96, confidence=0, precision="float32", threads=1)
    boxes = segmentation.detect(image)
    detector = Detector(checkpoint(tmp_path), image_size=96, confidence=0, precision="float32", threads=1)
    expected = detector.detect(image)
    assert len(boxes) == len(expected) > 0
    np.testing.assert_array_equal(boxes.xyxy, expected.xyxy)
    assert segmentation.metadata["task"].startswith("segment")
