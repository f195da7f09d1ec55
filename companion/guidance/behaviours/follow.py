"""Follow: keep a distance and a bearing to a moving object."""

from __future__ import annotations

import math
from typing import Annotated

from companion.guidance.behaviour import (
    Behaviour,
    BehaviourContext,
    BehaviourOutput,
    Outcome,
    Requirement,
)
from companion.guidance.command import (
    BuildContext,
    Command,
    EnumArgument,
    Number,
    behaviour,
)
from companion.guidance.gimbal.pitch import GimbalTracking, GimbalUse
from companion.guidance.motion import Standing, add_velocity_error, correction, position_and_yaw
from companion.guidance.objects.tracked_object import Subject, TrackedObject
from companion.vehicle.gimbal import GimbalAim
from companion.vehicle.setpoint import Setpoint
from vision.attitude import wrap_angle

# Gain of the errors of distance and along the circle, 1/s, and the limits of their correction, on top of the
# object's own velocity.
GAIN_PER_S = 1.2
# Gain of the velocity error, see `motion.add_velocity_error`.
VELOCITY_ERROR_GAIN = 1.0
MOST_CLOSING_MPS = 2.5
MOST_CIRCLING_MPS = 2.0
# Below this speed the object's last course is kept.
COURSE_MPS = 0.7
# Rate limit of the course, rad/s: the course is noisy, and it moves a goal at `distance_m`.
COURSE_RATE_RADPS = 0.35
# Uncertainty up to which the object's velocity is used fully; less above.
SURE_OF_SPEED_MPS = 1.0
# Detectors miss single frames; unseen for longer, the predicted velocity is reduced.
UNSEEN_S = 0.6


@behaviour("follow", "keep a distance and a bearing to a moving object of the class, a track or a marker")
class Follow(Command):
    endless_without = "duration_s"
    subject: Subject
    distance_m: Annotated[
        float, Number("distance", "m", 1.5, 100.0, "to keep, over ground to its nearest surface")
    ] = 8.0
    bearing: Annotated[
        str,
        EnumArgument(
            "bearing",
            ("here", "compass", "course"),
            "where to stay: unchanged, or `angle` from north or course",
        ),
    ] = "here"
    angle_deg: Annotated[
        float,
        Number(
            "angle",
            "deg",
            -360.0,
            360.0,
            "seen from the object, clockwise; relative to its course 180 is behind",
        ),
    ] = 180.0
    speed_mps: Annotated[float, Number("speed", "m/s", 0.2, 20.0, "maximum speed")] = 5.0
    confidence: Annotated[float, Number("confidence", "", 0.05, 1.0, "minimum confidence")] = 0.3
    occlusion_s: Annotated[
        float, Number("occlusion", "s", 0.5, 60.0, "follow a hidden object's predicted path this long")
    ] = 3.0
    duration_s: Annotated[
        float, Number("duration", "s", 0.0, 3600.0, "how long; 0: until another command")
    ] = 0.0
    gimbal: GimbalUse = "leave"

    def build(self, context: BuildContext) -> Behaviour:
        return FollowBehaviour(self)


