"""A depth camera's place on a colour camera, recovered from projected corners with noise."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest

from mavlink_sim.datasets.board_views import LENSES, BoardPose, board_pairs, random_rig
from vision.calibration.boards import Board, BoardView
from vision.calibration.calibrate import CalibrationError
from vision.calibration.extrinsics import extrinsics_from_views
from vision.calibration_files.camera_info import read_camera_info, read_registration, write_camera_info
from vision.camera_model import CameraModel
from vision.depth_registration import DepthCalibration
from vision.orientation import Orientation

BOARD = Board("chessboard", 8, 6, 0.03)
SIZE = (640, 480)
Pair = tuple[BoardView, BoardView]


def rig_of(lens: str, seed: int = 1) -> DepthCalibration:
    return random_rig(LENSES[lens], LENSES["plain"], np.random.default_rng(seed))


def view(pose: BoardPose, lens: CameraModel, name: str, rng: np.random.Generator) -> BoardView:
    corners = pose.project(BOARD, lens)
    return BoardView(BOARD.points_m, corners + rng.normal(0.0, 0.07, corners.shape), SIZE, name)


def pairs_of(rig: DepthCalibration, count: int, seed: int = 1) -> list[Pair]:
    rng = np.random.default_rng(seed)
    return [
        (view(one, rig.colour, f"view {number}", rng), view(two, rig.depth, f"view {number}", rng))
        for number, (one, two) in enumerate(islice(board_pairs(BOARD, rig, rng), count))
    ]


def errors(found: DepthCalibration, true: DepthCalibration) -> tuple[float, float]:
    """Of the position, millimetres, and of the rotation, degrees."""
    turn = cv2.Rodrigues(found.rotation @ true.rotation.T)[0]
    off = np.linalg.norm(found.position_m - true.position_m) * 1000
    return float(off), float(np.degrees(np.linalg.norm(turn)))


@pytest.mark.parametrize("lens", LENSES)
def test_place_is_recovered_with_its_errors(lens: str) -> None:
    rig = rig_of(lens)
    found = extrinsics_from_views(pairs_of(rig, 15), rig.colour, rig.depth)
    off_mm, turn_deg = errors(found.calibration, rig)
    assert off_mm < 0.5
    assert turn_deg < 0.05
    assert (found.views, found.rejected) == (15, ())
    assert found.rms_px == pytest.approx(0.07 * np.sqrt(2), rel=0.4)
    assert off_mm < 4 * found.position_sigma_m * 1000
    assert np.radians(turn_deg) < 4 * found.rotation_sigma_rad


def test_corners_that_one_camera_does_not_see_are_left_out() -> None:
    rig = rig_of("plain")
    part = [
        (
            BoardView(one.points_m[:30], one.corners_px[:30], SIZE, one.name),
            BoardView(two.points_m[::-1][:40], two.corners_px[::-1][:40], SIZE),
        )
        for one, two in pairs_of(rig, 12)
    ]
    assert errors(extrinsics_from_views(part, rig.colour, rig.depth).calibration, rig)[0] < 2.0


def test_images_that_do_not_belong_together_are_rejected() -> None:
    rig = rig_of("webcam")
    pairs = pairs_of(rig, 16)
    pairs[5] = (pairs[5][0], pairs[6][1])
    found = extrinsics_from_views(pairs, rig.colour, rig.depth)
    assert [name for name, _ in found.rejected] == ["view 5"]
    assert errors(found.calibration, rig)[0] < 0.5


def test_views_that_do_not_suffice_are_refused() -> None:
    rig = rig_of("plain")
    pairs = pairs_of(rig, 6)
    with pytest.raises(CalibrationError, match=r"few views .*5"):
        extrinsics_from_views(pairs[:5], rig.colour, rig.depth)
    rng = np.random.default_rng(2)
    far = BoardPose(np.eye(3), np.array([0.0, 0.0, 8.0]))
    back = rig.rotation.T
    other = BoardPose(back, back @ (far.position_m - rig.position_m))
    level = [(view(far, rig.colour, "far", rng), view(other, rig.depth, "far", rng)) for _ in range(6)]
    with pytest.raises(CalibrationError, match=r"not determine .* \d+ mm, "):
        extrinsics_from_views(level, rig.colour, rig.depth)


def test_written_registration_is_read_unchanged(tmp_path: Path) -> None:
    rig = random_rig(LENSES["fisheye"], LENSES["webcam"], np.random.default_rng(1))
    file = tmp_path / "depth.yaml"
    write_camera_info(file, rig.depth, "depth", orientation=Orientation(180), registration=rig)
    info = read_camera_info(file)
    assert info.registration is not None
    assert (info.model, info.registration.depth, info.registration.colour) == (
        rig.depth,
        rig.depth,
        rig.colour,
    )
    np.testing.assert_allclose(info.registration.rotation, rig.rotation, atol=1e-9)
    np.testing.assert_allclose(info.registration.position_m, rig.position_m, atol=1e-9)
    assert read_registration(str(file), Orientation(180)).colour == rig.colour
    with pytest.raises(ValueError, match="rotate_deg"):
        read_registration(str(file), Orientation())
    text = file.read_text()
    file.write_text(
        text.replace("colour_from_depth:\n  rows: 3\n  cols: 4\n  data: [", "colour_from_depth:\n  data: [1")
    )
    with pytest.raises(ValueError, match="a rotation and a position"):
        read_registration(str(file), Orientation(180))
    write_camera_info(file, rig.depth, "depth")
    with pytest.raises(ValueError, match="colour_from_depth:"):
        read_registration(str(file), Orientation())
