"""Boards: their description, their print, and the detection of rendered ones."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from mavlink_sim.datasets.board_views import LENSES, BoardCamera, BoardPose, board_poses
from vision.calibration.boards import Board
from vision.calibration.seen_boards import FAMILIES, contradiction, seen_board
from vision.camera_model import CameraModel
from vision.marker_dictionaries import opencv_dictionary
from vision.rotation import matrix_from_euler

CHESSBOARD = Board("chessboard", 10, 7, 0.02)
CHARUCO = Board("charuco", 10, 7, 0.02, 0.015, "4X4_50")


class LegacyBoard(Board):
    """A ChArUco board as OpenCV drew them before 4.6, and as calib.io does."""

    def image(self, square_px: int) -> NDArray[np.uint8]:
        assert self.marker_m is not None
        assert self.dictionary is not None
        size, dictionary = (self.columns, self.rows), opencv_dictionary(self.dictionary)
        board = cv2.aruco.CharucoBoard(size, self.square_m, self.marker_m, dictionary)
        board.setLegacyPattern(True)
        image = np.asarray(board.generateImage((self.columns * square_px, self.rows * square_px)), np.uint8)
        return np.pad(image, square_px, constant_values=255)


def views_of(board: Board, lens: str, count: int, seed: int = 0) -> list[NDArray[np.uint8]]:
    """Rendered images of a board in random poses."""
    rng = np.random.default_rng(seed)
    camera, poses = BoardCamera(board, LENSES[lens]), board_poses(board, LENSES[lens], rng)
    return [camera.render(next(poses), rng) for _ in range(count)]


def test_chessboard_counts_corners_and_charuco_squares() -> None:
    assert (CHESSBOARD.squares, len(CHESSBOARD.points_m)) == ((11, 8), 70)
    assert (CHARUCO.squares, len(CHARUCO.points_m)) == ((10, 7), 54)
    assert CHESSBOARD.points_m.mean(axis=0) == pytest.approx((0.0, 0.0))
    assert CHESSBOARD.points_m[1] - CHESSBOARD.points_m[0] == pytest.approx((0.02, 0.0))
    assert CHARUCO.size_m == pytest.approx((0.2, 0.14))


@pytest.mark.parametrize("board", [CHESSBOARD, CHARUCO], ids=["chessboard", "charuco"])
def test_corners_of_the_print_are_where_the_board_says(board: Board) -> None:
    image = board.image(40)
    assert image.shape == ((board.squares[1] + 2) * 40, (board.squares[0] + 2) * 40)
    view = board.detect(image)
    assert view is not None
    assert len(view.points_m) == len(board.points_m)
    middle = (np.array(image.shape[::-1]) - 1) / 2
    expected = view.points_m / board.square_m * 40
    if (view.corners_px[0] - middle) @ expected[0] < 0:  # a chessboard turned by half
        expected = -expected
    assert np.abs(view.corners_px - middle - expected).max() < 0.1


@pytest.mark.parametrize("board", [CHESSBOARD, CHARUCO], ids=["chessboard", "charuco"])
@pytest.mark.parametrize("lens", ["webcam", "fisheye"])
def test_rendered_corners_are_found_where_the_lens_projects_them(board: Board, lens: str) -> None:
    camera = LENSES[lens]
    pose = BoardPose(matrix_from_euler(0.4, -0.3, 0.2), np.array([0.01, -0.02, 0.3]))
    image = BoardCamera(board, camera).render(pose, np.random.default_rng(1))
    assert image.shape == (480, 640)
    view = board.detect(image)
    assert view is not None
    points = np.column_stack([view.points_m, np.zeros(len(view.points_m))])
    errors = [
        camera.project(turned @ pose.rotation.T + pose.position_m) - view.corners_px
        for turned in (points, -points)
    ]
    error = min(errors, key=lambda each: float(np.abs(each).max()))
    assert np.sqrt((error**2).sum(axis=1).mean()) < 0.2
    assert np.abs(error.mean(axis=0)).max() < 0.06


def test_partly_hidden_charuco_is_found_and_chessboard_is_not() -> None:
    pose = BoardPose(np.eye(3), np.array([0.12, 0.0, 0.22]))
    rng = np.random.default_rng(1)
    charuco = CHARUCO.detect(BoardCamera(CHARUCO, LENSES["plain"]).render(pose, rng))
    assert charuco is not None
    assert 14 <= len(charuco.points_m) < 54
    assert CHESSBOARD.detect(BoardCamera(CHESSBOARD, LENSES["plain"]).render(pose, rng)) is None


def test_fisheye_sees_a_board_beyond_90_degrees() -> None:
    camera = CameraModel(640, 480, 150.0, 150.0, 319.5, 239.5, (0.0,) * 4, "equidistant")
    angle = math.radians(95.0)
    position = np.array([math.sin(angle), 0.0, math.cos(angle)]) * 0.3
    pose = BoardPose(matrix_from_euler(0.0, angle, 0.0), position)
    assert (pose.rotation @ (0.0, 0.0, 1.0)) @ position == pytest.approx(0.3)
    image = BoardCamera(CHESSBOARD, camera, noise=0.0).render(pose, np.random.default_rng(1))
    x, y = np.rint(pose.project(CHESSBOARD, camera)).astype(int).T
    assert x.min() > 480
    assert np.ptp(image[y.min() : y.max(), x.min() : x.max()]) > 100
    assert np.ptp(image[:, :320]) < 60


@pytest.mark.parametrize("size", [(10, 8), (7, 10), (5, 6)])
@pytest.mark.parametrize("kind", [Board, LegacyBoard])
def test_either_pattern_of_a_charuco_is_found(kind: type[Board], size: tuple[int, int]) -> None:
    given = Board("charuco", *size, 0.02, 0.015, "4X4_50")
    board = kind("charuco", *size, 0.02, 0.015, "4X4_50")
    view = given.detect(image := board.image(40))
    assert view is not None
    assert view.legacy == (kind is LegacyBoard)
    assert len(view.points_m) == len(given.points_m)
    middle = (np.array(image.shape[::-1]) - 1) / 2
    assert np.abs(view.corners_px - middle - view.points_m / given.square_m * 40).max() < 0.1


def test_odd_rows_have_one_pattern() -> None:
    view = CHARUCO.detect(LegacyBoard("charuco", 10, 7, 0.02, 0.015, "4X4_50").image(40))
    assert view is not None
    assert not view.legacy


@pytest.mark.parametrize("lens", ["webcam", "fisheye"])
@pytest.mark.parametrize(
    "board",
    [
        CHARUCO,
        Board("charuco", 7, 10, 0.02, 0.012, "5X5_100"),
        LegacyBoard("charuco", 11, 8, 0.02, 0.015, "4X4_50"),
    ],
)
def test_layout_of_a_board_is_read_from_its_markers(board: Board, lens: str) -> None:
    assert board.dictionary is not None
    assert board.marker_m is not None
    for image in views_of(board, lens, 3):
        seen = seen_board(image, (board.dictionary,))
        assert seen is not None
        assert (seen.columns, seen.rows) == (board.columns, board.rows)
        assert seen.marker_first == isinstance(board, LegacyBoard)
        assert seen.marker_share == pytest.approx(board.marker_m / board.square_m, rel=0.1)
        assert contradiction(board, [seen]) is None


@pytest.mark.parametrize(
    ("board", "facts"),
    [
        (Board("charuco", 7, 10, 0.02, 0.015, "4X4_50"), ("7 columns", "10 rows")),
        (Board("charuco", 9, 7, 0.02, 0.015, "4X4_50"), ("9 columns", "7 rows")),
        (Board("charuco", 10, 9, 0.02, 0.015, "4X4_50"), ("10 columns", "9 rows")),
        (LegacyBoard("charuco", 10, 8, 0.02, 0.015, "4X4_50"), ("10 columns", "8 rows")),
        (Board("charuco", 10, 7, 0.02, 0.015, "5X5_50"), ("5X5",)),
        (Board("charuco", 10, 7, 0.02, 0.012, "4X4_50"), ("of 0.",)),
    ],
)
def test_other_board_than_the_given_is_named_with_both(board: Board, facts: tuple[str, ...]) -> None:
    (image,) = views_of(board, "webcam", 1)
    seen = seen_board(image, (str(CHARUCO.dictionary), *FAMILIES))
    assert seen is not None
    why = contradiction(CHARUCO, [seen])
    assert why is not None
    for fact in (*facts, "10x7", "4X4_50"):
        assert fact in why


def test_images_without_a_board_contradict_nothing() -> None:
    noise = np.random.default_rng(2).integers(0, 256, (240, 320), np.uint8)
    assert seen_board(noise, FAMILIES) is None
    assert contradiction(CHARUCO, []) is None
