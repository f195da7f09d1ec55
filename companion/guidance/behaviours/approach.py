"""Approach: fly to an object and stop before it, servoing on its filtered position."""

from __future__ import annotations

import math

from companion.guidance.behaviour import (
    Behaviour,
    BehaviourContext,
    BehaviourOutput,
    Outcome,
    Requirement,
    RoutedSetpoint,
    needs_to_see,
)
from companion.guidance.gimbal.pitch import GimbalTracking
from companion.guidance.motion import (
    ARRIVED_M,
    STOPPING_MPS2,
    Arrival,
    PositionController,
    add_velocity_error,
    correction,
    ground_speed,
    position_and_yaw,
    speed_of,
    stopping_point,
    stopping_speed,
)
from companion.guidance.objects.closing_check import Approached
from companion.guidance.objects.subject import Subject
from companion.guidance.objects.target import RangeSource
from companion.guidance.objects.tracked_object import TrackedObject
from companion.vehicle.gimbal import GimbalAim
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import Vector3
from vision.attitude import wrap_angle

# Retreat from an object that is too near: slow, because the camera does not look backwards.
MAX_RETREAT_MPS = 1.0
# Slower than this the vehicle counts as stopped after losing its object.
STANDING_MPS = 0.3
# The end of the approach is flown to a fixed point before the object, so that wind does not carry the vehicle
# around it. Within the first distance of that point it is fixed; beyond the second it is released.
ANCHOR_M = (1.5, 3.0)
# Arrival tolerance with depth. Smaller than that of other arrivals, because errors of range and own estimate
# add to it, and the hold that follows keeps the error. Without depth the goal itself drifts by more.
REACHED_M = 0.15
# Detectors miss single frames; after this long without the object the vehicle brakes.
LOST_AFTER_S = 1.0
# Nearer than this the bearing to the object's nearest point is too noisy to follow.
MIN_YAW_RANGE_M = 1.0
BASE_TIMEOUT_S = 45.0


