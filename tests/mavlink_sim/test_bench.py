"""The figures of `mavlink-sim bench` are plausible; their size depends on the machine."""

from __future__ import annotations

import math
from dataclasses import astuple

import cv2
import numpy as np
import pytest

from mavlink_sim.cli.bench import measure_camera, measure_fleet, measure_lockstep
from mavlink_sim.world.textures import mip_atlas
from vision.camera_model import CameraModel


def test_lockstep_bench_has_every_figure() -> None:
    figures = astuple(measure_lockstep(seconds=0.01))  # less than a step: it flies one all the same
    assert len(figures) == 4
    assert all(math.isfinite(figure) and figure > 0.0 for figure in figures)


def test_fleet_bench_reports_cpu_share() -> None:
    share = measure_fleet(vehicles=2, seconds=0.01)
    assert math.isfinite(share)
    assert share > 0.0


def test_camera_bench_restores_opencv_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    small = CameraModel.from_horizontal_fov(64, 48, math.radians(70.0))
    monkeypatch.setattr("mavlink_sim.camera.renderer.DEFAULT_CAMERA", small)
    # What the ground looks like does not matter here, and to paint it takes seconds.
    plain = mip_atlas(np.full((64, 64, 3), 110, np.uint8))
    monkeypatch.setattr("mavlink_sim.camera.ground_view.ground_atlas", lambda ground: plain)
    before = cv2.getNumThreads()
    cv2.setNumThreads(2)
    try:
        figures = measure_camera(frames=1)
        assert cv2.getNumThreads() == 2
    finally:
        cv2.setNumThreads(before)
    assert all(math.isfinite(figure) and figure > 0.0 for figure in astuple(figures))
