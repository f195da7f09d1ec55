"""Orbit: circle about a point at constant height, nose to the centre."""

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
    GrammarError,
    Number,
    behaviour,
)
from companion.guidance.motion import (
    STOPPING_MPS2,
    Standing,
    correction,
    in_degrees,
    laps_text,
    position_and_yaw,
    stopping_speed,
)
from companion.guidance.objects.tracked_object import Subject
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import Vector3
from vision.attitude import wrap_angle

# Nearer to the centre than this the outward direction is undefined.
MIN_RADIUS_M = 0.2
# Points of the circle that are checked against the limits before it begins.
_CHECKED_POINTS = 36
# Initial delays of velocity, acceleration and heading of a multirotor; the integrals below correct the rest.
# The heading's is about 1 / MC_YAW_P; 0.34 s measured in lockstep.
VELOCITY_DELAY_S = 0.1
ACCELERATION_DELAY_S = 0.2
YAW_DELAY_S = 0.34
# Limit of the velocity command relative to the speed, for returning to the circle.
SPEED_MARGIN = 1.25
# Gains of the radius error (1/s; its integral 1/s²) and of the outward velocity, as in
# `motion.PositionController`; of the velocity along the circle; of the integrals of speed (1/s²) and heading
# (1/s).
RADIUS_GAIN, RADIUS_INTEGRAL_GAIN = 1.5, 0.4
VELOCITY_GAIN = 1.5
ALONG_GAIN = 0.6
SPEED_INTEGRAL_GAIN = 0.3
HEADING_INTEGRAL_GAIN = 0.5
# Limit of the estimated drag along the circle, per m/s.
MAX_DRAG_PER_S = 0.75
MAX_LEAD_RAD = 0.6
# Farther than this from the circle the integrals are frozen.
ON_CIRCLE_M = 1.5
# On the circle the velocity command turns continuously. That may use this fraction of the envelope's
# acceleration, else the vehicle flies slower; the rest is for corrections. An orbit of 8 m at 4 m/s flies 3.7
# m/s at 3 m/s².
TURNING_FRACTION = 0.8
# Speed adaptation to that: gain, limit, and filter time constant.
PACE_GAIN, MAX_PACE_MPS2, PACE_FILTER_S = 1.0, 0.5, 0.5
SLOWEST_MPS = 0.5

# Within this time an object must be chosen. Unseen for longer than that, a moving one is lost.
LOOK_S, LOST_AFTER_S = 2.0, 3.0
# Limit of the centripetal acceleration of a command.
MAX_CENTRIPETAL_MPS2 = 2.0


@behaviour(
    "orbit", "circle, nose to the centre: the point `radius` ahead, an object of a class, a track or a marker"
)
class Orbit(Command):
    endless_without = "laps"
    subject: Subject | None = None
    radius_m: Annotated[float, Number("radius", "m", 1.0, 100.0, "of the circle")] = 10.0
    speed_mps: Annotated[float, Number("speed", "m/s", 0.1, 10.0, "along the circle")] = 2.0
    laps: Annotated[float, Number("laps", "", 0.0, 100.0, "how many; 0: until another command")] = 0.0
    direction: Annotated[
        str, EnumArgument("direction", ("clockwise", "counterclockwise"), "seen from above")
    ] = "clockwise"

    def __post_init__(self) -> None:
        super().__post_init__()
        fastest = math.sqrt(MAX_CENTRIPETAL_MPS2 * self.radius_m)
        if self.speed_mps > fastest:
            raise GrammarError(
                f"orbit: speed must be at most {math.floor(fastest * 100) / 100:g} m/s on a radius of "
                f"{self.radius_m:g} m, got {self.speed_mps:g}"
            )

    def build(self, context: BuildContext) -> Behaviour:
        return OrbitBehaviour(self)


