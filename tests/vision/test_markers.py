"""Markers: detection in images, and pose."""

from __future__ import annotations

import math
import pickle
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from mavlink_sim.camera.renderer import Renderer
from mavlink_sim.world.fiducials import Print
from mavlink_sim.world.world import Ground, World, WorldObject
from vision.camera_model import CameraModel, CameraMount
from vision.markers import MarkerDetector, MarkerKind, marker_from_corners, marker_poses, square
from vision.rotation import matrix_from_euler

PLAIN = CameraModel.from_horizontal_fov(640, 480, math.radians(70.0))
BENT = CameraModel(640, 480, 455.0, 460.0, 321.0, 236.0, (-0.12, 0.03, 0.001, -0.0005))
DOWN = matrix_from_euler(0.0, -math.pi / 2, 0.0)
GROUND = Ground(("concrete",), 0, 256, 0.05)
# A marker seen straight on: its x to the right, its y up, its z towards the camera.
FACING = np.diag([1.0, -1.0, -1.0])


def make_image(
    height_m: float, north_m: float, yaw: float, camera: CameraModel = PLAIN, **printed: Any
) -> NDArray[np.uint8]:
    """A marker on the ground seen from above, its centre `north_m` north of straight down."""
    print_ = Print(
        printed.get("dictionary", "4X4_50"), printed.get("identifier", 7), printed.get("size", 0.5)
    )
    plate = WorldObject(0, "plate", (north_m, 0.0, 0.0), yaw, printed=print_)
    renderer = Renderer(World((plate,), GROUND), camera, CameraMount())
    return renderer.render((0.0, 0.0, -height_m), DOWN).image


@settings(max_examples=100, deadline=None)
@given(
    camera=st.sampled_from([PLAIN, BENT]),
    tilt=st.floats(-0.9, 0.9),
    lean=st.floats(-0.9, 0.9),
    turn=st.floats(-math.pi, math.pi),
    right=st.floats(-0.3, 0.3),
    down=st.floats(-0.3, 0.3),
    forward=st.floats(0.6, 15.0),
    size=st.floats(0.05, 1.0),
)
def test_exact_corners_give_the_exact_pose_for_any_lens(
    camera: CameraModel,
    tilt: float,
    lean: float,
    turn: float,
    right: float,
    down: float,
    forward: float,
    size: float,
) -> None:
    forward = max(forward, 3.0 * size)
    position = np.array([right * forward, down * forward, forward])
    rotation = matrix_from_euler(tilt, lean, turn) @ FACING
    if rotation[:, 2] @ position > -0.2 * forward:
        return  # its back, or edge on
    corners = camera.project(square(size) @ rotation.T + position)
    marker = marker_from_corners(3, corners, size, camera)
    assert marker is not None
    assert np.linalg.norm(marker.position_camera_m - position) < 0.01 * forward
    # The true rotation is one of the two that fit.
    poses = marker_poses(corners, size, camera)
    angles = [math.acos(min(1.0, (np.trace(pose.rotation.T @ rotation) - 1) / 2)) for pose in poses]
    assert min(angles) < 0.05
    assert poses[0].reprojection_px < 0.05


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**31), forward=st.floats(1.0, 6.0), noise_px=st.floats(0.0, 0.4))
def test_corner_noise_moves_the_position_little(seed: int, forward: float, noise_px: float) -> None:
    rng = np.random.default_rng(seed)
    position = np.array([0.1, -0.1, forward])
    corners = PLAIN.project(square(0.5) @ FACING.T + position) + rng.normal(0.0, noise_px, (4, 2))
    marker = marker_from_corners(0, corners, 0.5, PLAIN)
    assert marker is not None
    assert marker.reprojection_px <= 3 * noise_px + 0.05
    side_px = 0.5 / forward * PLAIN.fx
    assert np.linalg.norm(marker.position_camera_m - position) < forward * (0.002 + 6 * noise_px / side_px)


def test_both_poses_are_kept_from_far_away() -> None:
    rotation = matrix_from_euler(0.25, 0.0, 0.4) @ FACING
    corners = PLAIN.project(square(0.3) @ rotation.T + np.array([0.0, 0.0, 8.0]))
    marker = marker_from_corners(0, corners + np.array([[0.1, 0], [0, -0.1], [0.1, 0.1], [0, 0]]), 0.3, PLAIN)
    assert marker is not None
    assert marker.other is not None
    assert 0.0 < marker.ambiguity <= 1.0
    near = PLAIN.project(square(0.3) @ (matrix_from_euler(0.7, 0.0, 0.4) @ FACING).T + np.array([0, 0, 0.8]))
    sure = marker_from_corners(0, near, 0.3, PLAIN)
    assert sure is not None
    assert sure.ambiguity < 0.05
    assert np.linalg.norm(marker.other.position_camera_m - marker.position_camera_m) < 0.2