class ApproachBehaviour(Behaviour):
    """Keeps the height, yaws to the object and stops `distance_m` over ground before its surface.

    It selects the confirmed object of the class ahead (see `TargetSelector`), or the track or marker, and
    stays with it. After losing it, it brakes and waits for `lost_timeout_s` before it fails.

    Args:
        class_name, track_id, marker_id: exactly one of them.
        tracking: keeps the camera's gimbal on the object; None: the gimbal is not used.

    Attributes:
        lost_at: last known position of the object, if losing it ended the approach.
    """

    name = "approach"
    requirements = frozenset({Requirement.POSITION, Requirement.IN_AIR})

    def __init__(
        self,
        class_name: str = "",
        *,
        track_id: int | None = None,
        marker_id: int | None = None,
        distance_m: float = 5.0,
        speed_mps: float = 2.0,
        confidence: float = 0.3,
        lost_timeout_s: float = 5.0,
        tracking: GimbalTracking | None = None,
    ) -> None:
        self._tracking = tracking
        self._subject = Subject(class_name, track_id, marker_id)
        self.requirements = ApproachBehaviour.requirements | needs_to_see(self._subject)
        if tracking is not None:
            self.requirements |= {Requirement.GIMBAL}
        self.class_names, self.track_id = self._subject.class_names, track_id
        self.lost_at: Vector3 | None = None
        self._distance_m, self._speed_mps = distance_m, speed_mps
        self._confidence = confidence
        self._lost_timeout_s = lost_timeout_s
        self._object: TrackedObject | None = None
        self._doubted = False
        self._down_m = 0.0
        self._seen_ns = 0
        self._until_ns: float = math.inf
        self._started_ns = 0
        self._bearing_rad: float | None = None
        self._wait_point: Vector3 | None = None
        self._anchor_rad: float | None = None
        self._arrival, self._controller = Arrival(), PositionController()
        self._range_m = math.nan

    def on_activate(self, context: BehaviourContext) -> None:
        position, _ = position_and_yaw(context.state)
        self._down_m = position[2]
        self._started_ns = self._seen_ns = context.now_ns
        self._until_ns = context.now_ns + BASE_TIMEOUT_S * 1e9
        self._object = self._bearing_rad = self._wait_point = self._anchor_rad = None
        context.objects.forget(self._subject)
        self._doubted = False
        self.lost_at = None
        self._arrival, self._controller = Arrival(), PositionController()
        self._range_m = math.nan
        if self._tracking is not None:
            self._tracking.begin(context)

    def update(self, dt_s: float, context: BehaviourContext) -> BehaviourOutput:
        now_ns, state = context.now_ns, context.state
        position, yaw_rad = position_and_yaw(state)
        self._observe(context)
        track = self._object
        unseen_s = (now_ns - self._seen_ns) / 1e9
        if track is not None:
            point = track.position_at(now_ns)
            north, east, _ = point
            self._range_m = math.hypot(north - position[0], east - position[1])
        if self._tracking is not None:
            newest = None if track is None else track.detection
            why = self._tracking.keep_on(newest, self._range_m, position, context)
            if why is not None:
                return Outcome(False, f"approach lost the gimbal: {why}")
        if now_ns > self._until_ns:
            away = f"still {self._range_m:.1f} m away" if track else "range never known"
            took_s = (now_ns - self._started_ns) / 1e9
            return Outcome(False, f"did not reach {self._subject.phrase} in {took_s:.0f} s: {away}")
        # On a way around obstacles they hide the object: it is flown on to where it was last seen.
        lost_s = self._lost_timeout_s if context.avoiding else LOST_AFTER_S
        if track is None or unseen_s > lost_s or not context.fresh(self._subject):
            return self._wait(dt_s, context, position, unseen_s)
        if self._wait_point is not None:
            self._wait_point, self._controller = None, PositionController()

        bearing = math.atan2(east - position[1], north - position[0])
        if self._range_m > MIN_YAW_RANGE_M or self._bearing_rad is None:
            self._bearing_rad = bearing
        error_m = self._range_m - self._distance_m
        top = self._speed_mps if error_m > 0 else min(MAX_RETREAT_MPS, self._speed_mps)
        goal = self._goal(point, position, bearing)
        if goal is not None:
            off_m = math.inf if track.moving else math.dist(goal, position)
            near_m = REACHED_M if self._by_depth else ARRIVED_M
            if self._arrival.update(off_m, speed_of(state), now_ns, near_m):
                return Outcome(True, f"reached {self._subject.name} at {self._range_m:.1f} m", goal)
            velocity = self._controller.velocity(goal, state, dt_s, top)
            return Setpoint.velocity(velocity, now_ns, yaw_rad=self._bearing_rad)
        speed = stopping_speed(error_m, top, STOPPING_MPS2)
        # Slower while the nose does not point at the object yet.
        speed *= max(0.0, math.cos(wrap_angle(bearing - yaw_rad))) ** 2
        wanted = (speed * math.cos(bearing), speed * math.sin(bearing))
        down_mps = correction(self._down_m - position[2])
        if not context.avoiding or error_m <= 0.0:
            corrected = add_velocity_error(wanted, state, self._speed_mps)
            return Setpoint.velocity((*corrected, down_mps), now_ns, yaw_rad=self._bearing_rad)
        setpoint = Setpoint.velocity((*wanted, down_mps), now_ns, yaw_rad=self._bearing_rad)
        stop = (north - self._distance_m * math.cos(bearing), east - self._distance_m * math.sin(bearing))
        return RoutedSetpoint(setpoint, (position, (*stop, self._down_m)), facing=True)

    @property
    def approached(self) -> Approached | None:
        return None if self._object is None else Approached(self._object.detection)

    @property
    def gimbal_aim(self) -> GimbalAim | None:
        return None if self._tracking is None else self._tracking.aim

    @property
    def status(self) -> str:
        if self._object is None:
            return f"looking for {self._subject.phrase}"
        if self._wait_point is not None:
            return f"lost {self._subject.phrase_now(self._object.track_id)}, waiting"
        return f"{self._subject.phrase_now(self._object.track_id)} {self._range_m:.1f} m away"

    def _observe(self, context: BehaviourContext) -> None:
        seen = context.objects.of(self._subject, self._confidence)
        if seen is None:
            fitting = self._subject.of(context.targets_of(self._subject), self._confidence)
            if fitting:
                self._doubted = not any(target.trusted for target in fitting)
            return
        if seen.position_ned_m is None:
            # Fully inside the image it may get a range.
            self._bearing_rad = seen.detection.bearing_rad
            if self._tracking is not None:
                self._tracking.turn_to(seen.detection, context)
            return
        before, self._object, self._seen_ns = self._object, seen, seen.last_ns
        if before is None:
            path_m = abs(seen.detection.ground_range_m - self._distance_m)
            self._until_ns = context.now_ns + (BASE_TIMEOUT_S + 3.0 * path_m / self._speed_mps) * 1e9
        else:
            self.add_notes(*self._subject.new_id(before.track_id, seen.track_id))

    def _goal(self, point: Vector3, position: Vector3, bearing: float) -> Vector3 | None:
        """The point to stop at, once it is near: on the vehicle's side of the object."""
        chosen = self._anchor_rad is not None
        away_rad = bearing + math.pi if self._anchor_rad is None else self._anchor_rad
        goal = (
            point[0] + self._distance_m * math.cos(away_rad),
            point[1] + self._distance_m * math.sin(away_rad),
            self._down_m,
        )
        if math.dist(goal[:2], position[:2]) >= ANCHOR_M[1 if chosen else 0]:
            self._leave_goal()
            return None
        self._anchor_rad = away_rad
        return goal

    @property
    def _by_depth(self) -> bool:
        by_depth = (RangeSource.DEPTH, RangeSource.MARKER)
        return self._object is not None and self._object.range_source in by_depth

    def _leave_goal(self) -> None:
        self._anchor_rad = None
        self._arrival, self._controller = Arrival(), PositionController()

    def _wait(
        self, dt_s: float, context: BehaviourContext, position: Vector3, unseen_s: float
    ) -> BehaviourOutput:
        """Object not seen: brake, hold where the vehicle comes to rest, and keep the heading."""
        if self._wait_point is None:
            self._leave_goal()
        if unseen_s > self._lost_timeout_s:
            if not context.fresh(self._subject):
                why = context.perception_fault("no detections received")
            elif self._doubted:
                why = self._subject.doubted
            elif self._object is None:
                why = "never seen with a known range"
            else:
                why = f"last seen {self._range_m:.1f} m away"
                self.lost_at = self._object.position_at(context.now_ns)
                why += context.tracks.replacement(self._object.detection, context.now_ns)
            return Outcome(False, f"lost {self._subject.phrase} for {unseen_s:.1f} s: {why}")
        if self._wait_point is None and ground_speed(context.state) < STANDING_MPS:
            north, east, _ = stopping_point(context.state)
            self._wait_point = (north, east, self._down_m)
        if self._wait_point is None:
            velocity = (0.0, 0.0, correction(self._down_m - position[2]))
        else:
            velocity = self._controller.velocity(self._wait_point, context.state, dt_s)
        if self._bearing_rad is None:
            return Setpoint.velocity(velocity, context.now_ns, yaw_rate_radps=0.0)
        return Setpoint.velocity(velocity, context.now_ns, yaw_rad=self._bearing_rad)
