"""From detections to targets: boxes in a picture become directions and places in local NED.

A frame is some tens of milliseconds old when its detections arrive, and the vehicle has turned since: the
attitude and the position used here are those of the moment of capture, interpolated from a short history.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import deque
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from companion.guidance.target import RangeSource, Target
from companion.vehicle.gimbal import YawFrame
from companion.vehicle.state import Quaternion, Vector3, VehicleState
from vision.attitude import slerp, turned_about_down
from vision.camera_model import CameraModel, CameraMount
from vision.detections import TRACK_CONFIRMED, DetectionRecord
from vision.geolocation import Sightlines, foot_of_upright
from vision.rotation import matrix_from_quaternion
from vision.tracking.association import overlaps

_Sample = TypeVar("_Sample")

HISTORY_S = 3.0
# Beyond the ends of the history the nearest sample is taken for this long; a quadrotor turns 10° in it.
MAX_OUTSIDE_S = 0.2
# A box that touches the picture's lower edge (pixels) hides where its object stands.
EDGE_PX = 2.0
# One degree of attitude error at this depression is half the range.
MIN_DEPRESSION_RAD = math.radians(2.0)
# Below this height the ground plane says nothing about range.
MIN_HEIGHT_M = 0.3
# A range from a height needs a box so tall: one pixel more or less is a twelfth of it.
LEAST_HEIGHT_PX = 12.0
# Boxes that overlap by so much are of one thing; those of a rider and the bicycle do not. A name must be
# surer by this than any other it is given.
SAME_THING_IOU, CLEARLY_SURER = 0.7, 0.1


class HistoryError(LookupError):
    """The history does not reach to the asked moment. The message says by how much."""


class Pose(NamedTuple):
    """Where the vehicle was.

    Attributes:
        ned_from_body: (3, 3) float64 rotation from body FRD to NED.
        position_ned_m: local NED, metres.
        height_m: above home; taken as the height above flat ground.
    """

    ned_from_body: NDArray[np.float64]
    position_ned_m: Vector3
    height_m: float


class StateHistory:
    """The attitudes and positions of the last few seconds, each at its own stamp (CLOCK_MONOTONIC ns).

    Of a gimbal the attitudes too, each with what its yaw counts from.
    """

    def __init__(self, duration_s: float = HISTORY_S) -> None:
        self._duration_ns = round(duration_s * 1e9)
        self._attitudes: deque[tuple[int, Quaternion]] = deque()
        self._positions: deque[tuple[int, tuple[float, float, float, float]]] = deque()
        self._gimbal: deque[tuple[int, tuple[Quaternion, YawFrame]]] = deque()

    def add(self, state: VehicleState) -> None:
        """Remember what is new in a snapshot; older or repeated stamps are passed over."""
        if state.attitude is not None and _newer(self._attitudes, state.attitude_ns):
            self._attitudes.append((state.attitude_ns, state.attitude))
            self._forget(self._attitudes)
        position, height_m = state.position_ned_m, state.altitude_m
        if position is not None and height_m is not None and _newer(self._positions, state.position_ns):
            self._positions.append((state.position_ns, (*position, height_m)))
            self._forget(self._positions)
        gimbal = state.gimbal
        if gimbal is not None and gimbal.attitude is not None and _newer(self._gimbal, gimbal.attitude_ns):
            self._gimbal.append((gimbal.attitude_ns, (gimbal.attitude, gimbal.yaw_frame)))
            self._forget(self._gimbal)

    def at(self, stamp_ns: int) -> Pose:
        """The pose at a moment: attitude by slerp, position linearly between the samples around it.

        Raises:
            HistoryError: nothing is known yet, or the moment lies outside by more than `MAX_OUTSIDE_S`.
        """
        ned_from_body = self._ned_from_body(stamp_ns)
        before, after, fraction = _around(self._positions, stamp_ns, "position of the vehicle")
        north, east, down, height = (a + (b - a) * fraction for a, b in zip(before, after, strict=True))
        return Pose(ned_from_body, (north, east, down), height)

    def gimbal_at(self, stamp_ns: int) -> Quaternion:
        """(w, x, y, z), turns the gimbal's frame (FRD) into NED at a moment, by slerp.

        A yaw that the gimbal tells against the nose is turned by the vehicle's heading of that same moment.

        Raises:
            HistoryError: as `at`, of the gimbal's attitude or, where its yaw needs it, of the vehicle's.
        """
        first, second, fraction = _around(self._gimbal, stamp_ns, "attitude of the gimbal")
        if first[1] is not second[1]:
            # What it counts from has changed between the two: nothing lies between them.
            first = second = first if fraction < 0.5 else second
        turned = slerp(first[0], second[0], fraction)
        if first[1] is YawFrame.NORTH:
            return turned
        nose = self._ned_from_body(stamp_ns)[:, 0]
        return turned_about_down(math.atan2(float(nose[1]), float(nose[0])), turned)

    def _ned_from_body(self, stamp_ns: int) -> NDArray[np.float64]:
        first, second, fraction = _around(self._attitudes, stamp_ns, "attitude of the vehicle")
        return matrix_from_quaternion(slerp(first, second, fraction))

    def _forget(self, samples: deque[tuple[int, _Sample]]) -> None:
        oldest_ns = samples[-1][0] - self._duration_ns
        while samples[0][0] < oldest_ns:
            samples.popleft()


def mount_at(mount: CameraMount, history: StateHistory, stamp_ns: int) -> CameraMount:
    """How a camera was mounted at a moment: on a gimbal, as that looked then; else as ever.

    Raises:
        HistoryError: where the gimbal looked then is not known.
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
    """The targets of one frame, in the order of its detections.

    Range comes from the detection's depth where it has one (`range_m`, along the optical axis, at the box's
    centre), else from where the ray through the middle of the box's lower edge meets the ground. The ground
    is taken as flat and level with home. There is no range if the box touches the picture's lower edge, or
    the ray points less than 2° down. Then the class's height in `heights_m` tells it, if the whole object is
    in the picture.

    What the detector also calls something else, (nearly) as surely, is not `trusted`: a car that may be a
    truck is not flown to.

    Raises:
        HistoryError: the vehicle's pose at `captured_ns`, or where its gimbal looked then, is not known.
    """
    pose, mount = history.at(captured_ns), mount_at(mount, history, captured_ns)
    if not detections:
        return ()
    sights = _sights(detections, camera, mount, pose)
    doubtful = _named_otherwise(detections)
    return tuple(
        _target(
            detection,
            sight,
            captured_ns,
            camera,
            mount,
            pose,
            height_m=heights_m.get(detection["class_name"]),
            trusted=not doubt,
        )
        for detection, sight, doubt in zip(detections, sights, doubtful, strict=True)
    )


