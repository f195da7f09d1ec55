"""The bound of the geolocation benchmark: true points located by an estimated pose and a believed mount."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.geolocation import MOUNT, _located_by_pose, _Shown
from companion.guidance.objects.from_detections import Pose
from companion.guidance.objects.range_error import PoseError
from mavlink_sim.camera.renderer import Rendered
from vision.rotation import matrix_from_euler

HEIGHT_M, POINT = 5.0, (21.0, 2.0, 0.0)
NOTHING = Rendered(np.zeros((1, 1, 3), np.uint8), np.zeros((1, 1), np.float32), [], np.zeros(3))


def shown(attitude: np.ndarray) -> _Shown:
    return _Shown((1.0, 2.0, -HEIGHT_M), attitude, np.zeros(2), NOTHING)


def pose(attitude: np.ndarray) -> Pose:
    return Pose(attitude, (1.0, 2.0, -HEIGHT_M), HEIGHT_M, PoseError())


@pytest.mark.parametrize("depth", [False, True])
def test_point_is_exact_with_the_true_pose_and_mount(depth: bool) -> None:
    attitude = np.array(matrix_from_euler(0.05, -0.1, 0.2))
    located = _located_by_pose(POINT, shown(attitude), pose(attitude), MOUNT, depth=depth)
    assert located == pytest.approx(POINT[:2])


def test_pitch_of_the_mount_changes_the_range_by_the_ground() -> None:
    error_rad, level = math.radians(0.3), np.eye(3)
    believed = replace(MOUNT, pitch_rad=MOUNT.pitch_rad + error_rad)
    ground, depth = (
        _located_by_pose(POINT, shown(level), pose(level), believed, depth=by_depth)
        for by_depth in (False, True)
    )
    # range = height / tan(depression)
    assert ground[0] - POINT[0] == pytest.approx((20.0**2 + HEIGHT_M**2) / HEIGHT_M * error_rad, rel=0.1)
    assert abs(depth[0] - POINT[0]) < 0.05
