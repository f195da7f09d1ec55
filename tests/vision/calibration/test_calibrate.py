"""Lenses recovered from projected corners with noise: models, outliers, and views that do not suffice."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from mavlink_sim.datasets.board_views import LENSES, BoardPose, board_poses
from vision.calibration.boards import Board, BoardView
from vision.calibration.calibrate import CalibrationError, calibrate
from vision.calibration.fit import _Problem, fit
from vision.camera_model import CameraModel

BOARD = Board("chessboard", 8, 6, 0.03)


def views_of(
    camera: CameraModel, count: int, seed: int = 1, noise_px: float = 0.07, poses: Sequence[BoardPose] = ()
) -> list[BoardView]:
    rng = np.random.default_rng(seed)
    made = board_poses(BOARD, camera, rng)
    shown = poses or [next(made) for _ in range(count)]
    corners = [pose.project(BOARD, camera) for pose in shown]
    return [
        BoardView(BOARD.points_m, each + rng.normal(0.0, noise_px, each.shape), (640, 480), f"view {number}")
        for number, each in enumerate(corners)
    ]


# The model of "plain" is that of "webcam".
@pytest.mark.parametrize(
    "lens", [pytest.param(each, marks=pytest.mark.slow) if each == "plain" else each for each in LENSES]
)
def test_lens_is_recovered_with_its_distortion_model(lens: str) -> None:
    true = LENSES[lens]
    result = calibrate(views_of(true, 14))
    model = result.model
    assert model.distortion_model == true.distortion_model
    assert (model.width, model.height) == (640, 480)
    assert (model.fx, model.fy) == pytest.approx((true.fx, true.fy), rel=0.003)
    assert (model.cx, model.cy) == pytest.approx((true.cx, true.cy), abs=1.0)
    assert result.rms_px == pytest.approx(0.07 * np.sqrt(2), rel=0.15)
    assert len(result.fit.view_rms_px) == len(result.views) == 14
    assert result.rejected == ()


def test_exact_corners_give_the_exact_lens() -> None:
    true = LENSES["webcam"]
    found = fit("plumb_bob", views_of(true, 10, noise_px=0.0))
    assert found.rms_px < 1e-5
    model = found.model
    assert (model.fx, model.fy, model.cx, model.cy) == pytest.approx(
        (true.fx, true.fy, true.cx, true.cy), abs=1e-3
    )
    assert model.distortion == pytest.approx(true.distortion, abs=1e-4)


def test_errors_agree_with_their_sigmas() -> None:
    true = LENSES["webcam"]
    ratios = []
    for seed in range(6):
        found = fit("plumb_bob", views_of(true, 15, seed))
        model, sigmas = found.model, found.sigmas
        errors = (model.fx - true.fx, model.fy - true.fy, model.cx - true.cx, model.cy - true.cy)
        ratios += [error / sigma for error, sigma in zip(errors, sigmas, strict=False)]
    assert 0.6 < np.sqrt(np.mean(np.square(ratios))) < 1.6


def test_wrong_views_are_rejected() -> None:
    views = views_of(LENSES["webcam"], 12)
    rng = np.random.default_rng(9)
    for index in (3, 11):
        wrong = views[index].corners_px + rng.normal(0.0, 3.0, views[index].corners_px.shape)
        views[index] = BoardView(views[index].points_m, wrong, (640, 480), f"view {index}")
    result = calibrate(views)
    assert {view.name for view, _ in result.rejected} == {"view 3", "view 11"}
    assert min(error for _, error in result.rejected) > 1.0
    assert result.rms_px < 0.12
    assert len(result.views) == 10


def test_too_few_views_are_refused() -> None:
    with pytest.raises(CalibrationError, match="5"):
        calibrate(views_of(LENSES["plain"], 5))


def test_too_few_views_after_rejection_are_refused() -> None:
    views = views_of(LENSES["webcam"], 7)
    rng = np.random.default_rng(9)
    for index in (1, 4):
        wrong = views[index].corners_px + rng.normal(0.0, 4.0, views[index].corners_px.shape)
        views[index] = BoardView(views[index].points_m, wrong, (640, 480))
    with pytest.raises(CalibrationError, match=r" 2 .*corners .*rejected"):
        calibrate(views)


def test_views_without_tilt_do_not_determine_the_lens() -> None:
    poses = [
        BoardPose(np.eye(3), np.array([x, y, 0.6])) for x in (-0.15, 0.0, 0.15) for y in (-0.1, 0.0, 0.1)
    ]
    with pytest.raises(CalibrationError, match="focal length"):
        calibrate(views_of(LENSES["plain"], 9, poses=poses))


def test_first_poses_in_a_wrong_minimum_are_replaced() -> None:
    true = LENSES["wide"]
    views = views_of(true, 20, seed=4)
    found = fit("rational_polynomial", views)
    problem = _Problem(views)
    poses = (found.rotations.copy(), found.positions_m.copy())
    assert problem.better_poses(found.model, *poses) is None
    poses[0][3] = poses[0][3] @ np.diag([-1.0, 1.0, -1.0])  # seen from behind
    better = problem.better_poses(found.model, *poses)
    assert better is not None
    assert np.abs(better[0][3] - found.rotations[3]).max() < 0.1
    assert np.array_equal(better[0][4], found.rotations[4])
