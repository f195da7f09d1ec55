"""Detections to targets: boxes in an image become directions and positions in local NED.

A frame is some tens of milliseconds old when its detections arrive, and the vehicle has turned since: the
attitude and position of the capture time are used, interpolated from a short history.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import takewhile
from types import MappingProxyType
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from companion.guidance.objects.range_error import (
    UNSTATED_POSITION_SIGMA_M,
    BoxError,
    PoseError,
    across_sigma_m,
    depth_sigma_m,
    depth_sigmas_m,
    edge_sigma_px,
    ground_sigmas_m,
    height_sigma_m,
    size_sigmas_m,
)
from companion.guidance.objects.target import RangeSource, Target
from companion.vehicle.gimbal import YawFrame
from companion.vehicle.state import Quaternion, Vector3, VehicleState
from vision.attitude import slerp, turned_about_down
from vision.camera_model import CameraModel, CameraMount
from vision.class_names import fold_name
from vision.detections import TRACK_CONFIRMED, DetectionRecord
from vision.geolocation import PixelRays, range_from_known_height
from vision.rotation import matrix_from_quaternion
from vision.tracking import TARGET_CLASS
from vision.tracking.association import SAME_OBJECT_IOU, overlaps

_Sample = TypeVar("_Sample")

HISTORY_S = 3.0
# The nearest sample is used up to this far beyond the history; a quadrotor turns 10° in this time.
MAX_OUTSIDE_S = 0.2
# Within this many pixels a box touches the image edge; at the lower edge its ground contact is hidden. Within
# so many sigma of a detected edge the object may be cut off.
EDGE_PX, CUT_SIGMAS = 2.0, 3.0
# One degree of attitude error at this depression is half the range.
MIN_DEPRESSION_RAD = math.radians(2.0)
# Below this height the ground plane gives no range.
MIN_HEIGHT_M = 0.3
# Minimum box height for a range from a known height: one pixel is a twelfth of it.
LEAST_HEIGHT_PX = 12.0
# The lowest visible part of an object is its wheels, feet or underside; its nearest surface is this much
# nearer: median over all classes in benchmarks/range_error.py, on seeds other than the published ones.
CONTACT_INSET_M = 0.2
# Where the object touches the lower edge of its box in a rolled image: this fraction of the offset at which a
# rectangle would. 95 % of errors, rendered frames, up to 20° of roll: 1.20 m with 0.25, 1.23 with 0, 1.49
# with 0.5. Of synthetic approaches (to boxes) in wind, fewer arrive with 0.
CONTACT_SHARE = 0.25
# Beyond this roll it is not corrected.
MAX_CONTACT_ROLL_RAD = math.radians(30.0)
# A class is unambiguous if its score exceeds that of every other class of the object by this.
CLEAR_MARGIN = 0.1


class HistoryError(LookupError):
    """The history does not cover the requested time. The message says by how much."""


class Pose(NamedTuple):
    """The vehicle's pose at a time.

    Attributes:
        ned_from_body: (3, 3) float64 rotation from body FRD to NED.
        position_ned_m: local NED, metres.
        height_m: above flat ground: by a range finder if there is one, else above home.
        error: one sigma of all of it.
    """

    ned_from_body: NDArray[np.float64]
    position_ned_m: Vector3
    height_m: float
    error: PoseError


@dataclass(frozen=True, slots=True)
class HistorySamples:
    """Samples of a `StateHistory`, oldest first, each after its stamp (CLOCK_MONOTONIC ns).

    Attributes:
        positions: local NED, height, and one sigma of height and of the horizontal position; metres.
    """

    attitudes: tuple[tuple[int, Quaternion], ...] = ()
    positions: tuple[tuple[int, tuple[float, ...]], ...] = ()
    gimbal: tuple[tuple[int, tuple[Quaternion, YawFrame]], ...] = ()


class StateHistory:
    """Attitudes and positions of the last few seconds, each with its own stamp (CLOCK_MONOTONIC ns).

    Also the gimbal's attitudes, each with the reference of its yaw.
    """

    def __init__(self, duration_s: float = HISTORY_S) -> None:
        self._duration_ns = round(duration_s * 1e9)
        self._taken_ns = [0, 0, 0]
        self._attitudes: deque[tuple[int, Quaternion]] = deque()
        self._positions: deque[tuple[int, tuple[float, ...]]] = deque()
        self._gimbal: deque[tuple[int, tuple[Quaternion, YawFrame]]] = deque()

    def add(self, state: VehicleState) -> None:
        """Add the new samples of a snapshot; older or repeated stamps are ignored."""
        if state.attitude is not None:
            self._append(self._attitudes, state.attitude_ns, state.attitude)
        position, height_m, gimbal = state.position_ned_m, state.height_m, state.gimbal
        if position is not None and height_m is not None:
            sigma_m = height_sigma_m(state.height_source, height_m, state.vertical_sigma_m)
            sigma_m = max(sigma_m, state.height_disagreement_m)
            error_m = (sigma_m, state.horizontal_sigma_m or UNSTATED_POSITION_SIGMA_M)
            self._append(self._positions, state.position_ns, (*position, height_m, *error_m))
        if gimbal is not None and gimbal.attitude is not None:
            self._append(self._gimbal, gimbal.attitude_ns, (gimbal.attitude, gimbal.yaw_frame))

    def discard(self) -> None:
        """The clock of the stamps stood still: between the last sample and the next one anything happened."""
        for samples in (self._attitudes, self._positions, self._gimbal):
            samples.clear()

    def take_new(self) -> HistorySamples:
        """Return the samples added since the last call, for one caller: a recording."""
        return HistorySamples(
            self._taken(0, self._attitudes), self._taken(1, self._positions), self._taken(2, self._gimbal)
        )

    def extend(self, samples: HistorySamples) -> None:
        """Add samples of another history, newer than those here."""
        for stamp_ns, attitude in samples.attitudes:
            self._append(self._attitudes, stamp_ns, attitude)
        for stamp_ns, position in samples.positions:
            self._append(self._positions, stamp_ns, position)
        for stamp_ns, gimbal in samples.gimbal:
            self._append(self._gimbal, stamp_ns, gimbal)

    def at(self, stamp_ns: int) -> Pose:
        """The pose at a time: attitude by slerp, position by linear interpolation.

        Raises:
            HistoryError: no samples yet, or the time lies outside by more than `MAX_OUTSIDE_S`.
        """
        ned_from_body = self._ned_from_body(stamp_ns)
        before, after, fraction = _around(self._positions, stamp_ns, "position of the vehicle")
        north, east, down, height, *error_m = (
            a + (b - a) * fraction for a, b in zip(before, after, strict=True)
        )
        return Pose(ned_from_body, (north, east, down), height, PoseError(*error_m))

    def gimbal_at(self, stamp_ns: int) -> Quaternion:
        """Quaternion (w, x, y, z) from the gimbal's frame (FRD) to NED at a time, by slerp.

        A yaw relative to the vehicle is rotated by the vehicle's heading of the same time.

        Raises:
            HistoryError: as `at`, for the gimbal's attitude or, for a relative yaw, the vehicle's.
        """
        first, second, fraction = _around(self._gimbal, stamp_ns, "attitude of the gimbal")
        if first[1] is not second[1]:
            # The yaw reference changed between the two: do not interpolate.
            first = second = first if fraction < 0.5 else second
        turned = slerp(first[0], second[0], fraction)
        if first[1] is YawFrame.NORTH:
            return turned
        nose = self._ned_from_body(stamp_ns)[:, 0]
        return turned_about_down(math.atan2(float(nose[1]), float(nose[0])), turned)

    def _ned_from_body(self, stamp_ns: int) -> NDArray[np.float64]:
        first, second, fraction = _around(self._attitudes, stamp_ns, "attitude of the vehicle")
        return matrix_from_quaternion(slerp(first, second, fraction))

    def _append(self, samples: deque[tuple[int, _Sample]], stamp_ns: int, sample: _Sample) -> None:
        if samples and stamp_ns <= samples[-1][0]:
            return
        samples.append((stamp_ns, sample))
        while samples[0][0] < stamp_ns - self._duration_ns:
            samples.popleft()

    def _taken(self, kind: int, samples: deque[tuple[int, _Sample]]) -> tuple[tuple[int, _Sample], ...]:
        """The samples newer than the last that was taken, which are few."""
        newer = list(takewhile(lambda sample: sample[0] > self._taken_ns[kind], reversed(samples)))
        self._taken_ns[kind] = newer[0][0] if newer else self._taken_ns[kind]
        return tuple(reversed(newer))


def mount_at(mount: CameraMount, history: StateHistory, stamp_ns: int) -> CameraMount:
    """The camera's mount at a time; on a gimbal, with the gimbal's attitude of that time.

    Raises:
        HistoryError: the gimbal's attitude at that time is unknown.
    """
    if not mount.on_gimbal:
        return mount
    return mount.held(matrix_from_quaternion(history.gimbal_at(stamp_ns)))


def targets_from_detections(
    detections: Sequence[DetectionRecord],
    captured_ns: int,
    camera: CameraModel,
    mount: CameraMount,
    history: StateHistory,
    heights_m: Mapping[str, float] = MappingProxyType({}),
) -> tuple[Target, ...]:
    """The targets of one frame, in the order of its detections. Boxes where the lens has no rays have none.

    The range comes from the detection's nearest point if it has one (`nearest_camera_m`, from depth), and the
    direction from the middle between the object's ends (`middle_px`). Else the direction is that of the box,
    and the range is that of the ground at the ray through its lower edge, less `CONTACT_INSET_M`. The
    ground is assumed flat, at the level below the vehicle (`VehicleState.ground`) or else of home. That gives
    no range if the box touches the image's lower edge, or the ray points less than 2° down; then the class's
    height in `heights_m` (by `fold_name`) is used, if the box is not cut off at its top or bottom.

    A detection that has a similar score as another class is not `trusted`: a car that may be a truck is not
    flown to.

    Raises:
        HistoryError: the pose of the vehicle or its gimbal at `captured_ns` is unknown.
    """
    pose, mount = history.at(captured_ns), mount_at(mount, history, captured_ns)
    if not detections:
        return ()
    sights = _sights(detections, camera, mount, pose)
    ambiguous = _ambiguous(detections)
    return tuple(
        _target(
            detection,
            sight,
            captured_ns,
            camera,
            mount,
            pose,
            height_m=heights_m.get(fold_name(detection["class_name"])),
            trusted=not doubtful,
        )
        for detection, sight, doubtful in zip(detections, sights, ambiguous, strict=True)
        if all(map(math.isfinite, sight.direction))
    )


class _Sight(NamedTuple):
    """The geometry of one box: NED vectors from the vehicle, offsets in metres; NaN: unknown.

    Attributes:
        direction: unit vector to the object's middle, or the box's centre; NaN where the lens has no rays.
        nearest: to the nearest point of its surface, by depth.
        on_ground: to the intersection of the middle of its lower edge with the ground.
        lens: to the optical centre.
        pixel_rad: depression of one row at the lower edge, radians.
        column_slope: how much the range of the ground changes from column to column there, per metre of drop.
    """

    direction: list[float]
    nearest: list[float]
    on_ground: list[float]
    lens: list[float]
    pixel_rad: float
    column_slope: float


def _sights(
    detections: Sequence[DetectionRecord], camera: CameraModel, mount: CameraMount, pose: Pose
) -> list[_Sight]:
    """The geometry of all boxes, vectorized: it runs between a frame's arrival and the next setpoint."""
    count = len(detections)
    # From pixel edges to pixel centres, through which rays go.
    left, top, right, bottom = np.array([detection["xyxy"] for detection in detections]).T - 0.5
    unknown = [math.nan] * 3
    nearest = np.array([detection["nearest_camera_m"] or unknown for detection in detections], np.float64)
    pixels = np.empty((4 * count, 2))
    centre = (left + right) / 2
    middle = np.array([each.get("middle_px", math.nan) for each in detections], np.float64) - 0.5
    middle = np.where(np.isfinite(middle), middle, centre)
    contact = centre + _contact_px(right - left, bottom - top, _roll_rad(mount, pose))
    pixels[:, 0] = np.concatenate([middle, contact, contact, contact + 1.0])
    pixels[:, 1] = np.concatenate([(top + bottom) / 2, bottom, bottom + 1.0, bottom])
    lines = PixelRays.of(camera, mount, pose.ned_from_body, pixels)
    centres, feet, below = lines[:count], lines[count : 2 * count], lines[2 * count : 3 * count]
    on_ground = feet.on_ground(pose.height_m, MIN_DEPRESSION_RAD)
    # Between two rays one row apart; the angle is too small for the arc cosine of their product.
    pixel_rad = np.linalg.norm(below.directions - feet.directions, axis=1)
    pixel_rad = np.where(np.isfinite(pixel_rad), pixel_rad, 1.0 / camera.fy)  # the lower edge has no rays
    column_slope = np.abs(np.subtract(*(_cotangents(each) for each in (feet, lines[3 * count :]))))
    offsets = lines.camera_ned_m + nearest @ mount.ned_from_optical(pose.ned_from_body).T
    lens = lines.camera_ned_m.tolist()
    of_each = (centres.directions, offsets, on_ground, pixel_rad, column_slope)
    geometry = zip(*(values.tolist() for values in of_each), strict=True)
    return [
        _Sight(towards, nearest_ned_m, ground_ned_m, lens, row_rad, slope)
        for towards, nearest_ned_m, ground_ned_m, row_rad, slope in geometry
    ]


