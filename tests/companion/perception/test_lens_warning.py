"""A lens that folds its image is an event of the service and a line of `config --check`."""

from __future__ import annotations

import os

import pytest

from companion.cli.config_check import check_settings
from companion.perception.cameras import WorkerCamera
from companion.settings.reading import load_settings
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


@pytest.mark.parametrize(("k2", "lines"), [("-0.4", 1), ("0.0", 0)])
def test_settings_of_a_lens_are_checked(k2: str, lines: int, tmp_path: os.PathLike[str]) -> None:
    lens = {"fx_px": "300", "fy_px": "300", "cx_px": "320", "cy_px": "240", "calibrated_width": "640"}
    lens |= {"calibrated_height": "480", "distortion_model": "equidistant", "distortion": f"0.1,{k2},0,0"}
    overrides = {f"camera.{key}": value for key, value in lens.items()}
    overrides |= {"source.uri": str(tmp_path), "detector.enabled": "false"}
    found = check_settings(load_settings(os.devnull, overrides, environment={}))
    assert len([line for line in found if line.startswith("camera: ")]) == lines
