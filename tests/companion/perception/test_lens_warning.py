"""A lens that folds its image is an event of the service and a line of `config --check`."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import pytest

from companion.cli.config_check import check_settings
from companion.perception.cameras import WorkerCamera
from companion.settings.reading import load_settings
from vision.calibration_files.camera_info import write_camera_info
from vision.camera_model import CameraCalibration, CameraModel

FOLDED = CameraModel(640, 480, 300.0, 300.0, 320.0, 240.0, (0.1, -0.4, 0.0, 0.0), "equidistant")
WHOLE = CameraModel(640, 480, 500.0, 500.0, 320.0, 240.0)


@pytest.mark.parametrize(("lens", "warnings"), [(FOLDED, 1), (WHOLE, 0)], ids=["folded", "whole"])
def test_camera_that_brings_its_lens_warns(lens: CameraModel, warnings: int) -> None:
    events: list[tuple[str, str]] = []
    camera = WorkerCamera(
        load_settings(os.devnull, {}, environment={}),
        "front",
        on_result=lambda *_: None,
        on_preview=lambda *_: None,
        on_event=lambda level, text: events.append((level, text)),
        on_calibration=lambda: None,
    )
    camera._adopt(CameraCalibration(lens))
    found = [text for level, text in events if level == "warning"]
    assert len(found) == warnings
    assert all("camera front" in text and "equidistant" in text for text in found)


@pytest.mark.parametrize(("k2", "lines"), [(-0.4, 1), (0.0, 0)])
def test_settings_of_a_lens_are_checked(k2: float, lines: int, tmp_path: Path) -> None:
    file = tmp_path / "camera.yaml"
    write_camera_info(file, replace(FOLDED, distortion=(0.1, k2, 0.0, 0.0)), "camera")
    overrides = {"camera.calibration_file": str(file)}
    overrides |= {"source.uri": str(tmp_path), "detector.enabled": "false"}
    found = check_settings(load_settings(os.devnull, overrides, environment={}))
    assert len([line for line in found if line.startswith("camera: ")]) == lines