def _cotangents(lines: PixelRays) -> NDArray[np.float64]:
    """(N,) horizontal range of each ray for each metre that it goes down; NaN: it does not."""
    north, east, down = lines.directions.T
    ranges: NDArray[np.float64] = np.hypot(north, east) / np.where(down > 0.0, down, np.nan)
    return ranges


def _contact_px(
    width: NDArray[np.float64], height: NDArray[np.float64], roll_rad: float
) -> NDArray[np.float64]:
    """Offset of each object's ground contact from the middle of its box's lower edge, pixels to the right.

    In a rolled image an upright rectangle touches the edge with its lower corner, a rounder shape nearer to
    the middle.
    """
    if abs(roll_rad) > MAX_CONTACT_ROLL_RAD:
        return np.zeros(len(width))
    sine, cosine = math.sin(abs(roll_rad)), math.cos(roll_rad)
    # Height of the rectangle whose outline, rotated by the roll, has the box's width and height.
    upright = np.clip((height * cosine - width * sine) / (cosine**2 - sine**2), 0.0, height)
    to_corner = np.minimum(upright * sine - width / 2, 0.0)
    return CONTACT_SHARE * math.copysign(1.0, roll_rad) * to_corner


def _roll_rad(mount: CameraMount, pose: Pose) -> float:
    """Angle between the image's rows and the horizontal; 0 for a camera that looks straight down."""
    down = mount.ned_from_optical(pose.ned_from_body)[2]
    return math.asin(max(-1.0, min(1.0, float(down[0]))))


