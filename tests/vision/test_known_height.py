"""Points and errors of them, from pixels and a pose."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from vision.attitude import quaternion_from_euler
from vision.camera_model import CameraModel, CameraMount
from vision.geolocation import ErrorEllipse, position_covariance, range_from_known_height
from vision.rotation import matrix_from_quaternion

CAMERA = CameraModel.from_horizontal_fov(640, 480, math.radians(80))
MOUNT = CameraMount(forward_m=0.1, down_m=0.05, pitch_rad=math.radians(-20))


@given(
    pitch=st.floats(-0.5, 0.5),
    yaw=st.floats(-math.pi, math.pi),
    distance_m=st.floats(2.0, 40.0),
    height_m=st.floats(3.0, 15.0),
    tall_m=st.floats(0.8, 4.0),
)
def test_foot_is_recovered_from_the_known_height(
    pitch: float, yaw: float, distance_m: float, height_m: float, tall_m: float
) -> None:
    assume(distance_m > 0.2 * (height_m + 5.0))  # from straight above the height is not visible
    ned_from_body = matrix_from_quaternion(quaternion_from_euler(0.0, pitch, yaw))  # upright in the image
    foot = np.array((distance_m * math.cos(yaw), distance_m * math.sin(yaw), height_m + 5.0))
    ends = [
        MOUNT.body_from_optical.T @ (ned_from_body.T @ point - MOUNT.position_frd_m)
        for point in (foot - (0.0, 0.0, tall_m), foot)
    ]
    assume(min(end[2] for end in ends) > 0.5)
    (x, top), (_, bottom) = np.array([CAMERA.project(end)[0] for end in ends]) + 0.5
    box = (x, top, x, bottom)  # thin: as deep as it is wide
    found = range_from_known_height(CAMERA, MOUNT, ned_from_body, box, tall_m, min_spread=0.0)
    assert found == pytest.approx(foot, abs=0.02 * distance_m)


def test_ellipse_lies_along_the_line_of_sight() -> None:
    for bearing_deg in (10.0, 80.0, 135.0, -120.0):
        ellipse = ErrorEllipse.of(position_covariance(math.radians(bearing_deg), 2.0, 0.5))
        assert ellipse.semi_major_m == pytest.approx(2.0)
        assert ellipse.semi_minor_m == pytest.approx(0.5)
        assert math.degrees(ellipse.orientation_rad) == pytest.approx(bearing_deg % 180.0)
