"""The detector on frames; and on real photographs, compared with an independent implementation."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from vision import detector as detector_module
from vision.detector import Detector
from vision.object_detector import resolve_classes
from vision.tracking.association import overlaps
from vision.training.published import yolov8_description
from vision.yolo.architecture import YoloModel, build
from vision.yolo.checkpoint import CheckpointError, save_checkpoint

NAMES = ("person", "bicycle", "car", "dog")
TEST_DATA = Path(
    os.environ.get("COMPANION_TEST_DATA", Path(__file__).resolve().parents[2].parent / "shared" / "data")
)
REFERENCE = TEST_DATA / "coco" / "reference_detections.json"
COCO_MODEL = TEST_DATA / "models" / "yolov8n_coco.pt"


def eager_model(class_id: int = 2) -> YoloModel:
    """A network that predicts a box of 2 × 2 cells of class `class_id` in every coarse cell."""
    torch.manual_seed(0)
    model = build(yolov8_description((0.1, 0.01, 64), NAMES)).eval()
    for level, branches in enumerate(zip(model.detect.cv2, model.detect.cv3, strict=True)):
        sides, classes = (list(branch.children())[-1] for branch in branches)
        for last in (sides, classes):
            last.get_parameter("weight").data.zero_()
            last.get_parameter("bias").data.fill_(-20.0)
        sides.get_parameter("bias").data.view(4, 16)[:, 1] = 20.0
        if level == 2:
            classes.get_parameter("bias").data[class_id] = 1.0
    return model


@pytest.fixture(scope="module")
def model_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("model") / "m.pt"
    save_checkpoint(path, eager_model(), metadata={"licence": "Apache-2.0"})
    return path


@pytest.fixture(scope="module")
def detector(model_path: Path) -> Detector:
    return detector_of(model_path, image_size=64)


@pytest.fixture(scope="module")
def larger_detector(model_path: Path) -> Detector:
    """Of inputs as large as the frame."""
    return detector_of(model_path, image_size=128)


@pytest.fixture
def frame() -> np.ndarray[Any, Any]:
    return np.random.default_rng(0).integers(0, 256, (64, 128, 3), np.uint8)


def detector_of(path: Path, **arguments: Any) -> Detector:
    """In float32: measuring the faster precision is not part of these tests and takes time."""
    return Detector(path, precision="float32", **arguments)


def test_boxes_are_in_the_pixels_of_the_frame(detector: Detector, frame: np.ndarray[Any, Any]) -> None:
    found = detector.detect(frame)
    # The input is half the frame's size; each cell of 32 predicts 2 × 2 cells around its centre.
    assert len(found) == 2
    assert set(found.names) == {"car"}
    np.testing.assert_allclose(sorted(found.xyxy.tolist()), [[0, 0, 96, 64], [32, 0, 128, 64]], atol=0.05)
    assert found.xyxy.dtype == np.float32
    assert found.confidence[0] == pytest.approx(1 / (1 + np.exp(-1.0)), abs=1e-3)


def test_a_frame_of_another_size_needs_no_new_detector(detector: Detector) -> None:
    for height, width in ((64, 128), (128, 96), (33, 250), (1, 1)):
        found = detector.detect(np.zeros((height, width, 3), np.uint8))
        assert np.all(found.xyxy >= 0)
        assert np.all(found.xyxy <= [width, height, width, height])


def test_only_requested_classes_are_reported(model_path: Path, frame: np.ndarray[Any, Any]) -> None:
    assert len(detector_of(model_path, classes=["car"], image_size=64).detect(frame))
    assert len(detector_of(model_path, classes=["person", 2], image_size=64).detect(frame))
    assert not len(detector_of(model_path, classes=["person", 1], image_size=64).detect(frame))


@pytest.mark.parametrize("change", ["read-only", "mirrored", "a part of a larger one", "channels turned"])
def test_frame_may_have_any_memory_layout(
    detector: Detector, larger_detector: Detector, frame: np.ndarray[Any, Any], change: str
) -> None:
    larger = np.zeros((100, 200, 3), np.uint8)
    changed = {
        "read-only": frame.copy(),
        "mirrored": frame[:, ::-1],
        "a part of a larger one": larger[:64, :128],
        "channels turned": frame[..., ::-1],
    }[change]
    if change == "a part of a larger one":
        changed[:] = frame
    changed.flags.writeable = change != "read-only"
    for each in (detector, larger_detector):
        expected = each.detect(np.ascontiguousarray(changed).copy())
        np.testing.assert_array_equal(each.detect(changed).xyxy, expected.xyxy)


def test_sparse_boxes_equal_dense_boxes(
    model_path: Path,
    larger_detector: Detector,
    frame: np.ndarray[Any, Any],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    one_by_one = larger_detector.detect(frame)
    monkeypatch.setattr(detector_module, "_SPARSE_FROM", 2.0)
    whole = detector_of(model_path, image_size=128).detect(frame)
    np.testing.assert_allclose(one_by_one.xyxy, whole.xyxy, atol=1e-3)
    assert len(whole) == 8


def test_prepared_detector_detects_and_times_its_stages(
    model_path: Path, frame: np.ndarray[Any, Any]
) -> None:
    detector = detector_of(model_path, image_size=64)
    detector.prepare(128, 64)
    assert detector.threads >= 1
    assert detector.last_timing is None
    assert len(detector.detect(frame)) == 2
    timing = detector.last_timing
    assert timing is not None
    assert min(timing.preprocess_ms, timing.inference_ms, timing.postprocess_ms) > 0
    assert timing.total_ms == timing.preprocess_ms + timing.inference_ms + timing.postprocess_ms


def test_detector_exposes_its_model_metadata(detector: Detector) -> None:
    assert detector.class_names == NAMES
    assert detector.metadata == {"licence": "Apache-2.0"}
    assert detector.description is not None
    assert detector.description.class_names == NAMES


def test_nms_threshold_of_a_model_is_used_unless_one_is_given(
    model_path: Path, tmp_path: Path, frame: np.ndarray[Any, Any]
) -> None:
    def boxes(path: Path, iou: float | None = None) -> list[list[float]]:
        found: list[list[float]] = detector_of(path, iou=iou, image_size=64).detect(frame).xyxy.tolist()
        return found

    strict, default = boxes(model_path, 0.0), boxes(model_path, 0.7)
    assert len(strict) != len(default)
    assert boxes(model_path) == default
    save_checkpoint(tmp_path / "m.pt", eager_model(), metadata={"nms_iou": 0.0})
    assert boxes(tmp_path / "m.pt") == strict
    assert boxes(tmp_path / "m.pt", 0.7) == default


@pytest.mark.parametrize("stated", ["0.5", True, 1.5, float("nan"), [0.5]])
def test_nms_threshold_of_a_model_is_a_number_from_0_to_1(tmp_path: Path, stated: Any) -> None:
    save_checkpoint(tmp_path / "m.pt", eager_model(), metadata={"nms_iou": stated})
    with pytest.raises(CheckpointError, match=r"m\.pt: nms_iou .*0\.\.1"):
        detector_of(tmp_path / "m.pt")


def test_bfloat16_detects_the_same(detector: Detector, model_path: Path, frame: np.ndarray[Any, Any]) -> None:
    half = Detector(model_path, image_size=64, precision="bfloat16")
    assert (detector.precision, half.precision) == ("float32", "bfloat16")
    a, b = detector.detect(frame), half.detect(frame)
    np.testing.assert_allclose(sorted(a.xyxy.tolist()), sorted(b.xyxy.tolist()), atol=1.0)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        pytest.param({"classes": ["persn"]}, "'persn'; .*person", id="near name"),
        pytest.param({"classes": ["zebra"]}, "'zebra'", id="far name"),
        pytest.param({"classes": [4]}, r"classes 0\.\.3, not 4", id="id too large"),
        pytest.param({"classes": [-1]}, r"classes 0\.\.3, not -1", id="negative id"),
        pytest.param({"classes": "car"}, "must be a list", id="a bare text"),
        pytest.param({"classes": []}, "must be a list", id="no class"),
        pytest.param({"confidence": 1.5}, r"confidence .*0\.\.1, got 1.5", id="confidence"),
        pytest.param({"confidence": float("nan")}, r"confidence .*0\.\.1", id="not a number"),
        pytest.param({"iou": -0.1}, r"iou .*0\.\.1, got -0.1", id="iou"),
        pytest.param({"image_size": 100}, "multiple of 32", id="image size"),
        pytest.param({"precision": "float8"}, "bfloat16, float16", id="precision"),
        pytest.param({"runtime": "tflite"}, "auto, torch, onnxruntime", id="runtime"),
        pytest.param({"threads": 0}, "threads", id="threads"),
    ],
)
def test_a_setting_out_of_its_range_is_rejected_by_name(
    model_path: Path, arguments: dict[str, Any], expected: str
) -> None:
    with pytest.raises(ValueError, match=expected):
        Detector(model_path, **arguments)


def test_classes_may_be_names_or_ids_or_ids_as_text() -> None:
    assert resolve_classes(["dog", 0, "2", "Car"], NAMES) == (0, 2, 3)


def test_a_class_whose_name_is_a_number_is_found_by_name() -> None:
    assert resolve_classes(["7"], ("5", "7")) == (1,)


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((4, 4), np.uint8),
        np.zeros((4, 4, 4), np.uint8),
        np.zeros((4, 4, 3), np.float32),
        np.zeros((0, 4, 3), np.uint8),
    ],
    ids=["grey", "with alpha", "float", "empty"],
)
def test_invalid_frame_is_rejected(detector: Detector, image: np.ndarray[Any, Any]) -> None:
    with pytest.raises(ValueError, match="frame"):
        detector.detect(image)


def test_missing_bundled_model_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(detector_module, "DEFAULT_EXPORT", tmp_path / "default.onnx")
    with pytest.raises(CheckpointError, match=r"companion learn train"):
        Detector()


@pytest.mark.skipif(not REFERENCE.is_file(), reason=f"{REFERENCE} is not here; set COMPANION_TEST_DATA")
@pytest.mark.parametrize(
    ("variant", "arguments", "every"),
    [
        ("rect", {}, 4),
        ("rect_person_car", {"classes": [0, 2]}, 4),
        ("square", {"square": True}, 4),
        pytest.param("rect", {}, 1, marks=pytest.mark.slow),
        pytest.param("rect_person_car", {"classes": [0, 2]}, 1, marks=pytest.mark.slow),
        pytest.param("square", {"square": True}, 1, marks=pytest.mark.slow),
    ],
)
def test_real_photographs_match_the_reference(variant: str, arguments: dict[str, Any], every: int) -> None:
    """Fast variants on some: among them are photographs with and without an object of the classes."""
    detector = Detector(COCO_MODEL, precision="float32", **arguments)
    for entry in json.loads(REFERENCE.read_text())["images"][::every]:
        image = cv2.imread(str(TEST_DATA / "coco" / "images" / entry["name"]))
        assert image is not None
        if hashlib.sha256(image.tobytes()).hexdigest() != entry["pixels_bgr_sha256"]:
            pytest.skip("this machine's JPEG decoder gives other pixels than the reference's")
        found = detector.detect(np.asarray(image, np.uint8))
        unmatched = set(range(len(found)))
        for expected in entry[variant]:
            iou = overlaps(np.array([expected["xyxy"]]), found.xyxy)[0]
            overlap, best = max(
                (iou[index], index) for index in unmatched if found.class_id[index] == expected["class_id"]
            )
            assert overlap >= 0.99, (entry["name"], expected)
            assert found.confidence[best] == pytest.approx(expected["confidence"], abs=0.005)
            assert found.names[best] == expected["class_name"]
            unmatched.remove(best)
        assert all(found.confidence[index] <= 0.26 for index in unmatched), entry["name"]
