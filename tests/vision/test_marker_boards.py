"""Markers over several frames and in rigid sets: ambiguity, boards, covariance, rendered truth."""

from __future__ import annotations

import math
import pickle

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.marker_poses import CAMERA, PoseError, angle_deg, pose_errors
from vision.marker_ambiguity import AmbiguityResolver
from vision.marker_boards import Board, locate_board
from vision.marker_edges import CORNER_SIGMA_PX, RAW_SIGMA_PX, UNSETTLED_SIGMA_PX
from vision.markers import (
    Marker,
    MarkerDetector,
    MarkerKind,
    MarkerPose,
    marker_from_corners,
    square,
)
from vision.rotation import matrix_from_euler

Matrix = NDArray[np.float64]
SIZE_M = 0.5


def seen(rotation: Matrix, position: Matrix, rng: np.random.Generator, size_m: float = SIZE_M) -> Marker:
    """A marker whose corners have the stated noise."""
    pixels = CAMERA.project(square(size_m) @ rotation.T + position)
    marker = marker_from_corners(3, pixels + rng.normal(0.0, CORNER_SIGMA_PX, (4, 2)), size_m, CAMERA)
    assert marker is not None
    return marker


def nearest(marker: Marker, rotation: Matrix) -> MarkerPose:
    return min(marker.poses, key=lambda pose: angle_deg(pose.rotation, rotation))


def true_errors(seed: int) -> list[PoseError]:
    """Of the markers found in the images of one scene."""
    return [error for error in pose_errors(seed) if error is not None]


@pytest.mark.parametrize(
    "seeds", [(1, 711, 2003), pytest.param((0, 1, 711, 2003, 2017, 2095), marks=pytest.mark.slow)], ids=len
)
def test_rendered_poses_are_true_with_a_covariance_of_their_shape(seeds: tuple[int, ...]) -> None:
    """Scaled to the noise of the rendered corners, two thirds of the errors lie within one sigma.

    In images of each of the large seeds, ground in the sun is brighter than the marker's sheet, in shade.
    """
    scenes = [true_errors(seed) for seed in seeds]
    for errors in scenes:
        assert len(errors) >= 10
        for error in errors:
            assert error.range_share < 0.005
            assert error.angle_deg < 2.0
            assert error.corner_px < 0.1
            # The stated noise of the corners is above that of rendered ones.
            assert np.abs(error.normalized).max() < 3.0
    errors = [error for scene in scenes for error in scene]
    corner_px = math.sqrt(float(np.mean([error.corner_px**2 for error in errors])))
    normalized = np.abs([error.normalized for error in errors]) * CORNER_SIGMA_PX / corner_px
    assert 0.6 < float((normalized < 1.0).mean()) < 0.78


# of seeds 5000..5099 the worst when a pixel is one sample
@pytest.mark.slow
@pytest.mark.parametrize("seed", [5024, 5081, 5091, 5096])
def test_poses_are_true_in_images_of_pixels_that_average_the_light(seed: int) -> None:
    errors = [error for error in pose_errors(seed, samples=4) if error is not None]
    assert len(errors) >= 10
    assert max(error.range_share for error in errors) < 0.005
    assert max(error.angle_deg for error in errors) < 2.0


def test_corners_that_fit_badly_have_a_larger_covariance() -> None:
    rotation, position = matrix_from_euler(0.3, 0.2, 0.3) @ np.diag([1.0, -1.0, -1.0]), np.array([0, 0, 4.0])
    pixels = CAMERA.project(square(SIZE_M) @ rotation.T + position)
    exact = marker_from_corners(3, pixels, SIZE_M, CAMERA)
    rough = marker_from_corners(3, pixels, SIZE_M, CAMERA, RAW_SIGMA_PX)
    displaced = np.array([[0.0, 0.0], [0.0, 0.0], [0.0, 0.0], [2.0, -2.0]])
    wrong = marker_from_corners(3, pixels + displaced, SIZE_M, CAMERA)
    assert exact is not None
    assert rough is not None
    assert wrong is not None
    assert rough.corner_sigma_px == RAW_SIGMA_PX
    assert np.allclose(rough.covariance, exact.covariance * (RAW_SIGMA_PX / CORNER_SIGMA_PX) ** 2)
    off = np.abs(wrong.position_camera_m - position) / np.sqrt(np.diag(wrong.covariance)[:3])
    assert off.max() < 3.0


