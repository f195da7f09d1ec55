"""Where a depth camera is on a colour camera: from views of one board that both see at the same time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from vision.calibration.boards import BoardView
from vision.calibration.calibrate import LEAST_VIEWS, NO_OUTLIER_PX, OUTLIER, CalibrationError
from vision.camera_model import CameraModel, scaled_to_frames
from vision.depth_registration import DepthCalibration

Array = NDArray[np.float64]

# Fewest corners that both cameras see, and the least part of a corner's ray along the optical axis.
_LEAST_CORNERS, _AHEAD = 8, 0.2
# Parts of the views that are left out in turn for the errors (jackknife).
_PARTS = 4
# One-sigma errors above which the views do not determine the result.
_WORST_M, _WORST_RAD = 0.01, math.radians(0.5)


@dataclass(frozen=True, slots=True, eq=False)
class Extrinsics:
    """A depth camera's place on a colour camera.

    Attributes:
        calibration: the result, with both lenses.
        views: number of used pairs. rejected: names of the outliers, and their RMS errors, pixels.
        rms_px: RMS reprojection error of both cameras.
        position_sigma_m, rotation_sigma_rad: one-sigma errors of the position's length and of the rotation.
    """

    calibration: DepthCalibration
    views: int
    rejected: tuple[tuple[str, float], ...]
    rms_px: float
    position_sigma_m: float
    rotation_sigma_rad: float


def extrinsics_from_views(
    pairs: Sequence[tuple[BoardView, BoardView]], colour: CameraModel, depth: CameraModel
) -> Extrinsics:
    """Fit the rotation and position; pairs whose error stands out are rejected.

    Args:
        pairs: of views of the colour camera and of the depth camera, at the same time.
        colour, depth: their lenses, calibrated before.

    Raises:
        CalibrationError: too few pairs, or they do not determine the result.
        ValueError: a view has another aspect than its lens.
    """
    used = [
        (first.name, *shared)
        for first, second in pairs
        if (shared := _shared_corners(first, second, colour, depth)) is not None
    ]
    rejected: list[tuple[str, float]] = []
    while True:
        if len(used) < LEAST_VIEWS:
            after = (
                f", after {len(rejected)} were rejected: do the images belong together?" if rejected else ""
            )
            raise CalibrationError(
                f"too few views that both cameras see: {len(used)} different ones, at least {LEAST_VIEWS} "
                f"are needed{after}"
            )
        rotation, position, errors = _fitted(used, colour, depth)
        limit = max(OUTLIER * float(np.median(errors)), NO_OUTLIER_PX)
        if (errors <= limit).all():
            break
        # One after the other: a wrong pair makes others look wrong.
        worst = int(errors.argmax())
        rejected.append((used.pop(worst)[0], float(errors[worst])))
    parts = [
        _fitted([each for index, each in enumerate(used) if index % _PARTS != part], colour, depth)
        for part in range(_PARTS)
    ]
    turns = [cv2.Rodrigues(other @ rotation.T)[0].ravel() for other, _, _ in parts]
    position_sigma_m, rotation_sigma_rad = (
        math.sqrt((_PARTS - 1) * float(np.var(np.array(values), axis=0).sum()))
        for values in ([other for _, other, _ in parts], turns)
    )
    if not (position_sigma_m < _WORST_M and rotation_sigma_rad < _WORST_RAD):
        raise CalibrationError(
            f"the views do not determine where the cameras are on each other (errors "
            f"{position_sigma_m * 1000:.0f} mm, {math.degrees(rotation_sigma_rad):.1f} degrees): add nearer "
            "ones, with the board tilted to each side"
        )
    calibration = DepthCalibration(depth, colour, rotation, position)
    rms_px = float(np.sqrt((errors**2).mean()))
    return Extrinsics(calibration, len(used), tuple(rejected), rms_px, position_sigma_m, rotation_sigma_rad)


_Shared = tuple[str, Array, Array, Array]
"""Name, (N, 2) points on the board, and (N, 2) each camera's rays of them at unit depth."""


def _shared_corners(
    first: BoardView, second: BoardView, colour: CameraModel, depth: CameraModel
) -> tuple[Array, Array, Array] | None:
    """The corners that both see; None: too few."""
    same = (first.points_m[:, None] == second.points_m).all(axis=2)
    ones, twos = np.nonzero(same)
    rays = [
        scaled_to_frames(lens, *view.size).rays(view.corners_px[indices])
        for lens, view, indices in ((colour, first, ones), (depth, second, twos))
    ]
    ahead = (rays[0][:, 2] > _AHEAD) & (rays[1][:, 2] > _AHEAD)  # NaN is not
    if ahead.sum() < _LEAST_CORNERS:
        return None
    plane = [each[ahead, :2] / each[ahead, 2:] for each in rays]
    return first.points_m[ones][ahead], plane[0], plane[1]


def _fitted(views: Sequence[_Shared], colour: CameraModel, depth: CameraModel) -> tuple[Array, Array, Array]:
    """`colour_from_depth` as rotation and position, and the RMS error of each pair, pixels.

    The corners are those of ideal pinhole cameras with the lenses' focal lengths.
    """
    focal = [(lens.fx + lens.fy) / 2 for lens in (depth, colour)]
    boards = [
        np.column_stack([points, np.zeros(len(points))]).astype(np.float32) for _, points, _, _ in views
    ]
    of_depth = [(plane * focal[0]).astype(np.float32) for _, _, _, plane in views]
    of_colour = [(plane * focal[1]).astype(np.float32) for _, _, plane, _ in views]
    cameras = [np.diag((each, each, 1.0)) for each in focal]
    none = np.zeros(5)
    found = cv2.stereoCalibrateExtended(
        *(boards, of_depth, of_colour, cameras[0], none, cameras[1], none, (colour.width, colour.height)),
        *(np.eye(3), np.zeros((3, 1))),
        flags=cv2.CALIB_FIX_INTRINSIC,
        criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-9),
    )
    rotation, position, errors = found[5], found[6], found[-1]
    return (
        np.asarray(rotation, np.float64),
        np.asarray(position, np.float64).ravel(),
        np.sqrt((np.asarray(errors, np.float64) ** 2).mean(axis=1)),
    )
