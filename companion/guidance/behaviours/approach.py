"""Approach: fly to an object and stop before it, servoing on its filtered position.

A lost object of a class is searched where it was last seen, then by a full turn.
"""

from __future__ import annotations

import math
from typing import Annotated

from companion.guidance.behaviour import (
    Behaviour,
    BehaviourContext,
    BehaviourOutput,
    Outcome,
    Requirement,
    RoutedSetpoint,
)
from companion.guidance.behaviours.seek import Seek, SeekBehaviour
from companion.guidance.command import (
    BuildContext,
    Command,
    GrammarError,
    Number,
    behaviour,
)
from companion.guidance.gimbal.pitch import (
    LEAST_SWEEP_DEG,
    USUAL_RATE_DPS,
    GimbalSweep,
    GimbalTracking,
    GimbalUse,
)
from companion.guidance.motion import (
    ARRIVED_M,
    STOPPING_MPS2,
    Arrival,
    PositionController,
    Standing,
    add_velocity_error,
    correction,
    position_and_yaw,
    speed_of,
    stopping_speed,
)
from companion.guidance.objects.closing_check import Approached
from companion.guidance.objects.target import RangeSource
from companion.guidance.objects.tracked_object import Subject, TrackedObject
from companion.guidance.search_pattern import NARROW_FIELD_RAD, field_of_view_rad
from companion.vehicle.gimbal import GimbalAim
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import Vector3
from vision.attitude import wrap_angle

# Retreat from an object that is too near: slow, because the camera does not look backwards.
MAX_RETREAT_MPS = 1.0
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


@behaviour(
    "approach", "fly to an object of the class, a track or a marker, keeping the height, and stop before it"
)
class Approach(Command):
    subject: Subject
    distance_m: Annotated[
        float, Number("distance", "m", 1.0, 100.0, "where to stop, over ground to its nearest surface")
    ] = 5.0
    speed_mps: Annotated[float, Number("speed", "m/s", 0.2, 10.0, "maximum speed")] = 2.0
    confidence: Annotated[float, Number("confidence", "", 0.05, 1.0, "minimum confidence")] = 0.3
    lost_timeout_s: Annotated[
        float, Number("lost_timeout", "s", 0.5, 60.0, "wait for a lost object this long")
    ] = 5.0
    retries: Annotated[
        float,
        Number(
            "retries",
            "",
            0.0,
            20.0,
            "how often to search for a lost object, unless it is a track or a marker",
        ),
    ] = 2.0
    gimbal: GimbalUse = "leave"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.retries != int(self.retries):
            raise GrammarError(f"approach: retries must be a whole number, got {self.retries:g}")

    def build(self, context: BuildContext) -> Behaviour:
        return ApproachBehaviour(self, field_of_view_rad(context.footprint))