def test_marker_with_a_partly_hidden_edge_has_rough_corners() -> None:
    image = np.full((480, 640), 255, np.uint8)
    image[120:300, 200:380] = cv2.aruco.generateImageMarker(
        cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11), 7, 180
    )
    (clear,) = MarkerDetector(MarkerKind("APRILTAG_36h11", SIZE_M)).detect(image, CAMERA)
    assert clear.corner_sigma_px == CORNER_SIGMA_PX
    image[120:128, 200:260] = 255
    (hidden,) = MarkerDetector(MarkerKind("APRILTAG_36h11", SIZE_M)).detect(image, CAMERA)
    assert hidden.corner_sigma_px == RAW_SIGMA_PX


def test_small_blurred_noisy_marker_keeps_its_fitted_corners() -> None:
    """Where the fit does not settle it is nearer than OpenCV's corners, and its noise is stated larger."""
    printed = cv2.aruco.generateImageMarker(
        cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11), 7, 320
    )
    detector, rng = MarkerDetector(MarkerKind("APRILTAG_36h11", SIZE_M)), np.random.default_rng(3)
    errors_px, sigmas = [], []
    for _ in range(40):
        large = np.full((960, 1280), 255, np.uint8)  # eight times as large, then averaged
        left, top = rng.integers(300, 500, 2)
        large[top : top + 320, left : left + 320] = printed
        image = cv2.GaussianBlur(cv2.resize(large, (160, 120), interpolation=cv2.INTER_AREA), (0, 0), 2.0)
        noisy = np.clip(image + rng.normal(0.0, 8.0, image.shape), 0, 255).astype(np.uint8)
        frame = cv2.copyMakeBorder(noisy, 0, 360, 0, 480, cv2.BORDER_CONSTANT, value=255)
        for marker in detector.detect(frame, CAMERA):
            true_px = np.add([[0, 0], [320, 0], [320, 320], [0, 320]], [left, top]) / 8 - 0.5
            errors_px.append(float(np.abs(marker.corners_px - true_px).max()))
            sigmas.append(marker.corner_sigma_px)
    assert {CORNER_SIGMA_PX, UNSETTLED_SIGMA_PX} <= set(sigmas)
    unsettled = [error for error, sigma in zip(errors_px, sigmas, strict=True) if sigma == UNSETTLED_SIGMA_PX]
    assert max(unsettled) < 0.8


def test_two_thirds_of_positions_lie_within_one_sigma() -> None:
    rng = np.random.default_rng(7)
    inside: list[Matrix] = []
    for _ in range(400):
        position = np.array([rng.uniform(-1, 1), rng.uniform(-1, 1), rng.uniform(2.0, 6.0)])
        facing = matrix_from_euler(
            rng.uniform(-0.6, 0.6), rng.uniform(-0.6, 0.6), rng.uniform(-3, 3)
        ) @ np.diag([1.0, -1.0, -1.0])
        marker = seen(facing, position, rng)
        pose = nearest(marker, facing)
        inside.append(np.abs(pose.position_camera_m - position) < np.sqrt(np.diag(pose.covariance)[:3]))
    assert 0.63 < float(np.mean(inside)) < 0.73


@pytest.mark.parametrize("seed", range(4))
def test_the_true_pose_is_found_as_the_camera_moves(seed: int) -> None:
    """A small marker far away: in single frames the wrong pose often fits better."""
    rng = np.random.default_rng(seed)
    world_from_marker = matrix_from_euler(0.2, 0.3, 0.3) @ np.diag([1.0, -1.0, -1.0])
    resolver, single, resolved = AmbiguityResolver(), [], []
    for frame in range(90):
        # An arc of 23 degrees about the marker, which the camera keeps in the image.
        world_from_optical = matrix_from_euler(0.0, -0.2 + 0.4 * frame / 90, 0.0)
        rotation = world_from_optical.T @ world_from_marker
        marker = seen(rotation, np.array([0.0, 0.0, 8.0]), rng, 0.3)
        pose = resolver.resolve(marker, frame * 33_000_000, world_from_optical)
        single.append(angle_deg(marker.rotation, rotation) > 10.0)
        if frame >= 10:
            assert pose is not None
            resolved.append(angle_deg(pose.rotation, rotation) > 10.0)
    assert sum(single) >= 5
    assert sum(resolved) == 0