class _Sight(NamedTuple):
    """What the geometry of one box says: three numbers each, NED, offsets in metres; NaN: it says nothing.

    Attributes:
        direction: unit, to the box's centre.
        at_depth: to what is seen there, by its depth.
        on_ground: to where the middle of its lower edge meets the ground.
    """

    direction: list[float]
    at_depth: list[float]
    on_ground: list[float]


def _sights(
    detections: Sequence[DetectionRecord], camera: CameraModel, mount: CameraMount, pose: Pose
) -> list[_Sight]:
    """Of all boxes at once: a frame's targets are worked out between its arrival and the next setpoint."""
    count = len(detections)
    left, top, right, bottom = np.array([detection["xyxy"] for detection in detections]).T
    depths_m = np.array([detection["range_m"] for detection in detections], np.float64)  # None is NaN
    pixels = np.empty((2 * count, 2))
    pixels[:count, 0] = pixels[count:, 0] = (left + right) / 2
    pixels[:count, 1], pixels[count:, 1] = (top + bottom) / 2, bottom
    lines = Sightlines.of(camera, mount, pose.ned_from_body, pixels)
    centres, feet = lines[:count], lines[count:]
    on_ground = feet.on_ground(pose.height_m, MIN_DEPRESSION_RAD)
    of_each = (centres.directions, centres.at_depth(depths_m), on_ground)
    return [_Sight(*rows) for rows in zip(*(values.tolist() for values in of_each), strict=True)]


