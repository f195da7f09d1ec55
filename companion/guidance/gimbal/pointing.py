"""Where to point the gimbal for an operator: a fixed direction, an object in the image, or a place."""

from __future__ import annotations

import math

from companion.guidance.behaviour import BehaviourContext
from companion.guidance.motion import home_of, local_from_global
from companion.guidance.objects.in_view import nearest_ahead
from companion.guidance.objects.tracked_object import GimbalGoal, GlobalPoint, Subject, TrackedObject
from companion.vehicle.gimbal import GimbalAim, YawFrame
from companion.vehicle.state import Vector3, VehicleState

# An object unseen for so long is lost, and so is a position; the default of `follow occlusion=`.
LOST_AFTER_S = 3.0
# Nearer than this the point is above or below, and has no bearing.
NEAREST_M = 0.1
# An aim is held for 0.1 s: it is for the middle of that time, and the way to the gimbal. Of 0, 0.07, 0.10 and
# 0.13 s the error was least with 0.07, in lockstep past a place at 5 m/s and around it at 3 m/s.
LEAD_S = 0.07


class Pointing:
    """The aim at a goal from where the vehicle is now. An object's and a place's aims are relative to north.

    Attributes:
        goal: as commanded.
        aim: where to point the gimbal; None: not begun yet.
    """

    def __init__(self, goal: GimbalGoal) -> None:
        self.goal = goal
        self.aim = goal if isinstance(goal, GimbalAim) else None
        self._object: TrackedObject | None = None
        self._point: Vector3 | None = None
        self._known_ns = 0

    @property
    def kept(self) -> bool:
        """Whether the aim is updated until the goal is lost."""
        return not isinstance(self.goal, GimbalAim)

    @property
    def name(self) -> str:
        """`the person`, `track 17`, or `the place`."""
        return self.goal.phrase if isinstance(self.goal, Subject) else "the place"

    def begin(self, context: BehaviourContext) -> str | None:
        """Aim for the first time. Returns why that is not possible, in words; None: it is."""
        match self.goal:
            case GimbalAim():
                return None
            case Subject():
                if (why := context.objects.missing(self.goal)) is None:
                    self._object = self._best(self.goal, context)
            case GlobalPoint():
                why = self._locate(self.goal, context) or self._beyond_reach(context)
        why = why or self.update(context)
        if why is None and self.aim is None:  # an object with a known place
            return _position_missing(context)
        return why

    def update(self, context: BehaviourContext) -> str | None:
        """Aim from where the vehicle is now. Returns why the goal is lost, in words; None: it is not."""
        if isinstance(self.goal, Subject):
            self._look(self.goal, context)
        elif isinstance(self.goal, GlobalPoint) and context.state.position_fault(context.now_ns) is None:
            self._known_ns = context.now_ns
        if self.kept and context.now_ns - self._known_ns > LOST_AFTER_S * 1e9:
            return self._lost(context)
        if (towards := self._towards(context)) is not None:
            bearing_rad, elevation_rad = towards
            self.aim = GimbalAim(context.gimbal_pitch_to(elevation_rad), bearing_rad, YawFrame.NORTH)
        return None

    def _look(self, subject: Subject, context: BehaviourContext) -> None:
        """Remember the object's newest detection, and where that was, by the newest range and direction."""
        before, here = self._object, context.state.position_ned_m
        if before is None:
            return
        self._object = seen = context.objects.now(before)
        if subject.class_name and seen.unseen_s(context.now_ns) > context.objects.ended_s:
            self._object = seen = self._best(subject, context) or seen
        if self._known_ns == seen.last_ns:
            return
        self._known_ns, self._point, target = seen.last_ns, None, seen.detection
        if target.position_ned_m is not None and here is not None:
            down = here[2] - target.ground_range_m * math.tan(target.elevation_rad)
            self._point = (*target.position_ned_m[:2], down)

    def _best(self, subject: Subject, context: BehaviourContext) -> TrackedObject | None:
        present = context.objects.present(subject)
        return nearest_ahead(present, context.objects.yaw_rad) if present else None

    def _locate(self, place: GlobalPoint, context: BehaviourContext) -> str | None:
        state = context.state
        if state.position_fault(context.now_ns) is not None:
            return _position_missing(context)
        try:
            north, east = local_from_global(state, context.now_ns, (place.latitude_deg, place.longitude_deg))
            self._point = (north, east, home_of(state)[2] - place.altitude_m)
        except ValueError as error:
            return str(error)
        return None

    def _beyond_reach(self, context: BehaviourContext) -> str | None:
        gimbal, towards = context.state.gimbal, self._towards(context)
        if gimbal is None or towards is None:
            return None
        pitch_rad = towards[1] - context.gimbal.camera_pitch_rad
        if gimbal.reaches(pitch_rad):
            return None
        low, high = math.degrees(gimbal.lowest_pitch_rad), math.degrees(gimbal.highest_pitch_rad)
        return (
            f"the place needs a pitch of {math.degrees(pitch_rad):.0f}° from here; "
            f"the gimbal's range is {low:.0f}° to {high:.0f}°"
        )

    def _towards(self, context: BehaviourContext) -> tuple[float, float] | None:
        """Bearing from north and elevation, radians; None: unchanged."""
        here = _position_ahead(context.state, context.now_ns)
        if self._point is None:
            if self._object is None:
                return None
            return self._object.detection.bearing_rad, self._object.detection.elevation_rad
        if here is None:
            return None
        north, east, down = (there - own for there, own in zip(self._point, here, strict=True))
        range_m = math.hypot(north, east)
        level = range_m < NEAREST_M and self.aim is not None
        bearing_rad = self.aim.yaw_rad if level and self.aim is not None else math.atan2(east, north)
        return bearing_rad, math.atan2(-down, range_m)

    def _lost(self, context: BehaviourContext) -> str:
        if self._object is None:
            return f"position lost for {LOST_AFTER_S:.1f} s"
        return f"lost {self.name} for {LOST_AFTER_S:.1f} s: {context.objects.where(self._object)}"


def _position_missing(context: BehaviourContext) -> str:
    return f"position is missing ({context.state.position_fault(context.now_ns)})"


def _position_ahead(state: VehicleState, now_ns: int) -> Vector3 | None:
    """The vehicle's position when the gimbal follows the aim, local NED."""
    position, velocity = state.position_ned_m, state.velocity_ned_mps or (0.0, 0.0, 0.0)
    if position is None or not state.position_fresh(now_ns):
        return None
    ahead_s = (now_ns - state.position_ns) / 1e9 + LEAD_S
    north, east, down = (own + ahead_s * speed for own, speed in zip(position, velocity, strict=True))
    return (north, east, down)