def test_one_frame_from_far_away_is_not_resolved() -> None:
    rng = np.random.default_rng(0)
    marker = seen(
        matrix_from_euler(0.1, 0.05, 0.0) @ np.diag([1.0, -1.0, -1.0]), np.array([0, 0, 8.0]), rng, 0.3
    )
    assert len(marker.poses) == 2
    assert AmbiguityResolver().resolve(marker, 0, np.eye(3)) is None
    near = seen(matrix_from_euler(0.7, 0.0, 0.0) @ np.diag([1.0, -1.0, -1.0]), np.array([0, 0, 1.2]), rng)
    assert AmbiguityResolver().resolve(near, 0, np.eye(3)) is not None


@pytest.mark.parametrize("seed", range(3))
def test_clear_frame_restarts_a_marker_that_was_turned(seed: int) -> None:
    """To about the attitude of its other pose, where the memory of the first one would prevail."""
    rng, resolver = np.random.default_rng(seed), AmbiguityResolver()
    position = np.array([0.1, 0.0, 2.5])
    for frame in range(60):
        tilt = 0.6 if frame < 40 else -0.6
        rotation = matrix_from_euler(tilt, 0.0, 0.3) @ np.diag([1.0, -1.0, -1.0])
        pose = resolver.resolve(seen(rotation, position, rng), 1 + frame * 50_000_000, np.eye(3))
        assert pose is not None
        assert angle_deg(pose.rotation, rotation) < 5.0


def board_of(places: dict[int, tuple[float, float]], size_m: float) -> Board:
    corners = {identifier: square(size_m) + np.array([*place, 0.0]) for identifier, place in places.items()}
    return Board("dock", corners)


def board_markers(
    board: Board, rotation: Matrix, position: Matrix, rng: np.random.Generator, size_m: float
) -> list[Marker]:
    markers = []
    for identifier, corners in board.corners_m.items():
        pixels = CAMERA.project(corners @ rotation.T + position) + rng.normal(0.0, CORNER_SIGMA_PX, (4, 2))
        marker = marker_from_corners(identifier, pixels, size_m, CAMERA)
        assert marker is not None
        markers.append(marker)
    return markers


def test_board_is_more_precise_than_its_markers() -> None:
    board = board_of({1: (-0.6, 0.4), 2: (0.6, 0.4), 3: (-0.6, -0.4), 4: (0.6, -0.4)}, 0.2)
    rng = np.random.default_rng(3)
    of_board, of_marker, tilts, inside = [], [], [], []
    for _ in range(40):
        rotation = matrix_from_euler(
            rng.uniform(-0.4, 0.4), rng.uniform(-0.4, 0.4), rng.uniform(-3, 3)
        ) @ np.diag([1.0, -1.0, -1.0])
        position = np.array([*rng.uniform(-0.5, 0.5, 2), 6.0])
        markers = board_markers(board, rotation, position, rng, 0.2)
        located = locate_board(board, markers, CAMERA)
        assert located is not None
        assert set(located.identifiers) == {1, 2, 3, 4}
        assert not located.ambiguous
        assert len(pickle.dumps(located)) < 1500
        origin = located.at_origin()
        of_board.append(np.linalg.norm(origin.position_camera_m - position))
        tilts.append(angle_deg(origin.rotation, rotation))
        own = position + rotation @ [-0.6, 0.4, 0.0]
        of_marker.append(np.linalg.norm(markers[0].position_camera_m - own))
        inside.append(np.abs(origin.position_camera_m - position) < np.sqrt(np.diag(origin.covariance)[:3]))
    assert np.median(of_board) < 0.3 * np.median(of_marker)
    assert max(tilts) < 1.0
    assert 0.55 < float(np.mean(inside)) < 0.8


def test_moved_marker_of_a_board_is_left_out() -> None:
    board = board_of({1: (-0.6, 0.0), 2: (0.6, 0.0), 3: (0.0, 0.5)}, 0.3)
    rng = np.random.default_rng(5)
    rotation, position = np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 3.0])
    markers = board_markers(board, rotation, position, rng, 0.3)
    moved = CAMERA.project(square(0.3) @ rotation.T + position + [0.9, 0.9, 0.0])
    wrong = marker_from_corners(2, moved, 0.3, CAMERA)
    assert wrong is not None
    located = locate_board(board, [markers[0], wrong, markers[2]], CAMERA)
    assert located is not None
    assert set(located.identifiers) == {1, 3}
    assert np.linalg.norm(located.at_origin().position_camera_m - position) < 0.03
    assert locate_board(board, [markers[0], wrong], CAMERA) is None
    assert locate_board(board_of({9: (0.0, 0.0)}, 0.3), markers, CAMERA) is None