class OrbitBehaviour(Behaviour):
    """Flies at `speed_mps` along the circle; returning to the circle uses part of that speed.

    On the circle all commands are constant in polar coordinates, so integrals of the errors of radius, speed
    and heading compensate any delays of the vehicle. It flies slower where the envelope would not let it keep
    the radius.

    The centre is the point `radius_m` ahead of the vehicle at the start or, with a subject, where the object
    is: the circle moves with it, on top of `speed_mps`. A moving object that is lost ends the orbit; one that
    stands is circled unseen.
    """

    name = "orbit"
    requirements = frozenset({Requirement.POSITION, Requirement.IN_AIR})

    def __init__(self, command: Orbit) -> None:
        self.subject = command.subject
        self._radius_m, self._speed_mps, self._laps = command.radius_m, command.speed_mps, command.laps
        self._turn = 1.0 if command.direction == "clockwise" else -1.0
        self._begin(0.0)

    def _begin(self, down_m: float) -> None:
        self._centre: Vector3 | None = None
        self._standing = Standing()
        self._drift_mps = (0.0, 0.0)
        self._down_m = down_m
        self._angle_rad: float | None = None
        self._flown_rad = 0.0
        self._out_mps = self._drag_mps2 = self._lead_rad = self._pace_mps = self._turning_mps2 = 0.0
        self._asked_mps = (0.0, 0.0)
        self._until_ns: float = math.inf

    def _point_ahead(self, context: BehaviourContext) -> Vector3:
        (north, east, down), yaw_rad = position_and_yaw(context.state)
        return north + self._radius_m * math.cos(yaw_rad), east + self._radius_m * math.sin(yaw_rad), down

    def goals(self, context: BehaviourContext) -> tuple[Vector3, ...]:
        """The circle, if its centre is known: see Behaviour."""
        if self.subject is not None:
            return ()
        north, east, down = self._point_ahead(context)
        angles = (math.tau * step / _CHECKED_POINTS for step in range(_CHECKED_POINTS))
        return tuple(
            (north + self._radius_m * math.cos(angle), east + self._radius_m * math.sin(angle), down)
            for angle in angles
        )

    def on_activate(self, context: BehaviourContext) -> None:
        position, _ = position_and_yaw(context.state)
        self._begin(position[2])
        if self.subject is None:
            self._centre = self._point_ahead(context)
        else:
            context.objects.forget(self.subject)

    def _begin_circle(self, centre: Vector3, position: Vector3, context: BehaviourContext) -> None:
        path_m = self._laps * math.tau * self._radius_m
        path_m += abs(math.dist(position[:2], centre[:2]) - self._radius_m)
        turning_mps2 = TURNING_FRACTION * context.max_acceleration_mps2
        slow_mps = min(self._speed_mps, math.sqrt(turning_mps2 * self._radius_m))
        self._until_ns = context.now_ns + (2.0 * path_m / slow_mps + 30.0) * 1e9

    def _observe(self, context: BehaviourContext) -> str | None:
        """Move the centre with the object. Returns why that is not possible, in words; None: it is."""
        subject, now_ns = self.subject, context.now_ns
        if subject is None:
            return None
        seen = context.objects.of(subject)
        if seen is None:
            return context.objects.missing(subject) or context.objects.lost(subject, LOOK_S)
        if seen.moving and (why := context.objects.lost(subject, LOST_AFTER_S)) is not None:
            return why
        self._centre = seen.position_at(now_ns)
        self._drift_mps = seen.velocity_ned_mps if seen.moving else (0.0, 0.0)
        return None

    def update(self, dt_s: float, context: BehaviourContext) -> BehaviourOutput:
        position, yaw_rad = position_and_yaw(context.state)
        if (why := self._observe(context)) is not None:
            return Outcome(False, why)
        if self._centre is None:
            return self._standing.setpoint(context.state, context.now_ns, dt_s, None)
        if self._until_ns == math.inf:
            self._begin_circle(self._centre, position, context)
        north, east = position[0] - self._centre[0], position[1] - self._centre[1]
        distance = math.hypot(north, east)
        angle = math.atan2(east, north)
        if self._angle_rad is not None:
            self._flown_rad += self._turn * wrap_angle(angle - self._angle_rad)
        self._angle_rad = angle
        if self._laps and self._flown_rad >= self._laps * math.tau:
            return Outcome(True, f"{laps_text(self._laps)} flown at {distance:.1f} m")
        if self._laps and context.now_ns > self._until_ns:
            return Outcome(
                False, f"orbit timed out after {self._flown_rad / math.tau:.1f} of {self._laps:g} laps"
            )

        if distance < MIN_RADIUS_M:
            return Setpoint.velocity(
                (self._speed_mps, 0.0, correction(self._down_m - position[2])), context.now_ns
            )
        outward = (north / distance, east / distance)
        # All of this is relative to the centre, which may move.
        measured = context.state.velocity_ned_mps or (0.0, 0.0, 0.0)
        drift = self._drift_mps
        north_mps, east_mps = measured[0] - drift[0], measured[1] - drift[1]
        out_mps = outward[0] * north_mps + outward[1] * east_mps
        along_mps = self._turn * (outward[0] * east_mps - outward[1] * north_mps)
        self._adapt_pace(along_mps, distance, context.max_acceleration_mps2, dt_s)
        asked_out_mps, asked_along_mps = self._asked(self._radius_m - distance, out_mps, along_mps, dt_s)
        self._asked_mps = (asked_out_mps, asked_along_mps)
        around_mps = self._turn * asked_along_mps
        velocity = (
            outward[0] * asked_out_mps - outward[1] * around_mps + drift[0],
            outward[1] * asked_out_mps + outward[0] * around_mps + drift[1],
            correction(self._down_m - position[2]),
        )
        bearing = math.atan2(-east, -north)
        turn_radps = self._turn * along_mps / distance
        on_circle = abs(distance - self._radius_m) < ON_CIRCLE_M
        if on_circle:
            behind = wrap_angle(bearing - yaw_rad)
            lead = self._lead_rad + HEADING_INTEGRAL_GAIN * behind * dt_s
            self._lead_rad = max(-MAX_LEAD_RAD, min(MAX_LEAD_RAD, lead))
        heading = wrap_angle(bearing + turn_radps * YAW_DELAY_S + self._lead_rad)
        turning = None
        if on_circle:
            ahead = angle + turn_radps * ACCELERATION_DELAY_S
            turning = self._acceleration(ahead, turn_radps * self._turn * along_mps)
        return Setpoint.velocity(velocity, context.now_ns, yaw_rad=heading, acceleration_ned_mps2=turning)

    def _acceleration(self, angle_rad: float, inward_mps2: float) -> Vector3:
        """Feed-forward acceleration at an angle of the circle: centripetal, and against drag."""
        north, east = math.cos(angle_rad), math.sin(angle_rad)
        around_mps2 = self._turn * self._drag_mps2
        return (-inward_mps2 * north - around_mps2 * east, -inward_mps2 * east + around_mps2 * north, 0.0)

    def _adapt_pace(self, along_mps: float, distance_m: float, limit_mps2: float, dt_s: float) -> None:
        """Reduce the speed where turning takes too much of the envelope's acceleration."""
        turning_mps2 = math.hypot(*self._asked_mps) * along_mps / distance_m
        self._turning_mps2 += min(1.0, dt_s / PACE_FILTER_S) * (turning_mps2 - self._turning_mps2)
        change = PACE_GAIN * (TURNING_FRACTION * limit_mps2 - self._turning_mps2)
        pace = self._pace_mps + max(-MAX_PACE_MPS2, min(MAX_PACE_MPS2, change)) * dt_s
        self._pace_mps = max(min(pace, self._speed_mps), min(SLOWEST_MPS, self._speed_mps))

    def _asked(self, missing_m: float, out_mps: float, along_mps: float, dt_s: float) -> tuple[float, float]:
        """Velocity command outwards and along the circle, from the measured velocity."""
        pace = self._pace_mps
        fastest = SPEED_MARGIN * self._speed_mps
        wanted_out = stopping_speed(missing_m, pace, STOPPING_MPS2, RADIUS_GAIN)
        wanted_along = math.sqrt(max(0.0, pace**2 - wanted_out**2))
        if abs(missing_m) < ON_CIRCLE_M:
            self._out_mps += RADIUS_INTEGRAL_GAIN * missing_m * dt_s
            self._drag_mps2 += SPEED_INTEGRAL_GAIN * (wanted_along - along_mps) * dt_s
            self._out_mps = max(-self._speed_mps, min(self._speed_mps, self._out_mps))
            self._drag_mps2 = max(0.0, min(MAX_DRAG_PER_S * along_mps, self._drag_mps2))
        # The vehicle flies an earlier command, which lacks the centripetal acceleration since then.
        late = VELOCITY_DELAY_S * wanted_along**2 / max(self._radius_m, self._radius_m - missing_m)
        asked_out = wanted_out + VELOCITY_GAIN * (wanted_out - out_mps) + self._out_mps - late
        asked_out = max(-fastest, min(fastest, asked_out))
        asked_along = wanted_along + ALONG_GAIN * (wanted_along - along_mps)
        return asked_out, min(asked_along, math.sqrt(fastest**2 - asked_out**2))

    @property
    def status(self) -> str:
        angle = 0.0 if self._angle_rad is None else self._angle_rad
        return f"orbiting, {self._flown_rad / math.tau:.1f} laps, {in_degrees(angle)}° from the centre"