def _ambiguous(detections: Sequence[DetectionRecord]) -> list[bool]:
    """For each: whether a box of another class with a similar score covers the same object."""
    if len({detection["class_name"] for detection in detections}) < 2:
        return [False] * len(detections)
    boxes = np.array([detection["xyxy"] for detection in detections])
    scores = np.array([_score(detection) for detection in detections])
    names = np.array([detection["class_name"] for detection in detections])
    selected = names == TARGET_CLASS  # selected by a person: no class that the detector could confuse
    rivals = (
        (names[:, None] != names) & ~selected[:, None] & ~selected & (scores[:, None] < scores + CLEAR_MARGIN)
    )
    doubtful: list[bool] = (rivals & (overlaps(boxes, boxes) >= SAME_OBJECT_IOU)).any(axis=1).tolist()
    return doubtful


def _score(detection: DetectionRecord) -> float:
    score = detection.get("track_score")
    return detection["confidence"] if score is None else score


def _target(
    detection: DetectionRecord,
    sight: _Sight,
    captured_ns: int,
    camera: CameraModel,
    mount: CameraMount,
    pose: Pose,
    *,
    height_m: float | None,
    trusted: bool,
) -> Target:
    left, top, right, bottom = detection["xyxy"]
    direction = sight.direction
    source, offset, sigmas_m = RangeSource.NONE, [math.nan] * 3, (math.nan, math.nan)
    whole_below = bottom < camera.height - 1 - EDGE_PX
    box = BoxError(
        sight.pixel_rad,
        sight.column_slope,
        right - left,
        bottom - top,
        camera.width,
        _roll_rad(mount, pose),
        _cut(detection["xyxy"], camera),
    )
    if all(map(math.isfinite, sight.nearest)):
        source = RangeSource.DEPTH
        offset = _towards(sight.lens, direction, sight.nearest)
        depth_m = detection["nearest_camera_m"][2] if detection["nearest_camera_m"] else math.nan
        sigmas_m = depth_sigmas_m(*_range_and_drop(offset, sight.lens), depth_m, box, pose.error)
    elif whole_below and pose.height_m > MIN_HEIGHT_M and math.isfinite(sight.on_ground[0]):
        source = RangeSource.GROUND_PLANE
        offset = _nearer(sight.lens, sight.direction, sight.on_ground, CONTACT_INSET_M)
        sigmas_m = ground_sigmas_m(*_range_and_drop(sight.on_ground, sight.lens), box, pose.error)
    elif height_m is not None and _measurable(camera, top, bottom):
        offset = range_from_known_height(
            camera, mount, pose.ned_from_body, detection["xyxy"], height_m
        ).tolist()
        if all(map(math.isfinite, offset)):
            source = RangeSource.KNOWN_HEIGHT
            sigmas_m = size_sigmas_m(*_range_and_drop(offset, sight.lens), height_m, box, pose.error)
    known = source is not RangeSource.NONE
    north, east, down = (origin + away for origin, away in zip(pose.position_ned_m, offset, strict=True))
    return Target(
        class_name=detection["class_name"],
        confidence=detection["confidence"],
        captured_ns=captured_ns,
        bearing_rad=math.atan2(direction[1], direction[0]),
        elevation_rad=math.asin(max(-1.0, min(1.0, -direction[2]))),
        ground_range_m=math.hypot(offset[0], offset[1]) if known else math.nan,
        range_source=source,
        position_ned_m=(north, east, down) if known else None,
        box_xyxy=(left, top, right, bottom),
        track_id=detection.get("track_id"),
        track_score=detection.get("track_score"),
        trusted=trusted and detection.get("track_state") in (None, TRACK_CONFIRMED),
        depth_m=math.nan if detection["depth_m"] is None else detection["depth_m"],
        depth_sigma_m=math.nan if detection["depth_m"] is None else depth_sigma_m(detection["depth_m"], box),
        distance_m=math.hypot(*offset),
        distance_sigma_m=sigmas_m[1],
        cut=box.cut,
        cut_above=top <= _edge_margin_px(detection["xyxy"], camera),
        range_sigma_m=sigmas_m[0],
        across_sigma_m=across_sigma_m(*_range_and_drop(offset, sight.lens), box, pose.error),
        vehicle_sigma_m=pose.error.horizontal_m,
    )


