"""The bundled model: an export for ONNX Runtime, and the checkpoint it was made of."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from vision import detector as detector_module
from vision.detector import model_path
from vision.runtimes.base import Device, Precision
from vision.runtimes.selection import RuntimeChoice
from vision.weights import DEFAULT_EXPORT, DEFAULT_WEIGHTS


@pytest.mark.parametrize(
    ("runtime", "precision", "device", "path"),
    [
        (None, "auto", "cpu", DEFAULT_EXPORT),
        (None, "float32", "cpu", DEFAULT_EXPORT),
        (None, "bfloat16", "cpu", DEFAULT_WEIGHTS),
        (None, "auto", "cuda", DEFAULT_WEIGHTS),
        ("onnxruntime", "auto", "cpu", DEFAULT_EXPORT),
        ("openvino", "bfloat16", "cpu", DEFAULT_EXPORT),
        ("torch", "auto", "cpu", DEFAULT_WEIGHTS),
        ("tensorrt", "auto", "cpu", DEFAULT_WEIGHTS),
        ("auto", "auto", "cpu", DEFAULT_WEIGHTS),
    ],
)
def test_file_of_the_bundled_model(
    runtime: RuntimeChoice | None, precision: Precision, device: Device, path: Path
) -> None:
    assert model_path("default", runtime, precision, device) == path


def test_auto_measures_the_export_without_torch(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(detector_module, "installed", lambda name: name != "torch")
    assert model_path("default", "auto") == DEFAULT_EXPORT


def test_bundled_model_detects_without_importing_torch() -> None:
    code = """
import sys
from vision import Detector, open_source
with open_source("docs/images/demo.png") as source:
    found = Detector(classes=["car"], image_size=320, threads=1).detect(next(iter(source)).image)
print(*found.names, "torch" in sys.modules)
"""
    root = Path(__file__).parents[2]
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["car", "False"]