class FollowBehaviour(Behaviour):
    """Keeps the height, yaws to the object and keeps `distance_m` over ground from its surface.

    It selects the confirmed object of the class ahead, or the track or marker, and stays with it. Unseen, it
    follows the prediction for `occlusion_s`; then it fails. The object's own speed is part of `speed_mps`.
    """

    name = "follow"
    requirements = frozenset(
        {
            Requirement.POSITION,
            Requirement.IN_AIR,
            Requirement.BATTERY,
        }
    )

    def __init__(self, command: Follow) -> None:
        self._command = command
        self.subject: Subject = command.subject
        self._tracking = GimbalTracking() if command.gimbal == "track" else None
        if self._tracking is not None:
            self.requirements = FollowBehaviour.requirements | {Requirement.GIMBAL}
        self._forget(0, 0.0)

    def _forget(self, now_ns: int, down_m: float) -> None:
        self._object: TrackedObject | None = None
        self._started_ns = now_ns
        self._down_m = down_m
        self._standing: Standing | None = None
        self._yaw_rad: float | None = None
        self._course_rad: float | None = None
        self._range_m = math.nan
        self._unseen_s = 0.0

    def on_activate(self, context: BehaviourContext) -> None:
        position, _ = position_and_yaw(context.state)
        self._forget(context.now_ns, position[2])
        context.objects.forget(self.subject)
        if self._tracking is not None:
            self._tracking.begin(context)

    def update(self, dt_s: float, context: BehaviourContext) -> BehaviourOutput:
        now_ns, state = context.now_ns, context.state
        position, _ = position_and_yaw(state)
        self._observe(context)
        track = self._object
        self._unseen_s = 0.0 if track is None else track.unseen_s(now_ns)
        if self._command.duration_s and now_ns - self._started_ns >= self._command.duration_s * 1e9:
            if track is None:
                return Outcome(
                    False, f"no localized {self.subject.name!r} to follow in {self._command.duration_s:g} s"
                )
            return Outcome(True, f"followed {self.subject.phrase} for {self._command.duration_s:g} s")
        if (why := context.objects.lost(self.subject, self._command.occlusion_s)) is not None:
            return Outcome(False, why)
        if track is not None:
            point = track.position_at(now_ns)
            north, east = point[0] - position[0], point[1] - position[1]
            self._range_m = math.hypot(north, east)
        if self._tracking is not None:
            newest = context.objects.in_sight(self.subject)
            why = self._tracking.keep_on(newest, self._range_m, position, context)
            if why is not None:
                return Outcome(False, f"follow lost the gimbal: {why}")
        if track is None or context.camera_fault:  # a prediction is for a hidden object, not for no camera
            self._standing = self._standing or Standing()
            return self._standing.setpoint(state, now_ns, dt_s, self._yaw_rad)
        self._standing = None
        self._yaw_rad = towards_rad = math.atan2(east, north)
        wanted = self._wanted(track, towards_rad, dt_s)
        north_mps, east_mps = add_velocity_error(wanted, state, self._command.speed_mps, VELOCITY_ERROR_GAIN)
        down_mps = correction(self._down_m - position[2])
        return Setpoint.velocity((north_mps, east_mps, down_mps), now_ns, yaw_rad=towards_rad)

    def _wanted(self, track: TrackedObject, towards_rad: float, dt_s: float) -> tuple[float, float]:
        """Horizontal velocity: the object's own, plus corrections along and across the line to it.

        In polar coordinates about the object, so that the path to another side of it leads around it.
        """
        trust = min(1.0, SURE_OF_SPEED_MPS / max(track.speed_sigma_mps, 1e-6))
        if self._unseen_s > UNSEEN_S:
            # The longer the prediction, the less it is followed.
            hidden = (self._unseen_s - UNSEEN_S) / max(self._command.occlusion_s, UNSEEN_S)
            trust *= max(0.0, 1.0 - hidden) ** 0.5
        north, east = (trust * speed for speed in track.velocity_ned_mps)
        closing = GAIN_PER_S * (self._range_m - self._command.distance_m)
        closing = max(-MOST_CLOSING_MPS, min(MOST_CLOSING_MPS, closing))
        circling = 0.0
        goal_rad = self._goal_rad(track, dt_s)
        if goal_rad is not None:
            from_object_rad = wrap_angle(towards_rad + math.pi)
            missing_m = wrap_angle(goal_rad - from_object_rad) * max(self._range_m, 1.0)
            circling = max(-MOST_CIRCLING_MPS, min(MOST_CIRCLING_MPS, GAIN_PER_S * missing_m))
        # Increasing bearings about the object are along (sin, -cos) of the direction to it.
        c, s = math.cos(towards_rad), math.sin(towards_rad)
        return (north + closing * c + circling * s, east + closing * s - circling * c)

    def _goal_rad(self, track: TrackedObject, dt_s: float) -> float | None:
        """Goal bearing, seen from the object; None: anywhere on the circle."""
        if self._command.bearing == "here":
            return None
        if self._command.bearing == "compass":
            return wrap_angle(math.radians(self._command.angle_deg))
        north, east = track.velocity_ned_mps
        if math.hypot(north, east) > COURSE_MPS:
            course = math.atan2(east, north)
            if self._course_rad is None:
                self._course_rad = course
            most = COURSE_RATE_RADPS * dt_s
            turn = wrap_angle(course - self._course_rad)
            self._course_rad = wrap_angle(self._course_rad + max(-most, min(most, turn)))
        if self._course_rad is None:
            return None
        return wrap_angle(self._course_rad + math.radians(self._command.angle_deg))

    def _observe(self, context: BehaviourContext) -> None:
        seen = context.objects.of(self.subject, self._command.confidence)
        if seen is not None:
            self._object = seen
        elif (target := context.objects.in_sight(self.subject)) is not None:
            # Fully inside the image it may get a range.
            self._yaw_rad = target.bearing_rad

    @property
    def gimbal_aim(self) -> GimbalAim | None:
        return None if self._tracking is None else self._tracking.aim

    @property
    def status(self) -> str:
        if self._object is None:
            return f"looking for {self.subject.phrase}"
        hidden = f", unseen for {self._unseen_s:.1f} s" if self._unseen_s > UNSEEN_S else ""
        return (
            f"following {self.subject.phrase_now(self._object.track_id)}, {self._range_m:.1f} m away{hidden}"
        )