@settings(max_examples=8, deadline=None)
@given(yaw=st.floats(-math.pi, math.pi), height=st.floats(1.0, 6.0), part=st.floats(-1.0, 1.0))
def test_rendered_marker_is_detected_and_located(yaw: float, height: float, part: float) -> None:
    # As far to the north as the whole marker, corners included, is in view.
    north = part * min(0.6, height * PLAIN.cy / PLAIN.fy - 0.4)
    found = MarkerDetector(MarkerKind("4X4_50", 0.5)).detect(make_image(height, north, yaw), PLAIN)
    assert [marker.identifier for marker in found] == [7]
    right, down, forward = found[0].position_camera_m
    # Looking straight down with north to the top: north is up in the image.
    assert right == pytest.approx(0.0, abs=0.02 + 0.01 * height)
    assert -down == pytest.approx(north, abs=0.02 + 0.01 * height)
    assert forward == pytest.approx(height, rel=0.04)
    assert found[0].reprojection_px < 0.8


def test_rendered_marker_gives_its_heading() -> None:
    marker = MarkerDetector(MarkerKind("4X4_50", 0.5)).detect(make_image(1.5, 0.0, 0.6), PLAIN)[0]
    upper = marker.rotation[:, 1]
    assert math.atan2(upper[0], -upper[1]) == pytest.approx(0.6, abs=0.03)


def test_every_dictionary_detects_its_markers() -> None:
    for dictionary in ("4X4_50", "5X5_250", "6X6_1000", "ARUCO_ORIGINAL", "APRILTAG_16h5", "APRILTAG_36h11"):
        image = make_image(2.0, 0.0, 0.3, dictionary=dictionary, identifier=5, size=0.8)
        found = MarkerDetector(MarkerKind(dictionary, 0.8)).detect(image, PLAIN)
        assert 5 in [marker.identifier for marker in found], dictionary


def test_single_ids_may_have_a_size_of_their_own() -> None:
    kind = MarkerKind("4X4_50", 1.0, {7: 0.25})
    marker = MarkerDetector(kind).detect(make_image(2.0, 0.0, 0.0, size=0.25), PLAIN)[0]
    assert marker.size_m == 0.25
    assert marker.position_camera_m[2] == pytest.approx(2.0, rel=0.05)


def test_a_lens_with_distortion_does_not_move_the_marker() -> None:
    image = make_image(2.0, 0.5, 0.2, camera=BENT)  # the renderer draws it bent
    marker = MarkerDetector(MarkerKind("4X4_50", 0.5)).detect(image, BENT)[0]
    assert -marker.position_camera_m[1] == pytest.approx(0.5, abs=0.05)
    assert marker.position_camera_m[2] == pytest.approx(2.0, rel=0.05)


def test_image_without_markers_gives_none() -> None:
    detector = MarkerDetector(MarkerKind("4X4_50", 0.5))
    assert detector.detect(np.zeros((480, 640, 3), np.uint8), PLAIN) == ()
    noise = np.random.default_rng(1).integers(0, 255, (480, 640, 3), dtype=np.uint8)
    assert detector.detect(noise, PLAIN) == ()


@pytest.mark.parametrize(
    "corners",
    [
        np.zeros((4, 2)),
        np.array([[0, 0], [1, 1], [2, 2], [3, 3]]),
        np.full((4, 2), np.nan),
        # Seen from behind: counter-clockwise.
        np.array([[100, 100], [100, 200], [200, 200], [200, 100]]),
    ],
)
def test_invalid_corners_have_no_pose(corners: NDArray[Any]) -> None:
    assert marker_from_corners(0, corners, 0.5, PLAIN) is None


def test_marker_survives_pickling() -> None:
    marker = MarkerDetector(MarkerKind("4X4_50", 0.5)).detect(make_image(2.0, 0.0, 0.0), PLAIN)[0]
    data = pickle.dumps(marker)
    assert len(data) < 2000
    assert np.array_equal(pickle.loads(data).corners_px, marker.corners_px)
