"""The `camera` settings with a calibration from the camera."""

from __future__ import annotations

import math
import os

import pytest

from companion.settings.calibration import adopt_calibration
from companion.settings.perception import CameraSection
from companion.settings.reading import load_settings
from vision.camera_model import CameraCalibration, CameraModel, CameraMount

LENS = CameraModel.from_horizontal_fov(640, 480, math.radians(70.0))
MOUNT = CameraMount(0.12, 0.0, 0.05, 0.0, math.radians(-20.0), 0.0)
CAMERA = CameraCalibration(LENS, MOUNT)
GIMBAL = CameraCalibration(LENS, CameraMount(forward_m=0.12, on_gimbal=True))


def section_of(**values: str) -> CameraSection:
    overrides = {f"camera.{key}": value for key, value in values.items()}
    return load_settings(os.devnull, overrides, environment={}).camera


def test_lens_and_mount_come_from_the_camera() -> None:
    camera, conflict = adopt_calibration(section_of(), CAMERA)
    assert conflict == ""
    assert camera.model(640, 480) == LENS
    assert camera.field_rad == pytest.approx(math.radians(70.0))
    mount = camera.mount()
    assert mount.pitch_rad == pytest.approx(MOUNT.pitch_rad)
    assert (mount.position_frd_m == MOUNT.position_frd_m).all()


def test_distortion_and_gimbal_come_with_the_camera() -> None:
    lens = CameraModel(640, 480, 450.0, 451.0, 320.0, 239.0, (-0.1, 0.02, 0.0, 0.0))
    camera, _ = adopt_calibration(section_of(), CameraCalibration(lens, GIMBAL.mount))
    assert camera.model(640, 480) == lens
    assert camera.on_gimbal
    assert camera.mount().on_gimbal


def test_given_values_win_and_conflict_names_both() -> None:
    given = section_of(horizontal_fov_deg="80", mount_pitch_deg="0")
    camera, conflict = adopt_calibration(given, CAMERA)
    assert camera.model(640, 480) == given.model(640, 480)
    assert camera.mount_pitch_deg == 0.0
    assert camera.mount_forward_m == 0.12  # not given
    for value in ("80.0°", "70.0°", "mount_pitch_deg 0 (camera: -20)"):
        assert value in conflict
    assert "forward" not in conflict


def test_agreeing_values_are_no_conflict() -> None:
    given = section_of(horizontal_fov_deg="70", mount_pitch_deg="-20", mount_forward_m="0.12")
    assert adopt_calibration(given, CAMERA).conflict == ""


def test_lens_alone_keeps_the_mount_of_the_settings() -> None:
    given = section_of(mount_pitch_deg="-35")
    camera, conflict = adopt_calibration(given, CameraCalibration(LENS))
    assert conflict == ""
    assert camera.mount() == given.mount()
    assert camera.model(640, 480) == LENS


def test_angles_are_not_mixed_between_body_and_gimbal() -> None:
    camera, conflict = adopt_calibration(section_of(on_gimbal="true"), CAMERA)
    assert "gimbal True (camera: False)" in conflict
    assert camera.on_gimbal
    assert camera.mount_pitch_deg == 0.0
    agreed, conflict = adopt_calibration(section_of(on_gimbal="true"), GIMBAL)
    assert conflict == ""
    assert agreed.mount_forward_m == 0.12


def test_given_distortion_wins_alone() -> None:
    lens = CameraModel(640, 480, 450.0, 450.0, 320.0, 239.0, (-0.1, 0.02, 0.0, 0.0))
    camera, conflict = adopt_calibration(
        section_of(distortion="-0.2, 0.02, 0, 0"), CameraCalibration(lens, MOUNT)
    )
    assert camera.fx_px == 450.0
    assert camera.distortion == (-0.2, 0.02, 0.0, 0.0)
    assert "-0.2" in conflict
    assert "-0.1" in conflict