def _cut(xyxy: Sequence[float], camera: CameraModel) -> bool:
    """Whether the left, right or lower edge of the image may cut an object off, by its box."""
    left, _, right, bottom = xyxy
    return min(left, camera.width - right, camera.height - bottom) <= _edge_margin_px(xyxy, camera)


def _edge_margin_px(xyxy: Sequence[float], camera: CameraModel) -> float:
    """Largest distance from an edge of the image, pixels, at which it may cut the object off."""
    return max(EDGE_PX, CUT_SIGMAS * edge_sigma_px(xyxy[3] - xyxy[1], camera.width))


def _range_and_drop(offset: list[float], lens: list[float]) -> tuple[float, float]:
    """Horizontal range from the lens to a point, and how much lower the point is."""
    return math.hypot(offset[0] - lens[0], offset[1] - lens[1]), offset[2] - lens[2]


def _towards(lens: list[float], direction: list[float], nearest: list[float]) -> list[float]:
    """The offset in a direction from the lens, with the horizontal range and the height of `nearest`."""
    range_m = math.hypot(nearest[0] - lens[0], nearest[1] - lens[1])
    scale = range_m / max(math.hypot(direction[0], direction[1]), 1e-9)
    return [lens[0] + direction[0] * scale, lens[1] + direction[1] * scale, nearest[2]]