class ApproachBehaviour(Behaviour):
    """Keeps the height, yaws to the object and stops `distance_m` over ground before its surface.

    It chooses the confirmed object of the class ahead, or the track or marker, and stays with it. After
    losing it, it brakes and waits for `lost_timeout_s`. Then it looks at the last known position and turns
    once, up to `retries` times, and approaches what it finds.

    Args:
        field_rad: the camera's horizontal field of view.
    """

    name = "approach"
    requirements = frozenset({Requirement.POSITION, Requirement.IN_AIR})

    def __init__(self, command: Approach, field_rad: float = NARROW_FIELD_RAD) -> None:
        self._command, self._field_rad = command, field_rad
        self.subject: Subject = command.subject
        self._tracking = GimbalTracking() if command.gimbal == "track" else None
        if self._tracking is not None:
            self.requirements = ApproachBehaviour.requirements | {Requirement.GIMBAL}
        # A search for a track would find another one.
        self._retries = int(command.retries) if command.subject.class_name else 0
        self._tried = 0
        self._forget(0, 0.0)

    def _forget(self, now_ns: int, down_m: float) -> None:
        self._seek: SeekBehaviour | None = None
        self._lost = "", (0.0, 0.0, 0.0)
        self._object: TrackedObject | None = None
        self._started_ns, self._down_m = now_ns, down_m
        self._until_ns = now_ns + BASE_TIMEOUT_S * 1e9
        self._bearing_rad: float | None = None
        self._standing: Standing | None = None
        self._anchor_rad: float | None = None
        self._arrival, self._controller = Arrival(), PositionController()
        self._range_m = math.nan

    def on_activate(self, context: BehaviourContext) -> None:
        self._tried = 0
        self._begin(context)

    def _begin(self, context: BehaviourContext) -> None:
        position, _ = position_and_yaw(context.state)
        self._forget(context.now_ns, position[2])
        context.objects.forget(self.subject)
        if self._tracking is not None:
            self._tracking.begin(context)

    def update(self, dt_s: float, context: BehaviourContext) -> BehaviourOutput:
        if self._seek is not None:
            return self._search(self._seek, dt_s, context)
        now_ns, state = context.now_ns, context.state
        position, yaw_rad = position_and_yaw(state)
        self._observe(context)
        track = self._object
        if track is not None:
            point = track.position_at(now_ns)
            north, east, _ = point
            self._range_m = math.hypot(north - position[0], east - position[1])
        if self._tracking is not None:
            newest = context.objects.in_sight(self.subject)
            why = self._tracking.keep_on(newest, self._range_m, position, context)
            if why is not None:
                return Outcome(False, f"approach lost the gimbal: {why}")
        if now_ns > self._until_ns:
            away = f"still {self._range_m:.1f} m away" if track else "range never known"
            took_s = (now_ns - self._started_ns) / 1e9
            return Outcome(False, f"did not reach {self.subject.phrase} in {took_s:.0f} s: {away}")
        # On a way around obstacles they hide the object: it is flown on to where it was last seen.
        lost_s = self._command.lost_timeout_s if context.avoiding else LOST_AFTER_S
        blind = context.objects.fault_of(self.subject)
        if track is None or track.unseen_s(now_ns) > lost_s or blind:
            return self._wait(dt_s, context)
        self._standing = None

        bearing = math.atan2(east - position[1], north - position[0])
        if self._range_m > MIN_YAW_RANGE_M or self._bearing_rad is None:
            self._bearing_rad = bearing
        error_m = self._range_m - self._command.distance_m
        top = self._command.speed_mps if error_m > 0 else min(MAX_RETREAT_MPS, self._command.speed_mps)
        goal = self._goal(point, position, bearing)
        if goal is not None:
            off_m = math.inf if track.moving else math.dist(goal, position)
            near_m = REACHED_M if self._by_depth else ARRIVED_M
            if self._arrival.update(off_m, speed_of(state), now_ns, near_m):
                return Outcome(True, f"reached {self.subject.name} at {self._range_m:.1f} m", goal)
            velocity = self._controller.velocity(goal, state, dt_s, top)
            return Setpoint.velocity(velocity, now_ns, yaw_rad=self._bearing_rad)
        speed = stopping_speed(error_m, top, STOPPING_MPS2)
        # Slower while the nose does not point at the object yet.
        speed *= max(0.0, math.cos(wrap_angle(bearing - yaw_rad))) ** 2
        wanted = (speed * math.cos(bearing), speed * math.sin(bearing))
        down_mps = correction(self._down_m - position[2])
        if not context.avoiding or error_m <= 0.0:
            corrected = add_velocity_error(wanted, state, self._command.speed_mps)
            return Setpoint.velocity((*corrected, down_mps), now_ns, yaw_rad=self._bearing_rad)
        setpoint = Setpoint.velocity((*wanted, down_mps), now_ns, yaw_rad=self._bearing_rad)
        before_m = self._command.distance_m
        stop = (north - before_m * math.cos(bearing), east - before_m * math.sin(bearing))
        return RoutedSetpoint(setpoint, (position, (*stop, self._down_m)), facing=True)

    @property
    def approached(self) -> Approached | None:
        if self._object is None or self._seek is not None:
            return None
        return Approached(self._object.detection)

    @property
    def gimbal_aim(self) -> GimbalAim | None:
        if self._tracking is None:
            return None
        return (None if self._seek is None else self._seek.gimbal_aim) or self._tracking.aim

    @property
    def status(self) -> str:
        if self._seek is not None:
            doing = "where it was" if self._seek.looks_first else "all around"
            return f"lost {self.subject.phrase}, searching {doing} ({self._tried} of {self._retries})"
        if self._object is None:
            return f"looking for {self.subject.phrase}"
        if self._standing is not None:
            return f"lost {self.subject.phrase_now(self._object.track_id)}, waiting"
        return f"{self.subject.phrase_now(self._object.track_id)} {self._range_m:.1f} m away"

    def _observe(self, context: BehaviourContext) -> None:
        seen = context.objects.of(self.subject, self._command.confidence)
        if seen is None:
            if (target := context.objects.in_sight(self.subject)) is not None:
                # Fully inside the image it may get a range.
                self._bearing_rad = target.bearing_rad
            return
        if self._object is None:
            path_m = abs(seen.detection.ground_range_m - self._command.distance_m)
            self._until_ns = context.now_ns + (BASE_TIMEOUT_S + 3.0 * path_m / self._command.speed_mps) * 1e9
        self._object = seen

    def _goal(self, point: Vector3, position: Vector3, bearing: float) -> Vector3 | None:
        """The point to stop at, once it is near: on the vehicle's side of the object."""
        chosen = self._anchor_rad is not None
        away_rad = bearing + math.pi if self._anchor_rad is None else self._anchor_rad
        goal = (
            point[0] + self._command.distance_m * math.cos(away_rad),
            point[1] + self._command.distance_m * math.sin(away_rad),
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

    def _wait(self, dt_s: float, context: BehaviourContext) -> BehaviourOutput:
        """Object not seen: brake, hold where the vehicle comes to rest, and keep the heading."""
        if self._standing is None:
            self._leave_goal()
            self._standing = Standing()
        if (why := context.objects.lost(self.subject, self._command.lost_timeout_s)) is not None:
            if self._object is None or context.objects.fault_of(self.subject):
                return Outcome(False, why)
            return self._look_again(why, self._object.position_at(context.now_ns), context)
        return self._standing.setpoint(context.state, context.now_ns, dt_s, self._bearing_rad)

    def _look_again(self, why: str, lost_at: Vector3, context: BehaviourContext) -> BehaviourOutput:
        """Start another search where the object was; the outcome if the retries are used up."""
        if self._tried >= self._retries:
            times = "once" if self._tried == 1 else f"{self._tried} times"
            return Outcome(False, why + (f"; searched again {times}" if self._tried else ""))
        self._tried += 1
        self.add_notes(f"approach: {why}; searching, {self._tried} of {self._retries}")
        context.objects.forget(self.subject)
        self._lost = why, lost_at
        turn = Seek(self.subject.class_name, laps=1.0, confidence=self._command.confidence)
        self._seek = SeekBehaviour(turn, sweep=self._sweep(), first_at=lost_at)
        self._seek.on_activate(context)
        return self._search(self._seek, 0.0, context)

    def _search(self, seek: SeekBehaviour, dt_s: float, context: BehaviourContext) -> BehaviourOutput:
        """Look for the lost object, and approach what is found."""
        if self._tracking is not None and (why := self._tracking.control_fault(context)) is not None:
            return Outcome(False, f"approach lost the gimbal: {why}")
        step = seek.update(dt_s, context)
        if not isinstance(step, Outcome):
            return step
        if step.success:
            self.add_notes(f"approach: {step.reason}")
            self._begin(context)
            return self.update(0.0, context)
        why, lost_at = self._lost
        if not context.perception_fresh:
            return Outcome(False, f"{why}; {step.reason}")
        return self._look_again(why, lost_at, context)

    def _sweep(self) -> GimbalSweep | None:
        """A sweep between the pitch at which the object was lost and level."""
        aim = None if self._tracking is None else self._tracking.aim
        if aim is None or abs(math.degrees(aim.pitch_rad)) < LEAST_SWEEP_DEG:
            return None
        return GimbalSweep(aim.pitch_rad, math.radians(USUAL_RATE_DPS), self._field_rad)
