"""Detecting again in recorded images: what matches, what differs, and what cannot be compared."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from companion.bench.lockstep_flight import plain_settings
from companion.bus.messages import detections_message
from companion.guidance.core import GuidanceOptions
from companion.recording import RecordingError
from companion.recording.convert import Converter
from companion.recording.encoding import dumps
from companion.recording.tap import run_record
from companion.replay_detections import replay_detections
from tests.companion.recording.lockstep_recording import new_writer
from vision.detections import Detections
from vision.detector import open_detector
from vision.object_detector import DetectorSettings
from vision.pipeline import PerceptionResult

IMAGES = 4
ONNX = {"detector.runtime": "onnxruntime", "detector.image_size": "160", "detector.confidence": "0"}


def recorded(model: Path, folder: Path, lost: int = 0, **changes: str) -> Path:
    """Record images with what the model detects, without tracking; `lost` detections are left out of each."""
    keys = {key.replace("__", "."): value for key, value in changes.items()}
    settings = plain_settings({"preview.annotate": "false", "tracker.enabled": "false", **ONNX, **keys})
    wanted = DetectorSettings(str(model), confidence=0.0, image_size=160, runtime="onnxruntime")
    detector = open_detector("yolo", wanted)
    writer, converter = new_writer(folder), Converter("vehicle1")

    def write(path: str, payload: bytes, attachment: bytes | None = None) -> None:
        for message in converter.convert(path, payload, attachment):
            writer.write(*message)

    write("@record/run", dumps(run_record(settings, GuidanceOptions(), (1, 191), "service1")))
    rng = np.random.default_rng(0)
    for sequence in range(IMAGES):
        image = cv2.resize(rng.integers(0, 255, (12, 16, 3), dtype=np.uint8), (160, 120))
        _, jpeg = cv2.imencode(".jpg", image)
        seen = cv2.imdecode(jpeg, cv2.IMREAD_COLOR)
        assert seen is not None
        found: Detections = detector.detect(seen.astype(np.uint8))[lost:]
        stamp_ns = 1_000_000_000 + sequence * 100_000_000
        result = PerceptionResult(sequence, stamp_ns, stamp_ns, 160, 120, found, {"total": 1.0}, dropped=0)
        message: Any = detections_message(result, "vehicle1", stamp_ns)
        write("detections", dumps(message))
        write("image", jpeg.tobytes(), json.dumps({"captured_ns": stamp_ns, "sequence": sequence}).encode())
    writer.close()
    return writer.path


def test_same_model_detects_the_same(exported_model: Path, tmp_path: Path) -> None:
    found = replay_detections([recorded(exported_model, tmp_path)], str(exported_model))
    assert found.images == IMAGES
    assert found.recorded == found.replayed == found.matched > IMAGES
    assert (found.differing_images, found.listed) == (0, [])
    assert found.mean_iou == pytest.approx(1.0, abs=1e-3)


def test_differing_detections_are_counted(exported_model: Path, tmp_path: Path) -> None:
    found = replay_detections([recorded(exported_model, tmp_path, lost=1)], str(exported_model))
    assert found.replayed - found.recorded == found.replayed - found.matched == IMAGES
    assert found.differing_images == len(found.listed) == IMAGES


def test_annotated_images_are_refused(exported_model: Path, tmp_path: Path) -> None:
    path = recorded(exported_model, tmp_path, preview__annotate="true")
    with pytest.raises(RecordingError, match="annotate"):
        replay_detections([path], str(exported_model))


def test_recording_without_images_is_refused(exported_model: Path, tmp_path: Path) -> None:
    writer = new_writer(tmp_path)
    settings = plain_settings({"preview.annotate": "false", **ONNX})
    run = run_record(settings, GuidanceOptions(), (1, 191), "service1")
    for message in Converter("vehicle1").convert("@record/run", dumps(run)):
        writer.write(*message)
    writer.close()
    with pytest.raises(RecordingError, match="images"):
        replay_detections([writer.path], str(exported_model))