def _named_otherwise(detections: Sequence[DetectionRecord]) -> list[bool]:
    """Of each: a box of another class, (nearly) as sure, is about the same thing."""
    if len({detection["class_name"] for detection in detections}) < 2:
        return [False] * len(detections)
    boxes = np.array([detection["xyxy"] for detection in detections])
    scores = np.array([_score(detection) for detection in detections])
    names = np.array([detection["class_name"] for detection in detections])
    rivals = (names[:, None] != names) & (scores[:, None] < scores + CLEARLY_SURER)
    doubtful: list[bool] = (rivals & (overlaps(boxes, boxes) >= SAME_THING_IOU)).any(axis=1).tolist()
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
    source, offset = RangeSource.NONE, [math.nan] * 3
    depth_m = detection["range_m"]
    if depth_m is not None and math.isfinite(depth_m) and depth_m > 0.0:
        source = RangeSource.DEPTH
        offset = sight.at_depth
    elif bottom < camera.height - 1 - EDGE_PX and pose.height_m > MIN_HEIGHT_M:
        offset = sight.on_ground
        if math.isfinite(offset[0]):
            source = RangeSource.GROUND_PLANE
    if source is RangeSource.NONE and height_m is not None and _measurable(camera, top, bottom):
        ends = np.array([[(left + right) / 2, top], [(left + right) / 2, bottom]])
        offset = foot_of_upright(camera, mount, pose.ned_from_body, ends, height_m).tolist()
        if all(map(math.isfinite, offset)):
            source = RangeSource.KNOWN_HEIGHT
    known = source is not RangeSource.NONE
    north, east, down = (origin + away for origin, away in zip(pose.position_ned_m, offset, strict=True))
    return Target(
        class_name=detection["class_name"],
        confidence=detection["confidence"],
        captured_ns=captured_ns,
        bearing_rad=math.atan2(direction[1], direction[0]),
        elevation_rad=math.asin(max(-1.0, min(1.0, -direction[2]))),
        range_m=math.hypot(offset[0], offset[1]) if known else math.nan,
        range_source=source,
        position_ned_m=(north, east, down) if known else None,
        box_xyxy=(left, top, right, bottom),
        track_id=detection.get("track_id"),
        track_score=detection.get("track_score"),
        trusted=trusted and detection.get("track_state") in (None, TRACK_CONFIRMED),
    )


def _measurable(camera: CameraModel, top: float, bottom: float) -> bool:
    """Tall enough, and neither its top nor its foot is cut off by the picture's edge."""
    return top > EDGE_PX and bottom < camera.height - 1 - EDGE_PX and bottom - top >= LEAST_HEIGHT_PX


def _newer(samples: deque[tuple[int, _Sample]], stamp_ns: int) -> bool:
    return not samples or stamp_ns > samples[-1][0]


def _around(samples: deque[tuple[int, _Sample]], stamp_ns: int, what: str) -> tuple[_Sample, _Sample, float]:
    """The samples before and after a moment and how far between them it is; the nearest beyond the ends."""
    if not samples:
        raise HistoryError(f"no {what} is known yet")
    outside_s = max(samples[0][0] - stamp_ns, stamp_ns - samples[-1][0]) / 1e9
    if outside_s > MAX_OUTSIDE_S:
        side = "older than the oldest" if stamp_ns < samples[0][0] else "newer than the newest"
        raise HistoryError(f"the frame is {outside_s:.2f} s {side} {what}, allowed are {MAX_OUTSIDE_S:g} s")
    index = bisect_right(samples, stamp_ns, key=lambda sample: sample[0])
    if index == 0:
        return samples[0][1], samples[0][1], 0.0
    if index == len(samples):
        return samples[-1][1], samples[-1][1], 0.0
    (before_ns, before), (after_ns, after) = samples[index - 1], samples[index]
    return before, after, (stamp_ns - before_ns) / (after_ns - before_ns)
