"""Which views are new, which are fitted, and what is missing."""

from __future__ import annotations

import numpy as np
import pytest

from mavlink_sim.datasets.board_views import LENSES, BoardPose, board_poses
from vision.calibration.boards import Board, BoardView
from vision.calibration.views import MOST_VIEWS, ViewCollector
from vision.rotation import matrix_from_euler

BOARD = Board("chessboard", 8, 6, 0.03)
CAMERA = LENSES["plain"]


def view_of(pose: BoardPose, name: str = "", size: tuple[int, int] = (640, 480)) -> BoardView:
    return BoardView(BOARD.points_m, pose.project(BOARD, CAMERA), size, name)


def face_on(x: float, y: float, range_m: float = 0.6) -> BoardPose:
    return BoardPose(np.eye(3), np.array([x, y, range_m]))


def test_same_view_is_not_kept_twice() -> None:
    collector = ViewCollector(BOARD)
    assert collector.add(view_of(face_on(0.0, 0.0)))
    assert not collector.add(view_of(face_on(0.002, 0.0)))
    assert collector.add(view_of(face_on(0.1, 0.0)))
    assert collector.add(view_of(BoardPose(matrix_from_euler(0.4, 0.0, 0.0), np.array([0.0, 0.0, 0.6]))))
    assert len(collector.views) == 3


def test_images_of_different_sizes_are_refused() -> None:
    collector = ViewCollector(BOARD)
    collector.add(view_of(face_on(0.0, 0.0), "a.png"))
    with pytest.raises(ValueError, match=r"a\.png has 640x480, b\.png 1280x960"):
        collector.add(view_of(face_on(0.1, 0.0), "b.png", (1280, 960)))


def test_missing_names_cells_sizes_tilts_and_count() -> None:
    collector = ViewCollector(BOARD)
    assert len(collector.missing()) == 1
    collector.add(view_of(face_on(-0.25, -0.15)))
    cells, size, tilts, count = collector.missing()
    assert "lower right" in cells
    assert "upper left" not in cells
    assert "closer" in size
    assert all(edge in tilts for edge in ("left", "right", "upper", "lower"))
    assert "14" in count


@pytest.mark.parametrize(
    ("roll", "pitch", "nearer"),
    [(-0.5, 0.0, "lower"), (0.5, 0.0, "upper"), (0.0, 0.5, "right"), (0.0, -0.5, "left")],
)
def test_tilted_view_supplies_its_edge(roll: float, pitch: float, nearer: str) -> None:
    collector = ViewCollector(BOARD)
    pose = BoardPose(matrix_from_euler(roll, pitch, 0.0), np.array([0.0, 0.0, 0.5]))
    corners = BOARD.points_m
    edge = {"lower": (0, 0.1), "upper": (0, -0.1), "right": (0.1, 0), "left": (-0.1, 0)}[nearer]
    assert (pose.rotation @ (*edge, 0.0))[2] < 0.0
    collector.add(BoardView(corners, pose.project(BOARD, CAMERA), (640, 480)))
    (tilts,) = (line for line in collector.missing() if "tilted" in line)
    assert nearer not in tilts
    assert sum(edge in tilts for edge in ("left", "right", "upper", "lower")) == 3


def test_turned_board_is_judged_by_the_image() -> None:
    collector = ViewCollector(BOARD)
    turned = matrix_from_euler(-0.5, 0.0, 0.0) @ matrix_from_euler(0.0, 0.0, 1.6)
    collector.add(view_of(BoardPose(turned, np.array([0.0, 0.0, 0.6]))))
    (tilts,) = (line for line in collector.missing() if "tilted" in line)
    assert "lower" not in tilts


def test_complete_set_lacks_nothing_and_is_thinned_evenly() -> None:
    collector = ViewCollector(BOARD)
    poses = board_poses(BOARD, CAMERA, np.random.default_rng(3))
    for _ in range(150):
        collector.add(view_of(next(poses)))
    assert collector.missing() == []
    chosen = collector.chosen()
    assert len(collector.views) > MOST_VIEWS == len(chosen)
    wide = np.ptp(np.concatenate([view.corners_px for view in chosen]), axis=0)
    whole = np.ptp(np.concatenate([view.corners_px for view in collector.views]), axis=0)
    assert (wide > 0.95 * whole).all()