def _nearer(lens: list[float], direction: list[float], foot: list[float], by_m: float) -> list[float]:
    """The offset in a direction from the lens, with the range of `foot` less `by_m`, and its height."""
    level = max(math.hypot(direction[0], direction[1]), 1e-9)
    north, east = direction[0] / level, direction[1] / level
    range_m = (foot[0] - lens[0]) * north + (foot[1] - lens[1]) * east
    range_m = max(range_m - by_m, 0.0)
    return [lens[0] + north * range_m, lens[1] + east * range_m, foot[2]]


def _measurable(camera: CameraModel, top: float, bottom: float) -> bool:
    """Whether a box is tall enough and not cut off by the image's upper or lower edge."""
    return top > EDGE_PX and bottom < camera.height - 1 - EDGE_PX and bottom - top >= LEAST_HEIGHT_PX


def _around(samples: deque[tuple[int, _Sample]], stamp_ns: int, what: str) -> tuple[_Sample, _Sample, float]:
    """The samples before and after a time, and its fraction between them; beyond the ends the nearest."""
    if not samples:
        raise HistoryError(f"no {what} received yet")
    outside_s = max(samples[0][0] - stamp_ns, stamp_ns - samples[-1][0]) / 1e9
    if outside_s > MAX_OUTSIDE_S:
        side = "older than the oldest" if stamp_ns < samples[0][0] else "newer than the newest"
        raise HistoryError(f"the frame is {outside_s:.2f} s {side} {what}, allowed: {MAX_OUTSIDE_S:g} s")
    index = bisect_right(samples, stamp_ns, key=lambda sample: sample[0])
    if index == 0:
        return samples[0][1], samples[0][1], 0.0
    if index == len(samples):
        return samples[-1][1], samples[-1][1], 0.0
    (before_ns, before), (after_ns, after) = samples[index - 1], samples[index]
    return before, after, (stamp_ns - before_ns) / (after_ns - before_ns)
