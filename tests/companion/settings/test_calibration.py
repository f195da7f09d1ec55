"""The `camera` settings with a calibration from the camera."""

from __future__ import annotations

import math
import os
from dataclasses import replace
from pathlib import Path

import pytest

from companion.settings.calibration import adopt_calibration
from companion.settings.perception import CameraSection
from companion.settings.reading import ConfigurationError, load_settings, to_toml
from vision.calibration_files.camera_info import write_camera_info
from vision.camera_model import CameraCalibration, CameraModel, CameraMount
from vision.orientation import Orientation

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


def test_gimbal_mount_that_is_stabilized_is_refused() -> None:
    with pytest.raises(ValueError, match="on_gimbal") as refused:
        adopt_calibration(section_of(), CameraCalibration(LENS, CameraMount(stabilized=True, on_gimbal=True)))
    assert "\n" not in str(refused.value)


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
    assert "True (camera: False)" in conflict
    assert camera.on_gimbal
    assert camera.mount_pitch_deg == 0.0
    agreed, conflict = adopt_calibration(section_of(on_gimbal="true"), GIMBAL)
    assert conflict == ""
    assert agreed.mount_forward_m == 0.12


def test_given_calibration_wins_and_its_distortion_conflicts(tmp_path: Path) -> None:
    own = CameraModel(640, 480, 450.0, 450.0, 320.0, 239.0, (-0.2, 0.02, 0.0, 0.0))
    write_camera_info(file := tmp_path / "camera.yaml", own, "camera")
    lens = replace(own, distortion=(-0.1, 0.02, 0.0, 0.0))
    camera, conflict = adopt_calibration(
        section_of(calibration_file=str(file)), CameraCalibration(lens, MOUNT)
    )
    assert camera.model(640, 480).distortion == pytest.approx((-0.2, 0.02, 0.0, 0.0, 0.0))
    assert conflict.startswith("distortion ")
    assert "-0.2" in conflict
    assert "-0.1" in conflict


RATIONAL = CameraModel(
    640,
    480,
    *(330.0, 331.0, 318.0, 242.0),
    (0.6, 0.08, 4e-4, -3e-4, 0.002, 0.92, 0.22, 0.012),
    "rational_polynomial",
)
FISHEYE = CameraModel(640, 480, 195.0, 196.0, 321.0, 238.0, (-0.02, 0.004, -0.002, 3e-4), "equidistant")


@pytest.mark.parametrize("lens", [RATIONAL, FISHEYE], ids=["rational", "fisheye"])
def test_every_distortion_model_comes_with_the_camera(lens: CameraModel) -> None:
    camera, conflict = adopt_calibration(section_of(), CameraCalibration(lens))
    assert conflict == ""
    assert camera.model(640, 480) == lens
    assert camera.field_rad == lens.horizontal_fov_rad


def test_other_distortion_model_is_a_conflict() -> None:
    given = section_of(horizontal_fov_deg="90")
    camera, conflict = adopt_calibration(given, CameraCalibration(FISHEYE))
    assert camera.model(640, 480).distortion_model == "plumb_bob"
    assert "equidistant" in conflict


@pytest.mark.parametrize("lens", [LENS, RATIONAL, FISHEYE], ids=["plain", "rational", "fisheye"])
def test_calibration_file_gives_the_lens(tmp_path: Path, lens: CameraModel) -> None:
    write_camera_info(file := tmp_path / "camera.yaml", lens, "front")
    camera = section_of(calibration_file=str(file), mount_pitch_deg="-20")
    read = camera.model(640, 480)
    assert read.distortion_model == lens.distortion_model
    assert (read.fx, read.fy, read.cx, read.cy) == pytest.approx((lens.fx, lens.fy, lens.cx, lens.cy))
    assert read.coefficients == pytest.approx(lens.coefficients)
    assert camera.model(1280, 960).fx == pytest.approx(2 * lens.fx)
    assert camera.mount_pitch_deg == -20.0


def test_printed_settings_name_the_calibration_file(tmp_path: Path) -> None:
    write_camera_info(file := tmp_path / "camera.yaml", FISHEYE, "front")
    settings = load_settings(os.devnull, {"camera.calibration_file": str(file)}, environment={})
    # A field of view beside it is an error, so the one that is not given is a comment.
    (effective := tmp_path / "effective.toml").write_text(to_toml(settings))
    assert load_settings(effective, {}, environment={}).camera == settings.camera


@pytest.mark.parametrize(
    ("source", "facts"),
    [
        ({}, ("rotate_deg 180", "source.rotate_deg", " 0")),
        ({"rotate_deg": "180"}, ("mirror true", "source.mirror", " false")),
        ({"rotate_deg": "180", "mirror": "true", "name": "rear"}, ("'front'", "'rear'", "another camera")),
    ],
)
@pytest.mark.parametrize("prefix", ["", "cameras.second."])
def test_calibration_of_other_images_is_refused(
    tmp_path: Path, prefix: str, source: dict[str, str], facts: tuple[str, ...]
) -> None:
    write_camera_info(file := tmp_path / "camera.yaml", LENS, "front", (), Orientation(180, True))
    values = {f"{prefix}source.{key}": value for key, value in source.items()}
    values[f"{prefix}camera.calibration_file"] = str(file)
    if prefix:
        values[f"{prefix}source.uri"] = "photos"
    with pytest.raises(ConfigurationError) as caught:
        load_settings(os.devnull, values, environment={})
    (problem,) = caught.value.problems
    assert all(fact in problem for fact in (str(file), *facts))


def test_calibration_of_the_same_images_is_used(tmp_path: Path) -> None:
    write_camera_info(file := tmp_path / "camera.yaml", LENS, "front", (), Orientation(180, True))
    values = {"source.rotate_deg": "180", "source.mirror": "true", "source.name": "front"}
    values["camera.calibration_file"] = str(file)
    assert load_settings(os.devnull, values, environment={}).camera.model(640, 480).fx == pytest.approx(
        LENS.fx
    )
    # A file of ROS does not say how its images were turned.
    write_camera_info(file, LENS, "camera")
    assert load_settings(os.devnull, values, environment={}).camera.model(640, 480).fx == pytest.approx(
        LENS.fx
    )
