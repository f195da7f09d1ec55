"""Markers to targets: positions of detected markers and their pads in local NED.

As with detections, attitude and position are those of the capture time (`targets.StateHistory`), so banking
does not displace the marker.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from companion.guidance.objects.from_detections import Pose, StateHistory, mount_at
from companion.guidance.objects.range_error import HEADING_SIGMA_RAD
from companion.guidance.objects.target import RangeSource, Target, marker_name
from companion.guidance.objects.tracked_object import TrackedObject
from companion.vehicle.state import Quaternion, Vector3
from companion.vehicle.vision_position import VisionPosition
from vision.camera_model import CameraModel, CameraMount
from vision.marker_ambiguity import AmbiguityResolver
from vision.marker_boards import BoardPose
from vision.markers import Marker, MarkerPose, PadMarker
from vision.rotation import quaternion_from_matrix

# One sigma of a marker's horizontal position, in addition to its own: mount and clocks, metres; and one
# degree of the vehicle's attitude, times the difference in height.
FIXED_SIGMA_M, TILT_SIGMA_RAD = 0.05, math.radians(1.0)
# A marker is confirmed after so many processed frames in a row, with gaps of at most this.
CONFIRM_FRAMES, CONFIRM_GAP_S = 3, 0.5
# Margin, as a fraction of the image size, by which straight down must be inside the image to land.
DOWN_MARGIN = 0.08


@dataclass(frozen=True, slots=True)
class BodyPose:
    """Pose of a marker or a board in the body frame (FRD) at the capture time.

    Attributes:
        position_m: from the vehicle to its centre, or to a board's origin.
        rotation: (w, x, y, z), `body_from_marker`; x to its right, y to its upper edge, z out of it.
        covariance: upper right triangle, row by row (21 values), of the position, m², and of a small rotation
            about the body's axes, rad²; from the noise of the corners alone.
    """

    position_m: Vector3
    rotation: Quaternion
    covariance: tuple[float, ...]

    @property
    def matrix(self) -> NDArray[np.float64]:
        """(6, 6) the whole covariance."""
        upper = np.zeros((6, 6))
        upper[np.triu_indices(6)] = self.covariance
        return upper + np.triu(upper, 1).T

    @property
    def range_sigma_m(self) -> float:
        """One sigma of the straight distance from the vehicle."""
        line = np.array(self.position_m) / max(float(np.linalg.norm(self.position_m)), 1e-9)
        return math.sqrt(float(line @ self.matrix[:3, :3] @ line))

    @property
    def angle_sigma_rad(self) -> float:
        """One sigma of the rotation about the least certain axis."""
        return math.sqrt(float(np.linalg.eigvalsh(self.matrix[3:, 3:])[-1]))


@dataclass(frozen=True, slots=True)
class BoardTarget:
    """One board that was seen.

    Attributes:
        name: of the board. identifiers: of its markers that were used.
        captured_ns: CLOCK_MONOTONIC stamp of the frame.
        body: pose of the board. position_ned_m: of its origin, local NED.
        reprojection_px: RMS reprojection error of the corners.
        ambiguous: another pose fits about equally well.
    """

    name: str
    identifiers: tuple[int, ...]
    captured_ns: int
    body: BodyPose
    position_ned_m: Vector3
    reprojection_px: float
    ambiguous: bool


@dataclass(frozen=True)
class MarkerTarget:
    """One detected marker.

    Attributes:
        identifier: in its dictionary. pad: id of the pad it lies on, its own unless configured otherwise.
        captured_ns: CLOCK_MONOTONIC stamp of the frame.
        bearing_rad: clockwise from north, -π..π. elevation_rad: above the horizon. Both from the vehicle.
        distance_m: straight from the vehicle. ground_range_m: over ground.
        position_ned_m: of its centre, local NED. pad_ned_m: of its pad's centre.
        pad_offset_frd_m: from the vehicle to the pad's centre, in the body frame at the capture time; of a
            pad that is an object of this frame, to that object.
        heading_rad: direction of its upper edge, clockwise from north.
        size_m, side_px: side length, and the same in the image. reprojection_px: reprojection error.
        range_sigma_m: one sigma of its horizontal range from the vehicle. across_sigma_m: the same across the
            line of sight, horizontal.
        resolved: which of the two poses of a square is the true one is known; else the one nearer to level is
            assumed, as pads are level.
        confirmed: detected in enough frames in a row, at one position, to be flown to.
        located: its pose relative to the camera, the camera's mount and the vehicle's pose, for `body`; None
            in a recording.
    """

    identifier: int
    pad: int
    captured_ns: int
    bearing_rad: float
    elevation_rad: float
    distance_m: float
    ground_range_m: float
    position_ned_m: Vector3
    pad_ned_m: Vector3
    pad_offset_frd_m: Vector3
    heading_rad: float
    size_m: float
    side_px: float
    reprojection_px: float
    range_sigma_m: float
    across_sigma_m: float
    resolved: bool
    confirmed: bool = False
    located: tuple[MarkerPose, CameraMount, Pose] | None = field(
        default=None, repr=False, compare=False, metadata={"recorded": False}
    )

    @cached_property
    def body(self) -> BodyPose:
        """Its pose in the body frame; computed when it is used, as few markers of a frame are."""
        assert self.located is not None
        return _body_pose(*self.located)

    def as_target(self, identifier: int, place: Vector3, vehicle: Vector3, *, trusted: bool) -> Target:
        """The detection of an object at a place that this marker shows. `vehicle`: at the capture."""
        north, east, down = (p - v for p, v in zip(place, vehicle, strict=True))
        range_m = math.hypot(north, east)
        return Target(
            marker_name(identifier),
            1.0,
            self.captured_ns,
            math.atan2(east, north),
            math.atan2(-down, range_m),
            ground_range_m=range_m,
            range_source=RangeSource.MARKER,
            position_ned_m=place,
            track_id=identifier,
            trusted=trusted,
            distance_m=math.hypot(range_m, down),
            range_sigma_m=self.range_sigma_m,
            across_sigma_m=self.across_sigma_m,
        )


def object_detections(targets: Sequence[MarkerTarget], vehicle: Vector3) -> list[Target]:
    """The detections of objects that the markers of one frame are; a surface is a centre.

    A marker that lies on the pad of another one is an object of its own, and shows that pad, whose object has
    the id of the pad and is at its centre. Of several markers on a pad the most exact one says where it is.
    """
    shown: dict[int, list[MarkerTarget]] = {}
    for target in targets:
        shown.setdefault(target.pad, []).append(target)
    seen = []
    for pad, markers in shown.items():
        best = min(markers, key=lambda each: each.range_sigma_m)
        sure = any(each.confirmed for each in markers)
        seen.append(best.as_target(pad, best.pad_ned_m, vehicle, trusted=sure))
    for each in targets:
        if each.identifier not in shown:
            own = each.as_target(each.identifier, each.position_ned_m, vehicle, trusted=each.confirmed)
            seen.append(own)
    return seen


@dataclass(frozen=True, slots=True)
class LocalizedMarkers:
    """The markers of one frame.

    Attributes:
        targets: one per marker, in their order; empty if `error` gives the reason.
        boards: the boards; empty too.
        vision: the vehicle's position from the map, for the autopilot; None: none, or not asked for.
        objects: the camera's markers and pads, as guidance gets them.
        error: why they have no position; empty if they have.
    """

    targets: tuple[MarkerTarget, ...]
    boards: tuple[BoardTarget, ...] = ()
    error: str = ""
    vision: VisionPosition | None = None
    objects: tuple[TrackedObject, ...] = ()


@dataclass(frozen=True, slots=True)
class MarkerSight:
    """The current marker detections.

    Attributes:
        targets: of the newest frame; empty: none, or the frame is too old.
        captured_ns: of that frame; 0: none received.
        age_s: since then; None: none received.
        fresh: that age is within the configured maximum.
        missing: what is missing for using markers; empty: nothing.
        fault: why nothing that a camera shows is used; empty: it is.
    """

    targets: tuple[MarkerTarget, ...] = ()
    captured_ns: int = 0
    age_s: float | None = None
    fresh: bool = False
    missing: str = "marker detection (markers.dictionary is not set)"
    fault: str = ""

    def unavailable(self, gap_s: float) -> str | None:
        """What is missing, in words; None: nothing. A camera may be late by `gap_s`."""
        if self.missing:
            return self.missing
        if self.age_s is None:
            return "marker detections (none received yet)"
        if not self.fresh and self.age_s > gap_s:
            return f"marker detections ({self.fault or f'newest frame {self.age_s:.1f} s old'})"
        return None


NO_MARKERS = MarkerSight()


def marker_targets(
    markers: Sequence[Marker],
    captured_ns: int,
    mount: CameraMount,
    history: StateHistory,
    on_pads: Mapping[int, PadMarker],
    resolver: AmbiguityResolver | None = None,
) -> tuple[MarkerTarget, ...]:
    """The marker targets of one frame, in order.

    Args:
        on_pads: markers that lie on another marker's pad, by their own id.
        resolver: of this camera, which remembers earlier frames; None: one frame decides.

    Raises:
        HistoryError: the pose of the vehicle or its gimbal at `captured_ns` is unknown.
    """
    if not markers:
        return ()
    pose, mount = history.at(captured_ns), mount_at(mount, history, captured_ns)
    resolver = resolver or AmbiguityResolver()
    return tuple(_target(marker, captured_ns, mount, pose, on_pads, resolver) for marker in markers)


def board_targets(
    boards: Sequence[BoardPose], captured_ns: int, mount: CameraMount, history: StateHistory
) -> tuple[BoardTarget, ...]:
    """The boards of one frame. Raises HistoryError as `marker_targets`."""
    if not boards:
        return ()
    pose, mount = history.at(captured_ns), mount_at(mount, history, captured_ns)
    ned_from_optical = mount.ned_from_optical(pose.ned_from_body)
    lens = pose.ned_from_body @ mount.position_frd_m + pose.position_ned_m
    return tuple(
        BoardTarget(
            board.name,
            board.identifiers,
            captured_ns,
            _body_pose(origin, mount, pose),
            _vector(lens + ned_from_optical @ origin.position_camera_m),
            origin.reprojection_px,
            board.ambiguous,
        )
        for board in boards
        for origin in (board.at_origin(),)
    )


def looks_down(camera: CameraModel, mount: CameraMount) -> bool:
    """Whether straight down, with the vehicle level, is inside the image by `DOWN_MARGIN`.

    For a camera on a gimbal pass its mount at a time (`mount_at`).
    """
    below = mount.ned_from_optical(np.eye(3)).T @ np.array([0.0, 0.0, 1.0])
    column, row = camera.project(below.reshape(1, 3))[0]
    wide, high = camera.width * DOWN_MARGIN, camera.height * DOWN_MARGIN
    # NaN (behind the camera) fails both comparisons.
    return bool(wide <= column <= camera.width - wide and high <= row <= camera.height - high)


def _target(
    marker: Marker,
    captured_ns: int,
    mount: CameraMount,
    pose: Pose,
    on_pads: Mapping[int, PadMarker],
    resolver: AmbiguityResolver,
) -> MarkerTarget:
    ned_from_optical = mount.ned_from_optical(pose.ned_from_body)
    resolved = resolver.resolve(marker, captured_ns, ned_from_optical)
    # Else the pose whose face points up more: NED, so up is -z.
    fit = resolved or min(marker.poses, key=lambda fit: (ned_from_optical @ fit.rotation)[2, 2])
    position, rotation = fit.position_camera_m, fit.rotation
    offset = ned_from_optical @ position + pose.ned_from_body @ mount.position_frd_m
    heading_rad = _heading(ned_from_optical @ rotation)
    on_pad = on_pads.get(marker.identifier)
    pad_offset = offset
    if on_pad is not None:
        upper = np.array([math.cos(heading_rad), math.sin(heading_rad), 0.0])
        right = np.array([-upper[1], upper[0], 0.0])
        pad_offset = offset - right * on_pad.right_m - upper * on_pad.up_m
    origin = np.array(pose.position_ned_m)
    ground_range_m = math.hypot(offset[0], offset[1])
    line = position / np.linalg.norm(position)
    own_sigma_m = math.sqrt(float(line @ fit.covariance[:3, :3] @ line))
    common_sigma_m = math.hypot(FIXED_SIGMA_M, TILT_SIGMA_RAD * abs(float(offset[2])))
    return MarkerTarget(
        identifier=marker.identifier,
        pad=marker.identifier if on_pad is None else on_pad.pad,
        captured_ns=captured_ns,
        bearing_rad=math.atan2(offset[1], offset[0]),
        elevation_rad=math.atan2(-offset[2], ground_range_m),
        distance_m=float(np.linalg.norm(offset)),
        ground_range_m=ground_range_m,
        position_ned_m=_vector(origin + offset),
        pad_ned_m=_vector(origin + pad_offset),
        pad_offset_frd_m=_vector(pose.ned_from_body.T @ pad_offset),
        heading_rad=heading_rad,
        size_m=marker.size_m,
        side_px=marker.side_px,
        reprojection_px=marker.reprojection_px,
        range_sigma_m=math.hypot(common_sigma_m, own_sigma_m),
        across_sigma_m=math.hypot(common_sigma_m, HEADING_SIGMA_RAD * ground_range_m),
        resolved=resolved is not None,
        located=(fit, mount, pose),
    )


def _body_pose(fit: MarkerPose, mount: CameraMount, pose: Pose) -> BodyPose:
    body_from_optical = pose.ned_from_body.T @ mount.ned_from_optical(pose.ned_from_body)
    both = np.kron(np.eye(2), body_from_optical)
    covariance = both @ fit.covariance @ both.T
    return BodyPose(
        _vector(body_from_optical @ fit.position_camera_m + mount.position_frd_m),
        quaternion_from_matrix(body_from_optical @ fit.rotation),
        tuple(covariance[np.triu_indices(6)].tolist()),
    )


def _heading(ned_from_marker: NDArray[np.float64]) -> float:
    """Heading of the upper edge, from both axes of the print, so that an apparent tilt does not rotate it."""
    right, upper = ned_from_marker[:2, 0], ned_from_marker[:2, 1]
    return math.atan2(upper[1] - right[0], upper[0] + right[1])


def _vector(values: NDArray[np.float64]) -> Vector3:
    return (float(values[0]), float(values[1]), float(values[2]))
