"""torch on a CUDA device: the boxes of the processor, constant memory, one-line errors."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from mavlink_sim.datasets.training_scenes import random_scene
from tests.companion.command_line import companion_here
from tests.vision.runtimes.conftest import lively_model, make_image
from tests.vision.test_detector import COCO_MODEL, REFERENCE, TEST_DATA
from vision.detections import Detections
from vision.detector import Detector
from vision.runtimes.base import Precision, RuntimeUnusableError
from vision.runtimes.torch_runtime import TorchRuntime
from vision.tracking.association import overlaps

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")

MIB = 1 << 20


def scene(seed: int) -> NDArray[np.uint8]:
    return random_scene(np.random.default_rng(seed), 640, 480)[0]


def assert_contains(found: Detections, expected: Detections) -> None:
    """Each expected box well above the threshold was found, within rounding."""
    for xyxy, confidence, class_id in zip(expected.xyxy, expected.confidence, expected.class_id, strict=True):
        if confidence > 0.26:
            candidates = found[found.class_id == class_id]
            iou = overlaps(xyxy[None], candidates.xyxy)[0]
            assert iou.max(initial=0.0) >= 0.99
            assert candidates.confidence[iou.argmax()] == pytest.approx(confidence, abs=0.005)


@pytest.mark.parametrize("model", ["default", "yolov8n"])
def test_float32_boxes_equal_those_of_the_processor(model: str) -> None:
    if model == "default":
        images = [scene(seed) for seed in range(6)]
        path: str | Path = model
    else:
        if not REFERENCE.is_file():
            pytest.skip(f"{REFERENCE} is not here; set COMPANION_TEST_DATA")
        names = [entry["name"] for entry in json.loads(REFERENCE.read_text())["images"]][:4]
        read = [cv2.imread(str(TEST_DATA / "coco" / "images" / name)) for name in names]
        images = [np.asarray(image, np.uint8) for image in read if image is not None]
        path = COCO_MODEL
    processor = Detector(path, precision="float32")
    gpu = Detector(path, device="cuda")
    assert (gpu.precision, gpu.runtime) == ("float32", "torch")
    assert torch.cuda.get_device_name() in gpu.precision_reason
    boxes = 0
    for image in images:
        expected, found = processor.detect(image), gpu.detect(image)
        assert_contains(found, expected)
        assert_contains(expected, found)
        boxes += len(expected)
    assert boxes >= 4


@pytest.mark.parametrize("precision", ["bfloat16", "float16"])
def test_half_precision_is_close_and_returns_float32(precision: Precision) -> None:
    image = make_image(64, 96)
    full = TorchRuntime(lively_model(), precision="float32")
    half = TorchRuntime(lively_model(), precision=precision, device="cuda")
    assert half.precision == precision
    for a, b in zip(full.infer(image), half.infer(image), strict=True):
        assert b.classes.dtype == np.float32
        assert np.corrcoef(a.classes.ravel(), b.classes.ravel())[0, 1] > 0.99


def test_every_size_equals_the_processor() -> None:
    processor = TorchRuntime(lively_model(), precision="float32")
    gpu = TorchRuntime(lively_model(), device="cuda")
    for size in ((64, 96), (96, 64), (32, 32), (64, 96), (256, 320)):
        image = make_image(*size)
        for a, b in zip(processor.infer(image), gpu.infer(image), strict=True):
            np.testing.assert_allclose(b.classes, a.classes, atol=5e-3)


def test_prepared_detector_has_no_slow_first_frame() -> None:
    detector = Detector(device="cuda")
    detector.prepare(640, 480)

    def inference_ms() -> float:
        detector.detect(scene(0))
        assert detector.last_timing is not None
        return detector.last_timing.inference_ms

    first, *later = [inference_ms() for _ in range(20)]
    assert first < 5 * float(np.median(later)) + 20


def test_memory_does_not_grow_over_50_frames() -> None:
    detector = Detector(device="cuda", precision="float16")
    image = scene(0)
    used: list[tuple[int, int]] = []
    for _ in range(55):
        detector.detect(image)
        used.append((torch.cuda.memory_allocated(), torch.cuda.memory_reserved()))
    assert used[5] == used[-1]


@pytest.fixture
def little_memory() -> Iterator[None]:
    """Limit torch to 16 MiB more than it has now."""
    torch.cuda.empty_cache()
    total = torch.cuda.mem_get_info()[1]
    torch.cuda.set_per_process_memory_fraction((torch.cuda.memory_reserved() + 16 * MIB) / total)
    yield
    torch.cuda.set_per_process_memory_fraction(1.0)
    torch.cuda.empty_cache()


def test_full_memory_is_one_line_and_leaves_a_usable_runtime(little_memory: Any) -> None:
    runtime = TorchRuntime(lively_model(), device="cuda")
    with pytest.raises(RuntimeUnusableError, match=r"^device cuda: [^\n]* memory; [^\n]*image_size[^\n]*$"):
        runtime.infer(make_image(1920, 1920))
    assert runtime.infer(make_image(32, 32))[0].classes.shape[1:] == (4, 4)


def test_detect_command_runs_on_cuda(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "scene.png"), scene(0))
    lines = {}
    for device in ("cpu", "cuda"):
        arguments = ("--json", "--precision", "float32", "--device", device)
        done = companion_here("detect", "scene.png", *arguments, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        (lines[device],) = (json.loads(line) for line in done.stdout.splitlines())
    names = {device: [box["class_name"] for box in line["detections"]] for device, line in lines.items()}
    assert len(names["cuda"]) > 0
    assert sorted(names["cuda"]) == sorted(names["cpu"])
