"""Boxes under camera rotation, compared with points projected one by one; and interpolated attitudes."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vision.attitude import quaternion_from_euler
from vision.camera_model import CameraModel
from vision.rotation import matrix_from_euler, matrix_from_quaternion
from vision.tracking.camera_motion import HISTORY_S, MAX_AHEAD_S, AttitudeHistory, CameraView, rotate_boxes
from vision.tracking.kalman import initiate

CAMERA = CameraModel.from_horizontal_fov(640, 480, math.radians(75))
DISTORTED = replace(CAMERA, distortion=(-0.12, 0.03, 0.001, -0.001, 0.0))
MS = 1_000_000

turns = st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(-0.3, 0.3))
pixels = st.tuples(st.floats(120, 520), st.floats(120, 360))


def at(x: float, y: float, width: float = 20.0, height: float = 40.0) -> np.ndarray:
    return np.array([[x - width / 2, y - height / 2, x + width / 2, y + height / 2]])


@pytest.mark.parametrize("camera", [CAMERA, DISTORTED], ids=["pinhole", "distorted"])
@given(turn=turns, pixel=pixels)
def test_centre_moves_like_a_distant_point(
    camera: CameraModel, turn: tuple[float, float, float], pixel: tuple[float, float]
) -> None:
    rotation = matrix_from_euler(*turn)
    moved, visible = rotate_boxes(initiate(at(*pixel)), camera, rotation)
    assert visible.all()
    point = camera.rays(np.array([pixel])) @ rotation.T * 1000.0
    np.testing.assert_allclose(moved.mean[0, :2], camera.project(point)[0], atol=1e-6)


def test_the_pinhole_homography_is_k_r_k_inverse() -> None:
    rotation = matrix_from_euler(0.1, -0.2, 0.15)
    moved, _ = rotate_boxes(initiate(at(400, 100)), CAMERA, rotation)
    homogeneous = CAMERA.matrix @ rotation @ np.linalg.inv(CAMERA.matrix) @ [400, 100, 1]
    np.testing.assert_allclose(moved.mean[0, :2], homogeneous[:2] / homogeneous[2], atol=1e-9)


@given(turn=turns, pixel=pixels)
def test_rotation_and_back_restores_the_state(
    turn: tuple[float, float, float], pixel: tuple[float, float]
) -> None:
    states = initiate(at(*pixel))
    states.mean[0, 4:6] = (12.0, -7.0)
    rotation = matrix_from_euler(*turn)
    back, _ = rotate_boxes(rotate_boxes(states, CAMERA, rotation)[0], CAMERA, rotation.T)
    np.testing.assert_allclose(back.mean[0, :2], states.mean[0, :2], atol=1e-6)
    np.testing.assert_allclose(back.mean[0, 4:6], states.mean[0, 4:6], rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(back.mean[0, 2:4], states.mean[0, 2:4], rtol=0.15)
    np.testing.assert_allclose(back.covariance[0, :2, :2], states.covariance[0, :2, :2], rtol=1e-3, atol=1e-3)


def test_roll_rotates_velocity_and_keeps_sides() -> None:
    states = initiate(at(CAMERA.cx, CAMERA.cy))
    states.mean[0, 4:6] = (10.0, 0.0)
    # About the optical axis, a quarter turn: motion to the right becomes motion down.
    moved, _ = rotate_boxes(states, CAMERA, matrix_from_euler(0.0, 0.0, math.pi / 2))
    np.testing.assert_allclose(moved.mean[0], [CAMERA.cx, CAMERA.cy, 20, 40, 0, 10, 0, 0], atol=1e-6)


def test_boxes_grow_towards_the_image_edge() -> None:
    yaw = matrix_from_euler(0.0, math.radians(30), 0.0)  # about the optical frame's y axis
    moved, _ = rotate_boxes(initiate(at(CAMERA.cx, CAMERA.cy, 2, 2)), CAMERA, yaw)
    # Off the axis by 30° a small object is stretched by 1/cos² away from the centre and by 1/cos across.
    np.testing.assert_allclose(
        moved.mean[0, 2:4], [2 / math.cos(yaw_rad := math.radians(30)) ** 2, 2 / math.cos(yaw_rad)], rtol=1e-3
    )


def test_box_out_of_view_is_reported_and_unchanged() -> None:
    states = initiate(np.concatenate([at(320, 240), at(600, 240)]))
    moved, visible = rotate_boxes(states, CAMERA, matrix_from_euler(0.0, math.radians(60), 0.0))
    assert visible.tolist() == [True, False]
    np.testing.assert_allclose(moved.mean[1, :4], states.mean[1, :4])
    assert np.isfinite(moved.mean).all()


def test_no_boxes_stay_no_boxes_after_rotation() -> None:
    moved, visible = rotate_boxes(initiate(np.zeros((0, 4))), CAMERA, np.eye(3))
    assert len(moved) == len(visible) == 0


def test_turn_from_maps_old_directions_to_the_new_frame() -> None:
    before = CameraView(CAMERA, matrix_from_euler(0.1, 0.2, 0.3))
    after = CameraView(CAMERA, matrix_from_euler(-0.1, 0.1, 0.8))
    ned = np.array([0.3, -0.2, 0.9])
    np.testing.assert_allclose(
        after.turn_from(before) @ (before.ned_from_optical.T @ ned), after.ned_from_optical.T @ ned
    )


def turning(*stamps_ms: int, rate: float = 1.0) -> AttitudeHistory:
    """A vehicle that yaws steadily by `rate` radians a second."""
    history = AttitudeHistory()
    for stamp in stamps_ms:
        history.add(stamp * MS, quaternion_from_euler(0.0, 0.0, rate * stamp / 1000))
    return history


@given(st.integers(0, 100))
def test_attitude_is_interpolated_between_samples(stamp_ms: int) -> None:
    attitude = turning(0, 20, 70, 100).at(stamp_ms * MS)
    assert attitude is not None
    np.testing.assert_allclose(attitude, matrix_from_euler(0, 0, stamp_ms / 1000), atol=1e-6)


def test_attitude_is_extrapolated_shortly() -> None:
    history = turning(*range(0, 201, 20), rate=0.8)
    attitude = history.at(260 * MS)
    assert attitude is not None
    np.testing.assert_allclose(attitude, matrix_from_euler(0, 0, 0.8 * 0.26), atol=1e-4)


def test_extrapolation_does_not_amplify_noise() -> None:
    history = turning(*range(0, 201, 2), rate=0.0)
    history.add(202 * MS, quaternion_from_euler(0.0, 0.0, 0.002))
    attitude = history.at(302 * MS)
    assert attitude is not None
    assert abs(math.atan2(attitude[1, 0], attitude[0, 0])) < 0.0065


@pytest.mark.parametrize(
    ("stamps_ms", "asked_ms"),
    [
        ((), 50),
        ((100, 120, 200), 99),  # before all
        ((100, 120, 200), 200 + int(MAX_AHEAD_S * 1000) + 1),  # long after all
        ((100,), 110),  # a single sample has no rate
        ((100, 1000), 500),  # the gap is too long
    ],
)
def test_unknown_attitude_is_none(stamps_ms: tuple[int, ...], asked_ms: int) -> None:
    assert turning(*stamps_ms).at(asked_ms * MS) is None


def test_sample_at_the_exact_stamp_is_returned() -> None:
    attitude = turning(100).at(100 * MS)
    assert attitude is not None
    np.testing.assert_allclose(attitude, matrix_from_quaternion(quaternion_from_euler(0, 0, 0.1)))


def test_late_samples_are_ignored_and_old_ones_dropped() -> None:
    history = turning(0, 100, 200)
    history.add(100 * MS, quaternion_from_euler(1.0, 0, 0))
    history.add(200 * MS, quaternion_from_euler(1.0, 0, 0))
    attitude = history.at(150 * MS)
    assert attitude is not None
    np.testing.assert_allclose(attitude, matrix_from_euler(0, 0, 0.15), atol=1e-6)
    history.add(round((HISTORY_S + 0.15) * 1e9), quaternion_from_euler(0, 0, 0.2))
    assert history.at(120 * MS) is None


@pytest.mark.parametrize(
    "camera",
    [
        replace(CAMERA, distortion=(-0.4, 0.0, 0.0, 0.0)),
        CameraModel(640, 480, 300.0, 300.0, 320.0, 240.0, (0.1, -0.4, 0.0, 0.0), "equidistant"),
    ],
    ids=["plumb_bob", "equidistant"],
)
def test_state_stays_finite_where_a_lens_folds(camera: CameraModel) -> None:
    boxes = np.concatenate([at(x, y) for x in range(10, 640, 30) for y in range(10, 480, 30)])
    for turn in np.linspace(-0.6, 0.6, 7):
        moved, visible = rotate_boxes(initiate(boxes), camera, matrix_from_euler(0.0, turn, 0.0))
        assert np.isfinite(moved.mean).all()
        assert np.isfinite(moved.covariance).all()
        assert visible.any()
        assert not visible.all()
