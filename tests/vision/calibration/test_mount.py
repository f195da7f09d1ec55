"""The camera's angles from a level marker."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vision.calibration.calibrate import CalibrationError
from vision.calibration.mount import mount_from_markers
from vision.camera_model import CameraModel, CameraMount
from vision.markers import Marker, marker_from_corners, square
from vision.rotation import matrix_from_euler

CAMERA = CameraModel(1280, 960, 1000.0, 1002.0, 641.0, 476.0, (-0.12, 0.03, 0.001, -0.0005))
SIZE_M = 0.4
small = st.floats(-0.09, 0.09)


def marker_of(
    mount: CameraMount, roll: float, pitch: float, heading: float, noise_px: float = 0.0, seed: int = 0
) -> Marker | None:
    """The marker on the ground at the middle of the image; the camera is 1 m above it."""
    body = matrix_from_euler(roll, pitch, 0.0)  # the nose points north
    ned_from_optical = body @ mount.body_from_optical
    middle = ned_from_optical[:, 2] / ned_from_optical[2, 2]
    corners = square(SIZE_M)[:, :2] @ np.array(
        [[-math.sin(heading), math.cos(heading)], [math.cos(heading), math.sin(heading)]]
    )
    ground = np.column_stack([corners + middle[:2], np.ones(4)])
    pixels = CAMERA.project(ground @ ned_from_optical)
    noise = np.random.default_rng(seed).normal(0.0, noise_px, (4, 2)) if noise_px else 0.0
    return marker_from_corners(7, pixels + noise, SIZE_M, CAMERA)


@settings(max_examples=50, deadline=None)
@given(
    angles=st.tuples(st.floats(-0.2, 0.2), st.floats(-1.1, -0.35), st.floats(-0.5, 0.5)),
    roll=small,
    pitch=small,
    heading=st.floats(-math.pi, math.pi),
)
def test_exact_corners_give_the_exact_angles(
    angles: tuple[float, float, float], roll: float, pitch: float, heading: float
) -> None:
    marker = marker_of(CameraMount(0.0, 0.0, 0.0, *angles), roll, pitch, heading)
    assert marker is not None
    found = mount_from_markers([marker], heading, roll, pitch)
    assert (found.roll_rad, found.pitch_rad, found.yaw_rad) == pytest.approx(angles, abs=2e-3)
    assert found.views == 1


def test_mean_of_many_views_is_within_a_third_of_a_degree() -> None:
    mount = CameraMount(roll_rad=0.03, pitch_rad=-0.6, yaw_rad=0.1)
    markers = [marker_of(mount, 0.02, -0.03, 0.2, 0.3, seed) for seed in range(20)]
    flipped = marker_of(CameraMount(roll_rad=0.3, pitch_rad=-0.4), 0.0, 0.0, 0.0)
    found = mount_from_markers([each for each in (*markers, flipped) if each], 0.2, 0.02, -0.03)
    error = np.degrees(np.abs(np.array([found.roll_rad, found.pitch_rad, found.yaw_rad]) - (0.03, -0.6, 0.1)))
    assert error.max() < 0.3
    assert found.views == 20
    assert 0.0 < math.degrees(found.spread_rad) < 1.0


def test_each_image_has_its_own_attitude() -> None:
    mount = CameraMount(roll_rad=0.03, pitch_rad=-0.6, yaw_rad=0.1)
    rolls, pitches = (-0.06, 0.0, 0.05), (0.04, -0.07, 0.01)
    markers = [marker_of(mount, roll, pitch, 0.2) for roll, pitch in zip(rolls, pitches, strict=True)]
    found = mount_from_markers([each for each in markers if each], 0.2, rolls, pitches)
    assert (found.roll_rad, found.pitch_rad, found.yaw_rad) == pytest.approx((0.03, -0.6, 0.1), abs=2e-3)
    assert found.views == 3


def test_upside_down_camera_is_refused() -> None:
    marker = marker_of(CameraMount(roll_rad=math.pi, pitch_rad=-0.6), 0.0, 0.0, 0.0)
    assert marker is not None
    with pytest.raises(CalibrationError, match="upside down"):
        mount_from_markers([marker])


def test_camera_that_looks_straight_down_is_not_upside_down() -> None:
    mount = CameraMount(pitch_rad=-math.radians(89.0))
    markers = [marker_of(mount, 0.0, -math.radians(tilt), 0.1) for tilt in (-3.0, 3.0)]
    for marker, tilt in zip(markers, (-3.0, 3.0), strict=True):
        assert marker is not None
        found = mount_from_markers([marker], 0.1, 0.0, -math.radians(tilt))
        rotation = matrix_from_euler(found.roll_rad, found.pitch_rad, found.yaw_rad)
        true = matrix_from_euler(0.0, mount.pitch_rad, 0.0)
        assert math.degrees(math.acos(min(1.0, (np.trace(rotation.T @ true) - 1) / 2))) < 0.2
