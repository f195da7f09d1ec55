"""Rigid sets of markers: boards, whose markers are solved for one pose, and a map, a board in local NED.

All corners of a set that are in the image are fitted together, so its pose is more precise than that of any
of its markers, and an ambiguous one is resolved by the others.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from vision.camera_model import CameraModel
from vision.markers import WORST_FIT, WORST_FIT_PX, Marker, MarkerPose, fit_poses
from vision.rotation import matrix_from_euler

MAP = "map"
"""The name of the board that is the map."""
# Above this ratio of its error to that of the second pose, a pose is ambiguous.
AMBIGUOUS = 0.5
# A fit starts from the poses of so many markers, the largest in the image.
_START_MARKERS = 2
# Trace of the rotation between two starts that are 10° apart.
_TURNED_TRACE = 1.0 + 2.0 * math.cos(math.radians(10.0))


# Rotation `optical_from_board`, and position.
_Start = tuple[NDArray[np.float64], NDArray[np.float64]]


@dataclass(frozen=True, slots=True, eq=False)
class Board:
    """A rigid set of markers.

    Attributes:
        name: of the board; `MAP` for a map.
        corners_m: id of a marker → (4, 3) its corners in the board's frame, in the order of `square`. A
            board's frame is x to the right, y up, z out of its face; a map's local NED, or NED from its
            origin.
        sizes_m: side of each marker's black square.
        origin: (latitude, longitude in degrees, altitude above mean sea level in metres) of a map's frame;
            None: local NED.
        print: whose print its markers are, one of `vision.markers.PRINTS`; None: that of the others.
    """

    name: str
    corners_m: Mapping[int, NDArray[np.float64]]
    sizes_m: Mapping[int, float] = field(default_factory=dict)
    origin: tuple[float, float, float] | None = None
    print: str | None = None


@dataclass(frozen=True, slots=True, eq=False)
class BoardPose:
    """Pose of a board relative to the camera. Small and picklable.

    Attributes:
        name: of the board. identifiers: of its markers that were used.
        centre_m: (3,) mean of their corners, in the board's frame; the fit is about this point.
        poses: that fit, the best first: position of `centre_m` in the optical frame, and rotation
            `optical_from_board`.
    """

    name: str
    identifiers: tuple[int, ...]
    centre_m: NDArray[np.float64]
    poses: tuple[MarkerPose, ...]

    @property
    def pose(self) -> MarkerPose:
        """The best one."""
        return self.poses[0]

    @property
    def ambiguous(self) -> bool:
        """Another pose fits about equally well."""
        worse_px = [pose.reprojection_px for pose in self.poses[1:]]
        return bool(worse_px) and self.pose.reprojection_px > AMBIGUOUS * worse_px[0]

    def at_origin(self) -> MarkerPose:
        """The pose of the board's own origin, with its covariance."""
        arm = self.pose.rotation @ self.centre_m
        moved = np.eye(6)
        moved[:3, 3:] = cross_matrix(arm)
        return replace(
            self.pose,
            position_camera_m=self.pose.position_camera_m - arm,
            covariance=moved @ self.pose.covariance @ moved.T,
        )


def cross_matrix(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, 3) matrix whose product with another vector is the cross product `vector` x other."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def locate_board(board: Board, markers: Sequence[Marker], camera: CameraModel) -> BoardPose | None:
    """The pose of a board from its markers in one image; None: none is there, or no pose fits.

    A marker that does not fit with the others (it was moved, or is a false detection) is left out.
    """
    used = [marker for marker in markers if marker.identifier in board.corners_m]
    used.sort(key=lambda marker: marker.side_px, reverse=True)
    fit = _fit(board, used, camera)
    while len(used) > 2 and not _fits(fit, used):
        # Of two that contradict each other, neither is known to be right.
        subsets = [[*used[:index], *used[index + 1 :]] for index in range(len(used))]
        fits = [_fit(board, subset, camera) for subset in subsets]
        best = min(range(len(used)), key=lambda index: _error_px(fits[index]))
        used, fit = subsets[best], fits[best]
    return fit if _fits(fit, used) else None


def _fit(board: Board, used: Sequence[Marker], camera: CameraModel) -> BoardPose | None:
    if not used:
        return None
    model = np.concatenate([board.corners_m[marker.identifier] for marker in used])
    pixels = np.concatenate([marker.corners_px for marker in used])
    centre = model.mean(axis=0)
    starts = [
        _start(marker, pose, board.corners_m[marker.identifier] - centre)
        for marker in used[:_START_MARKERS]
        for pose in marker.poses
    ]
    if len(used) > 1:
        starts = _promising(starts, model - centre, pixels, camera)
    sigma_px = max(marker.corner_sigma_px for marker in used)
    poses = fit_poses(model - centre, pixels, camera, starts, sigma_px)
    if not poses:
        return None
    # A third one fits far worse.
    return BoardPose(board.name, tuple(marker.identifier for marker in used), centre, tuple(poses[:2]))


def _promising(
    starts: Sequence[_Start],
    model: NDArray[np.float64],
    pixels: NDArray[np.float64],
    camera: CameraModel,
) -> list[_Start]:
    """The start with the least error, and the best of those that are turned from it: fits take time."""

    def error_px(start: _Start) -> float:
        error = camera.project(model @ start[0].T + start[1]) - pixels
        return float(np.nan_to_num(np.square(error), nan=1e6).sum())

    best, *others = sorted(starts, key=error_px)
    turned = [other for other in others if np.trace(best[0].T @ other[0]) < _TURNED_TRACE]
    return [best, *turned[:1]]


def _fits(fit: BoardPose | None, used: Sequence[Marker]) -> bool:
    """Whether a pose fits all of these markers."""
    sides_px = [marker.side_px for marker in used]
    return fit is not None and _error_px(fit) <= max(WORST_FIT_PX, WORST_FIT * sum(sides_px) / len(sides_px))


def _error_px(fit: BoardPose | None) -> float:
    return math.inf if fit is None else fit.pose.reprojection_px


def _start(marker: Marker, pose: MarkerPose, corners_m: NDArray[np.float64]) -> _Start:
    """The board's pose that follows from that of one of its markers: (3, 3) rotation, (3,) position."""
    right, up = corners_m[1] - corners_m[0], corners_m[0] - corners_m[3]
    right, up = right / np.linalg.norm(right), up / np.linalg.norm(up)
    rotation = pose.rotation @ np.array([right, up, np.cross(right, up)])
    # The marker's own size was assumed, the board's holds.
    scale = float(np.linalg.norm(corners_m[1] - corners_m[0])) / marker.size_m
    return rotation, scale * pose.position_camera_m - rotation @ corners_m.mean(axis=0)


def ned_from_marker(yaw_rad: float, standing: bool) -> NDArray[np.float64]:
    """(3, 3) attitude of a marker of a map.

    Lying face up, its upper edge is along the yaw; standing, its face is, and the upper edge is up.
    """
    axes = [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]
    if standing:
        axes = [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]
    rotation: NDArray[np.float64] = matrix_from_euler(0.0, 0.0, yaw_rad) @ np.array(axes)
    return rotation
