"""Levelled images: rotations, the lens, and rolling shutters."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from vision.camera_model import CameraModel, CameraMount
from vision.levelling import level_camera, level_image, level_rotations, poses_of_readout
from vision.rotation import matrix_from_euler

PINHOLE = CameraModel.from_horizontal_fov(320, 240, math.radians(80.0))
BARREL = replace(PINHOLE, distortion=(-0.2, 0.05, 0.001, -0.002))
FISHEYE = CameraModel(320, 240, 140.0, 140.0, 160.0, 120.0, (0.05, 0.01, 0.0, 0.0), "equidistant")
AHEAD = CameraMount()
BAND_PX = 30
MAX_LEAN_RAD = math.radians(25.0)
angles = st.floats(-MAX_LEAN_RAD, MAX_LEAN_RAD)


def world_seen(camera: CameraModel, ned_from_rows: NDArray[np.float64]) -> NDArray[np.uint8]:
    """An image of a far world: a bright sky above dark ground.

    Args:
        ned_from_rows: (height, 3, 3) `ned_from_optical` of each row.
    """
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = camera.rays(np.column_stack([columns.ravel(), rows.ravel()]))
    north, east, down = np.einsum("nij,nj->in", ned_from_rows[rows.ravel()], rays)
    below_deg = np.degrees(np.arctan2(down, np.hypot(north, east)))
    # Smooth edges, so that interpolation does not matter.
    brightness = 40.0 + 180.0 / (1.0 + np.exp(below_deg * 4.0))
    return np.asarray(brightness.reshape(camera.height, camera.width).round(), np.uint8)


def horizon_deg(image: NDArray[np.uint8], camera: CameraModel) -> NDArray[np.float64]:
    """Elevation of the edge of the sky below the axis, in each column that is seen near it."""
    band = image[round(camera.cy) - BAND_PX : round(camera.cy) + BAND_PX]
    shown = np.flatnonzero((band > 35).all(axis=0))[2:-2]  # at its ends mixed with black
    edges = round(camera.cy) - BAND_PX + (band[:, shown] < 130).argmax(axis=0)
    rays = camera.rays(np.column_stack([shown, edges]))
    elevations: NDArray[np.float64] = np.degrees(np.arctan2(rays[:, 1], np.hypot(rays[:, 0], rays[:, 2])))
    return elevations


@pytest.mark.parametrize("camera", [PINHOLE, BARREL, FISHEYE], ids=["pinhole", "barrel", "fisheye"])
@pytest.mark.parametrize("roll_deg", [-20.0, 12.0])
def test_horizon_is_horizontal_after_levelling(camera: CameraModel, roll_deg: float) -> None:
    ned_from_body = matrix_from_euler(math.radians(roll_deg), 0.0, 1.0)
    tilted = np.tile(AHEAD.ned_from_optical(ned_from_body), (camera.height, 1, 1))
    image = level_image(world_seen(camera, tilted), camera, level_rotations([(AHEAD, ned_from_body)]))
    elevations = horizon_deg(image, level_camera(camera))
    assert len(elevations) > 100
    assert np.abs(elevations).max() < 0.5


def test_rolling_shutter_rows_are_levelled_by_their_attitudes() -> None:
    readout_s, rate_radps = 0.04, math.radians(150.0)

    def body_at(time_s: float) -> NDArray[np.float64]:
        return matrix_from_euler(0.2 + rate_radps * time_s, 0.0, 0.5)

    times = readout_s * (np.arange(PINHOLE.height) / (PINHOLE.height - 1) - 0.5)
    rows = np.array([AHEAD.ned_from_optical(body_at(float(time_s))) for time_s in times])
    image = world_seen(PINHOLE, rows)
    poses = poses_of_readout(lambda stamp_ns: (AHEAD, body_at(stamp_ns / 1e9)), 0, readout_s)
    assert poses is not None
    bent = horizon_deg(level_image(image, PINHOLE, level_rotations(poses[4:5])), PINHOLE)
    straight = horizon_deg(level_image(image, PINHOLE, level_rotations(poses)), PINHOLE)
    assert np.abs(straight).max() < 0.4
    assert np.ptp(bent) > 3 * np.ptp(straight)


@pytest.mark.parametrize("rotate_deg", [90, 180, 270])
def test_rows_of_a_rotated_image_are_those_of_the_sensor(rotate_deg: int) -> None:
    """Levelling the rotated image is rotating the levelled one."""
    rng = np.random.default_rng(5)
    small = rng.integers(40, 255, (12, 16)).astype(np.uint8)
    image = np.asarray(cv2.resize(small, (320, 240), interpolation=cv2.INTER_CUBIC), np.uint8)
    rates = [matrix_from_euler(0.0, 0.0, 0.002 * (index - 4)) for index in range(9)]
    straight = level_image(image, PINHOLE, np.array(rates))
    turns = rotate_deg // 90
    back = matrix_from_euler(0.0, 0.0, turns * math.pi / 2)
    turned = np.ascontiguousarray(np.rot90(image, -turns))
    height, width = turned.shape
    right, bottom = PINHOLE.width - 1 - PINHOLE.cx, PINHOLE.height - 1 - PINHOLE.cy
    cx, cy = {90: (bottom, PINHOLE.cx), 180: (right, bottom), 270: (PINHOLE.cy, right)}[rotate_deg]
    lens = CameraModel(width, height, PINHOLE.fx, PINHOLE.fy, cx, cy)
    levelled = level_image(turned, lens, np.array([back @ rate @ back.T for rate in rates]), rotate_deg)
    difference = cv2.absdiff(np.rot90(levelled, turns), straight)[20:-20, 20:-20]
    assert difference.max() <= 3
    without = level_image(turned, lens, np.array([back @ rate @ back.T for rate in rates]))
    assert cv2.absdiff(np.rot90(without, turns), straight)[20:-20, 20:-20].max() > 3


@given(roll=angles, pitch=angles, heading=st.floats(-3.1, 3.1), mount_pitch=st.floats(-0.9, 0.5))
def test_axis_is_kept_and_the_image_is_level(
    roll: float, pitch: float, heading: float, mount_pitch: float
) -> None:
    mount = CameraMount(pitch_rad=mount_pitch, yaw_rad=0.3)
    ned_from_body = matrix_from_euler(roll, pitch, heading)
    (level_from_optical,) = level_rotations([(mount, ned_from_body)])
    np.testing.assert_allclose(level_from_optical @ level_from_optical.T, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(level_from_optical[:, 2], (0.0, 0.0, 1.0), atol=1e-9)
    ned_from_level = mount.ned_from_optical(ned_from_body) @ level_from_optical.T
    assert abs(ned_from_level[2, 0]) < 1e-9, "its rows are horizontal"
    assert ned_from_level[2, 1] > 0.0, "and not upside down"


@given(roll=angles, pitch=angles, heading=st.floats(-3.1, 3.1))
def test_camera_that_looks_down_is_that_of_a_level_vehicle(roll: float, pitch: float, heading: float) -> None:
    mount = CameraMount(pitch_rad=-math.pi / 2)
    ned_from_body = matrix_from_euler(roll, pitch, heading)
    (level_from_optical,) = level_rotations([(mount, ned_from_body)])
    ned_from_level = mount.ned_from_optical(ned_from_body) @ level_from_optical.T
    level = mount.ned_from_optical(matrix_from_euler(0.0, 0.0, heading))
    np.testing.assert_allclose(ned_from_level, level, atol=1e-9)


def test_gimbal_that_looks_down_is_not_turned() -> None:
    mount = CameraMount(on_gimbal=True).held(matrix_from_euler(0.1, math.radians(-80.0), 0.4))
    (rotation,) = level_rotations([(mount, matrix_from_euler(0.3, 0.0, 0.0))])
    np.testing.assert_allclose(rotation, np.eye(3), atol=1e-12)
    ahead = CameraMount(on_gimbal=True).held(matrix_from_euler(0.1, math.radians(-20.0), 0.4))
    (rotation,) = level_rotations([(ahead, matrix_from_euler(0.3, 0.0, 0.0))])
    assert math.atan2(rotation[1, 0], rotation[0, 0]) == pytest.approx(0.1)


def test_level_image_is_unchanged() -> None:
    image = np.random.default_rng(1).integers(1, 255, (240, 320, 3)).astype(np.uint8)
    rotations = level_rotations([(AHEAD, matrix_from_euler(0.0, 0.0, 2.0))])
    assert np.array_equal(level_image(image, PINHOLE, rotations), image)


def test_unknown_attitude_of_a_row_gives_no_poses() -> None:
    known = (AHEAD, np.eye(3))
    assert poses_of_readout(lambda stamp_ns: known if stamp_ns < 10**9 else None, 10**9, 0.02) is None
    assert poses_of_readout(lambda stamp_ns: known, 10**9, 0.0) == [known]
