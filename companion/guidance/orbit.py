"""Circle about a point, nose to the centre, height kept."""

from __future__ import annotations

import math

from companion.guidance.behaviour import Behaviour, Outcome, Requirement, Situation, Step
from companion.guidance.motion import correction, in_degrees, laps_text, position_and_yaw, pressed
from companion.guidance.target import Target
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import Vector3
from vision.attitude import wrap_angle

# Nearer to the centre than this there is no direction outwards.
MIN_RADIUS_M = 0.2
# How late a multirotor's velocity follows; of the order of 1 / MPC_XY_VEL_P_ACC.
VELOCITY_DELAY_S = 0.4
# What may be asked for beyond the wanted speed so that drag does not make it less.
SPEED_MARGIN = 1.25


class OrbitBehaviour(Behaviour):
    """Flies at `speed_mps` along the circle; what is needed to come back onto the circle is taken from it.

    The centre is the point `radius_m` ahead of the vehicle when it begins or, with a class name, the place of
    the object of that class nearest to the nose, taken once.
    """

    name = "orbit"

    def __init__(
        self,
        radius_m: float = 10.0,
        speed_mps: float = 2.0,
        laps: float = 0.0,
        *,
        clockwise: bool = True,
        class_name: str = "",
    ) -> None:
        needs = {Requirement.POSITION, Requirement.IN_AIR}
        if class_name:
            needs |= {Requirement.PERCEPTION, Requirement.DEPTH_OR_SIZE}
        self.requirements = frozenset(needs)
        self.class_names = (class_name,) if class_name else ()
        self._class_name = class_name
        self._radius_m, self._speed_mps, self._laps = radius_m, speed_mps, laps
        self._turn = 1.0 if clockwise else -1.0
        self._centre: Vector3 | None = None
        self._down_m = 0.0
        self._angle_rad: float | None = None
        self._flown_rad = 0.0
        self._until_ns: float = 0

    def on_activate(self, situation: Situation) -> None:
        position, yaw_rad = position_and_yaw(situation.state)
        self._down_m = position[2]
        self._angle_rad, self._flown_rad = None, 0.0
        self._centre = None
        if not self._class_name:
            self._centre = (
                position[0] + self._radius_m * math.cos(yaw_rad),
                position[1] + self._radius_m * math.sin(yaw_rad),
                position[2],
            )
        elif (target := self._nearest_to_nose(situation.targets, yaw_rad)) is not None:
            self._centre = target.position_ned_m
        away_m = 0.0 if self._centre is None else math.dist(position[:2], self._centre[:2])
        path_m = self._laps * math.tau * self._radius_m + abs(away_m - self._radius_m)
        self._until_ns = situation.now_ns + (2.0 * path_m / self._speed_mps + 30.0) * 1e9

    def update(self, dt_s: float, situation: Situation) -> Step:
        if self._centre is None:
            return Outcome(False, f"no {self._class_name} with a known place in sight to orbit")
        position, _ = position_and_yaw(situation.state)
        north, east = position[0] - self._centre[0], position[1] - self._centre[1]
        distance = math.hypot(north, east)
        angle = math.atan2(east, north)
        if self._angle_rad is not None:
            self._flown_rad += self._turn * wrap_angle(angle - self._angle_rad)
        self._angle_rad = angle
        if self._laps and self._flown_rad >= self._laps * math.tau:
            return Outcome(True, f"{laps_text(self._laps)} flown at {distance:.1f} m")
        if self._laps and situation.now_ns > self._until_ns:
            return Outcome(
                False, f"orbit timed out after {self._flown_rad / math.tau:.1f} of {self._laps:g} laps"
            )

        if distance < MIN_RADIUS_M:
            outward, bearing = (1.0, 0.0), None
        else:
            outward, bearing = (north / distance, east / distance), math.atan2(-east, -north)
        radial = correction(self._radius_m - distance, self._speed_mps)
        along = self._turn * math.sqrt(max(0.0, self._speed_mps**2 - radial**2))
        # The vehicle flies what was asked a moment ago; that lacks the centripetal acceleration since then.
        radial -= VELOCITY_DELAY_S * along**2 / max(distance, self._radius_m)
        wanted = (outward[0] * radial - outward[1] * along, outward[1] * radial + outward[0] * along)
        north_mps, east_mps = pressed(wanted, situation.state, SPEED_MARGIN * self._speed_mps)
        velocity = (north_mps, east_mps, correction(self._down_m - position[2]))
        return Setpoint.velocity(velocity, situation.now_ns, yaw_rad=bearing)

    @property
    def status(self) -> str:
        angle = 0.0 if self._angle_rad is None else self._angle_rad
        return f"orbiting, {self._flown_rad / math.tau:.1f} laps, {in_degrees(angle)}° of the centre"

    def _nearest_to_nose(self, targets: tuple[Target, ...], yaw_rad: float) -> Target | None:
        fitting = [t for t in targets if t.class_name == self._class_name and t.position_ned_m is not None]
        return min(fitting, key=lambda t: abs(wrap_angle(t.bearing_rad - yaw_rad)), default=None)
