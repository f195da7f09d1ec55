"""A camera fixed to the body, and one stabilized by a gimbal."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vision.camera_model import CameraModel, CameraMount
from vision.geolocation import PixelRays
from vision.rotation import matrix_from_euler

CAMERA = CameraModel.from_horizontal_fov(640, 480, math.radians(80.0))
MIDDLE = np.array([[CAMERA.cx, CAMERA.cy]])
leans = st.floats(-1.2, 1.2)
headings = st.floats(-math.pi, math.pi)


@given(roll=leans, pitch=leans, yaw=headings, down=st.floats(0.1, 1.4), aside=st.floats(-1.0, 1.0))
def test_stabilized_camera_direction_ignores_body_tilt(
    roll: float, pitch: float, yaw: float, down: float, aside: float
) -> None:
    mount = CameraMount(pitch_rad=-down, yaw_rad=aside, stabilized=True)
    body = matrix_from_euler(roll, pitch, yaw)
    north, east, below = PixelRays.of(CAMERA, mount, body, MIDDLE).directions[0]
    assert math.asin(below) == pytest.approx(down, abs=1e-6)
    heading = math.atan2(body[1, 0], body[0, 0])
    assert math.remainder(math.atan2(east, north) - heading - aside, math.tau) == pytest.approx(0.0, abs=1e-6)
    # Its horizon is level.
    assert mount.ned_from_optical(body)[2, 0] == pytest.approx(0.0, abs=1e-9)


@given(yaw=headings, roll=leans, pitch=st.floats(-1.2, 0.0))
def test_both_mounts_are_equal_on_a_level_body(yaw: float, roll: float, pitch: float) -> None:
    body = matrix_from_euler(0.0, 0.0, yaw)
    fixed, held = (CameraMount(0.1, 0.0, 0.05, roll, pitch, 0.2, stabilized) for stabilized in (False, True))
    assert np.allclose(fixed.ned_from_optical(body), held.ned_from_optical(body))


@given(roll=leans, pitch=leans, yaw=headings, stabilized=st.booleans())
def test_ground_point_equals_point_at_its_depth(
    roll: float, pitch: float, yaw: float, stabilized: bool
) -> None:
    mount = CameraMount(0.2, -0.1, 0.05, pitch_rad=-0.9, stabilized=stabilized)
    body = matrix_from_euler(roll, pitch, yaw)
    pixels = np.array([[100.0, 80.0], [320.0, 240.0], [600.0, 470.0]])
    ground = PixelRays.of(CAMERA, mount, body, pixels).on_ground(10.0, 0.05)
    met = np.isfinite(ground[:, 0])
    eye = body @ mount.position_frd_m
    depth = (ground[met] - eye) @ mount.ned_from_optical(body)[:, 2]
    again = PixelRays.of(CAMERA, mount, body, pixels[met]).at_depth(depth)
    assert np.allclose(again, ground[met], atol=1e-6 * (1 + np.abs(ground[met])))
    assert np.allclose(ground[met][:, 2], 10.0)
