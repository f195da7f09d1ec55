"""Markers over several frames and in rigid sets: ambiguity, boards, covariance, rendered truth."""

from __future__ import annotations

import math
import pickle

import numpy as np
import pytest
from numpy.typing import NDArray

from mavlink_sim.camera.renderer import Renderer
from mavlink_sim.world.fiducials import Print
from mavlink_sim.world.structures import PLATE_THICKNESS_M
from mavlink_sim.world.world import Ground, World, WorldObject
from vision.camera_model import CameraModel, CameraMount
from vision.marker_ambiguity import AmbiguityResolver
from vision.marker_boards import Board, locate_board, ned_from_marker
from vision.markers import (
    CORNER_SIGMA_PX,
    Marker,
    MarkerDetector,
    MarkerKind,
    MarkerPose,
    marker_from_corners,
    square,
)
from vision.rotation import matrix_from_euler

Matrix = NDArray[np.float64]
CAMERA = CameraModel.from_horizontal_fov(640, 480, math.radians(70.0))
GROUND = Ground(("concrete",), 0, 256, 0.05)
SIZE_M = 0.5


def angle_deg(one: Matrix, other: Matrix) -> float:
    return math.degrees(math.acos(max(-1.0, min(1.0, (np.trace(one.T @ other) - 1.0) / 2.0))))


def seen(rotation: Matrix, position: Matrix, rng: np.random.Generator, size_m: float = SIZE_M) -> Marker:
    """A marker whose corners have the stated noise."""
    pixels = CAMERA.project(square(size_m) @ rotation.T + position)
    marker = marker_from_corners(3, pixels + rng.normal(0.0, CORNER_SIGMA_PX, (4, 2)), size_m, CAMERA)
    assert marker is not None
    return marker


def nearest(marker: Marker, rotation: Matrix) -> MarkerPose:
    return min(marker.poses, key=lambda pose: angle_deg(pose.rotation, rotation))


def looking_at(eye: Matrix, rng: np.random.Generator) -> Matrix:
    """`ned_from_body` of a camera that has the origin in the image, rolled and off the centre."""
    yaw, pitch = math.atan2(-eye[1], -eye[0]), -math.atan2(-eye[2], math.hypot(eye[0], eye[1]))
    off = rng.uniform(-0.1, 0.1, 2)
    heading = matrix_from_euler(0.0, 0.0, yaw + off[0])
    return heading @ matrix_from_euler(rng.uniform(-0.4, 0.4), pitch + off[1], 0.0)


@pytest.mark.parametrize("seed", range(6))
def test_rendered_pose_is_true_within_2_percent_and_2_degrees(seed: int) -> None:
    rng = np.random.default_rng(seed)
    standing = bool(seed % 2)
    printed = Print("APRILTAG_36h11", 7, SIZE_M, standing)
    yaw = rng.uniform(-math.pi, math.pi)
    renderer = Renderer(
        World((WorldObject(0, "plate", (0, 0, 0), yaw, printed=printed),), GROUND), CAMERA, CameraMount()
    )
    ned = ned_from_marker(yaw, standing)
    up = printed.board_side_m / 2 if standing else PLATE_THICKNESS_M
    centre = np.array([0.0, 0.0, -up]) + (ned[:, 2] * PLATE_THICKNESS_M / 2 if standing else 0.0)
    detector, checked = MarkerDetector(MarkerKind("APRILTAG_36h11", SIZE_M)), 0
    for _ in range(20):
        range_m, tilt, around = rng.uniform(1.2, 5.5), rng.uniform(0.0, 0.9), rng.uniform(-math.pi, math.pi)
        out = ned @ [math.sin(tilt) * math.cos(around), math.sin(tilt) * math.sin(around), math.cos(tilt)]
        eye = centre + range_m * out
        if eye[2] > -0.3:
            continue
        attitude = looking_at(eye - centre, rng)
        optical_from_ned = CameraMount().ned_from_optical(attitude).T
        found = detector.detect(renderer.render(tuple(eye), attitude).image, CAMERA)
        if not found or found[0].side_px < 40.0:
            continue
        position, rotation = optical_from_ned @ (centre - eye), optical_from_ned @ ned
        assert np.linalg.norm(found[0].position_camera_m - position) < 0.02 * range_m
        assert angle_deg(nearest(found[0], rotation).rotation, rotation) < 2.0
        # The stated noise of the corners is above that of rendered ones.
        off = np.linalg.solve(found[0].covariance[:3, :3], found[0].position_camera_m - position)
        assert off @ (found[0].position_camera_m - position) < 16.0
        checked += 1
    assert checked >= 5


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
