"""The vehicle's position from a map of markers.

The fit of the map's markers gives the camera's pose with its covariance. Tilt and position are strongly
correlated in it, and of a single marker seen face on the tilt is nearly unknown; the autopilot knows its tilt
well. So that tilt is fused (a Kalman update), and of two poses that fit, the one nearer to it is used. The
heading is the map's alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.guidance.objects.from_detections import Pose, StateHistory, mount_at
from companion.vehicle.global_position import Anchor
from companion.vehicle.state import Vector3, VehicleState
from companion.vehicle.vision_position import VisionPosition
from vision.attitude import euler_from_quaternion, wrap_angle
from vision.camera_model import CameraMount
from vision.marker_boards import BoardPose, cross_matrix
from vision.markers import MarkerPose
from vision.rotation import quaternion_from_matrix

# One sigma of the autopilot's tilt and of the camera's mount.
TILT_SIGMA_RAD = np.radians(1.0)
# A pose whose tilt differs from the autopilot's by more is wrong.
FARTHEST_TILT_RAD = np.radians(15.0)
# A position that the vehicle cannot have reached since the last one is sent only after positions have agreed
# for this long, with gaps of at most this. No multirotor above markers is faster.
FASTEST_MPS, AGREED_S, AGREED_GAP_S = 15.0, 1.0, 0.5
# A position may be this far from the autopilot's own, horizontally: three sigma of both, the usual error of
# GNSS and of a surveyed map, and the drift since they agreed last, of an estimate that has no other aid.
ESTIMATE_SIGMAS, ESTIMATE_MARGIN_M = 3.0, 3.0
DRIFT_MPS, MAX_DRIFT_M = 0.3, 10.0
# A compass among steel is off by less.
FARTHEST_HEADING_RAD = np.radians(60.0)
# From here on a difference is that of a print turned by 180 degrees.
TURNED_RAD = np.radians(150.0)


@dataclass(frozen=True, slots=True)
class Contradiction:
    """The difference of a position from the autopilot's own, where that is too large.

    Attributes:
        distance_m, allowed_m: horizontally. heading_rad: of the map's heading, -π..π.
    """

    distance_m: float
    allowed_m: float
    heading_rad: float


class VisionGate:
    """Drops positions that contradict the autopilot, or that the vehicle cannot have reached.

    Attributes:
        dropped: number of positions dropped so far.
    """

    def __init__(self) -> None:
        self.dropped = 0
        self._sent: VisionPosition | None = None
        # The newest dropped one, and since when those agree with each other.
        self._other: VisionPosition | None = None
        self._since_ns = 0

    def contradiction(
        self, vision: VisionPosition, pose: Pose, offset_ned_m: Vector3
    ) -> Contradiction | None:
        """Compare with the autopilot's estimate at the capture, which is valid. None: it agrees.

        Args:
            offset_ned_m: of the estimate's resets, `VehicleState.reset_offset_ned_m`.
        """
        north, east, _ = np.array(vision.position_ned_m) - pose.position_ned_m - offset_ned_m
        nose = pose.ned_from_body[:, 0]
        heading_rad = wrap_angle(vision.euler_rad[2] - math.atan2(float(nose[1]), float(nose[0])))
        variance = vision.covariance[0] + vision.covariance[6] + 2.0 * pose.error.horizontal_m**2
        drift_m = MAX_DRIFT_M
        if self._sent is not None:
            since_s = abs(vision.captured_ns - self._sent.captured_ns) / 1e9
            drift_m = min(DRIFT_MPS * since_s, MAX_DRIFT_M)
        allowed_m = ESTIMATE_MARGIN_M + drift_m + ESTIMATE_SIGMAS * math.sqrt(variance)
        distance_m = math.hypot(north, east)
        if distance_m <= allowed_m and abs(heading_rad) <= FARTHEST_HEADING_RAD:
            return None
        self.dropped += 1
        return Contradiction(distance_m, allowed_m, heading_rad)

    def check(self, vision: VisionPosition) -> float | None:
        """None: send it. Else it is dropped, and this is its distance from the last one sent, metres."""
        if self._sent is not None and not _reachable(self._sent, vision):
            other = self._other
            gap_s = 0.0 if other is None else (vision.captured_ns - other.captured_ns) / 1e9
            if other is None or gap_s > AGREED_GAP_S or not _reachable(other, vision):
                self._since_ns = vision.captured_ns
            self._other = vision
            if vision.captured_ns - self._since_ns < AGREED_S * 1e9:
                self.dropped += 1
                return math.dist(self._sent.position_ned_m, vision.position_ned_m)
        self._sent, self._other = vision, None
        return None


def _reachable(one: VisionPosition, other: VisionPosition) -> bool:
    """Whether the vehicle can have flown from one position to the other in the time between them."""
    # Places 0, 6 and 11 are the variances of north, east and down.
    variance = sum(vision.covariance[index] for vision in (one, other) for index in (0, 6, 11))
    allowed_m = FASTEST_MPS * abs(other.captured_ns - one.captured_ns) / 1e9 + 3.0 * math.sqrt(variance)
    return math.dist(one.position_ned_m, other.position_ned_m) <= allowed_m


def map_origin_ned_m(origin: tuple[float, float, float] | None, state: VehicleState) -> Vector3 | None:
    """The origin of a map in the autopilot's local NED; None: its position on the earth is not known.

    Args:
        origin: latitude, longitude in degrees, altitude above mean sea level; None: that of local NED.
    """
    if origin is None:
        return (0.0, 0.0, 0.0)
    if (anchor := Anchor.newest(state)) is None:
        return None
    place = anchor.local(*origin)
    north, east, down = (own + offset for own, offset in zip(place, state.reset_offset_ned_m, strict=True))
    return (north, east, down)


def position_from_map(
    board: BoardPose, captured_ns: int, mount: CameraMount, history: StateHistory, origin_ned_m: Vector3
) -> VisionPosition | None:
    """The vehicle's pose from the pose of a map; None: none agrees with the autopilot's tilt.

    Raises:
        HistoryError: the pose of the vehicle or its gimbal at `captured_ns` is unknown.
    """
    ned_from_body = history.at(captured_ns).ned_from_body
    mount = mount_at(mount, history, captured_ns)
    ned_from_optical = mount.ned_from_optical(ned_from_body)
    down_optical = ned_from_optical[2]
    fit = min(board.poses, key=lambda pose: _tilt_rad(pose, down_optical))
    if _tilt_rad(fit, down_optical) > FARTHEST_TILT_RAD:
        return None
    centre, rotation, covariance = _with_tilt(fit, down_optical)
    map_from_optical = rotation.T
    # Derivatives of the camera's position, and of a rotation about the map's axes, by the fit's errors.
    jacobian = np.zeros((6, 6))
    jacobian[:3, :3] = -map_from_optical
    jacobian[:3, 3:] = -map_from_optical @ cross_matrix(centre)
    jacobian[3:, 3:] = -map_from_optical
    body_from_optical = ned_from_body.T @ ned_from_optical
    attitude = map_from_optical @ body_from_optical.T
    position = board.centre_m - map_from_optical @ centre - attitude @ mount.position_frd_m + origin_ned_m
    spread = jacobian @ covariance @ jacobian.T
    return VisionPosition(
        captured_ns,
        (float(position[0]), float(position[1]), float(position[2])),
        euler_from_quaternion(quaternion_from_matrix(attitude)),
        tuple(spread[np.triu_indices(6)].tolist()),
    )


def tilt_error_rad(board: BoardPose, captured_ns: int, mount: CameraMount, history: StateHistory) -> float:
    """Angle between a map's down and the autopilot's, of the pose that agrees best.

    Raises:
        HistoryError: as `position_from_map`.
    """
    mount = mount_at(mount, history, captured_ns)
    down_optical = mount.ned_from_optical(history.at(captured_ns).ned_from_body)[2]
    return min(_tilt_rad(pose, down_optical) for pose in board.poses)


def _tilt_rad(pose: MarkerPose, down_optical: NDArray[np.float64]) -> float:
    """Angle between a map's down and the autopilot's."""
    return float(np.arccos(np.clip(pose.rotation[:, 2] @ down_optical, -1.0, 1.0)))


def _with_tilt(
    pose: MarkerPose, down_optical: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Position, rotation `optical_from_map` and covariance of a pose after the autopilot's tilt is fused."""
    down = pose.rotation.T @ down_optical
    # A rotation of the map by e turns its down by e x down: the two components that a tilt shows.
    measured = np.array([down[1], -down[0]])
    model = np.zeros((2, 6))
    model[:, 3:] = -pose.rotation.T[:2]
    spread = model @ pose.covariance @ model.T + np.eye(2) * TILT_SIGMA_RAD**2
    gain = np.linalg.solve(spread, model @ pose.covariance).T
    change = gain @ measured
    covariance = (np.eye(6) - gain @ model) @ pose.covariance
    rotation = cv2.Rodrigues(change[3:])[0] @ pose.rotation
    return pose.position_camera_m + change[:3], rotation, (covariance + covariance.T) / 2
