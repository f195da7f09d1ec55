"""DO_ORBIT: a circle around a point, as in PX4's orbit mode.

The vehicle first flies to the nearest point of the circle, facing its centre; then it follows the circle by
velocity, with a gain of 1/s on the radius. After a request outside the limits it hovers in mode ORBIT, as in
PX4.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum

from mavlink_sim.flight.position_control import NAN, NOTHING, TrajectorySetpoint
from mavlink_sim.flight.tasks import Trajectory, TrajectoryTask
from mavlink_sim.physics.airframe import Multirotor
from mavlink_sim.physics.rotations import Vector
from mavlink_sim.px4.parameters import Parameters

MIN_RADIUS_M = 1.0
MAX_CENTRIPETAL_MPS2 = 2.0
ON_CIRCLE_M = 2.0
RADIUS_GAIN_PER_S = 1.0
DEFAULT_SPEED_MPS = 1.0
# Nearer to the centre than this the direction is undefined, and the vehicle follows its heading.
AT_CENTRE_M = 1e-3


class YawBehaviour(IntEnum):
    """ORBIT_YAW_BEHAVIOUR."""

    FRONT_TO_CENTRE = 0
    INITIAL_HEADING = 1
    UNCONTROLLED = 2
    FRONT_TANGENT = 3
    STICK_CONTROLLED = 4
    UNCHANGED = 5


@dataclass(frozen=True, slots=True)
class OrbitRequest:
    """The parameters of DO_ORBIT; NaN: as before, or as the vehicle is now.

    Attributes:
        radius_m: positive is clockwise seen from above. speed_mps: negative reverses the direction.
        yaw_behaviour: an ORBIT_YAW_BEHAVIOUR.
        centre: local NED; north and east count together, down is the height to orbit at.
    """

    radius_m: float
    speed_mps: float
    yaw_behaviour: float
    centre: Vector


class Orbit(TrajectoryTask):
    """Orbit a centre. `refused` after a request outside the limits: then the vehicle hovers."""

    def __init__(self, airframe: Multirotor, parameters: Parameters) -> None:
        super().__init__(airframe, parameters)
        self._heading = _Heading(airframe.yaw_rad)
        self.refused = False
        self.centre = airframe.position
        self.radius_m = MIN_RADIUS_M
        self.speed_mps = DEFAULT_SPEED_MPS  # positive is clockwise
        self.yaw_behaviour = YawBehaviour.FRONT_TO_CENTRE
        self._clockwise = True
        self._initial_heading_rad = airframe.yaw_rad
        self._slewed_mps = 0.0
        self._approaching = True
        self._flying = False
        self._height_goal = airframe.position[2]
        self._stay = airframe.position
        self.down_m = airframe.position[2]  # the current height setpoint

    def apply(self, request: OrbitRequest) -> bool:
        """Apply a request. False if its radius is outside 1 m..MC_ORBIT_RAD_MAX: "Orbit radius limit
        exceeded"; the rest of it is applied nevertheless."""
        clockwise, radius, speed = self.speed_mps > 0.0, self.radius_m, abs(self.speed_mps)
        if math.isfinite(request.radius_m):
            clockwise, radius = request.radius_m > 0.0, abs(request.radius_m)
        if math.isfinite(request.speed_mps):
            speed = request.speed_mps
        accepted = MIN_RADIUS_M <= radius <= self._parameters.number("MC_ORBIT_RAD_MAX")
        if accepted:
            self._clockwise = clockwise
            self.radius_m = radius
            self.speed_mps = self._possible_speed(speed if clockwise else -speed)
        self._take_yaw_behaviour(request.yaw_behaviour)
        self._initial_heading_rad = self._airframe.yaw_rad
        north, east, down = request.centre
        if math.isfinite(north) and math.isfinite(east):
            self.centre = (north, east, self.centre[2])
        if math.isfinite(down):
            self.centre = (self.centre[0], self.centre[1], down)
        self.refused = not accepted
        if self.refused:
            self._trajectory = Trajectory(self._airframe, self._parameters)
            self._stay = self._trajectory.stopping_point()
        elif not self._on_circle() and not self._approaching:
            self._approaching = True
            self._trajectory = Trajectory(self._airframe, self._parameters)
        return accepted

    def _possible_speed(self, speed_mps: float) -> float:
        limit = min(
            abs(self._parameters.number("MPC_XY_VEL_MAX")), math.sqrt(MAX_CENTRIPETAL_MPS2 * self.radius_m)
        )
        return min(max(speed_mps, -limit), limit)

    def _take_yaw_behaviour(self, wanted: float) -> None:
        if not math.isfinite(wanted):
            return
        number = round(wanted)
        if number == YawBehaviour.UNCHANGED:
            if self._flying:
                return
            number = int(self._parameters.number("MC_ORBIT_YAW_MOD"))
        known = YawBehaviour.FRONT_TO_CENTRE <= number <= YawBehaviour.STICK_CONTROLLED
        self.yaw_behaviour = YawBehaviour(number) if known else YawBehaviour.FRONT_TO_CENTRE

    def _from_centre(self) -> tuple[float, float, float]:
        """(north, east, distance) of the vehicle from the centre."""
        north = self._airframe.position[0] - self.centre[0]
        east = self._airframe.position[1] - self.centre[1]
        return north, east, math.hypot(north, east)

    def _on_circle(self) -> bool:
        off_circle = abs(self._from_centre()[2] - self.radius_m)
        off_height = abs(self._airframe.position[2] - self.centre[2])
        return off_circle < ON_CIRCLE_M and off_height < self._parameters.number("NAV_MC_ALT_RAD")

    def update(self, dt_s: float) -> TrajectorySetpoint:
        self._flying = True
        if self._airframe.on_ground:
            return TrajectorySetpoint(velocity=(0.0, 0.0, 0.0))  # an orbit does not take off
        if self.refused:
            return self._trajectory.towards(self._stay, dt_s)
        if self._approaching and self._on_circle():
            self._approaching = False
            self._slewed_mps = 0.0
            self._height_goal = self._trajectory.stopping_point()[2]
        setpoint = self._approach(dt_s) if self._approaching else self._circle(dt_s)
        self.down_m = setpoint.position[2]
        yaw, rate = self._heading.towards(setpoint.yaw_rad, dt_s, self._parameters)
        if not self._approaching:
            rate = setpoint.yaw_rate_radps
        if math.isnan(setpoint.yaw_rad):
            yaw = NAN
        return TrajectorySetpoint(setpoint.position, setpoint.velocity, setpoint.acceleration, yaw, rate)

    def _approach(self, dt_s: float) -> TrajectorySetpoint:
        north, east, distance = self._from_centre()
        if distance > AT_CENTRE_M:
            outward = (north / distance, east / distance)
        else:
            outward = (math.cos(self._airframe.yaw_rad), math.sin(self._airframe.yaw_rad))
        nearest = (
            self.centre[0] + outward[0] * self.radius_m,
            self.centre[1] + outward[1] * self.radius_m,
            self.centre[2],
        )
        planned = self._trajectory.towards(nearest, dt_s)
        facing = math.atan2(-outward[1], -outward[0])
        return TrajectorySetpoint(planned.position, planned.velocity, NOTHING, facing)

    def _circle(self, dt_s: float) -> TrajectorySetpoint:
        north, east, distance = self._from_centre()
        out_north, out_east = (north / distance, east / distance) if distance > 0.0 else (0.0, 0.0)
        change = self._parameters.positive("MPC_ACC_HOR") * dt_s
        self._slewed_mps += min(max(self.speed_mps - self._slewed_mps, -change), change)
        speed = self._slewed_mps
        inward = speed * speed / self.radius_m
        correction = RADIUS_GAIN_PER_S * (self.radius_m - distance)
        (x, y, _), (vx, vy, _) = self._airframe.position, self._airframe.velocity
        self._trajectory.position = (x, y, self._trajectory.position[2])  # it plans the height only
        self._trajectory.velocity = (vx, vy, self._trajectory.velocity[2])
        level = self._trajectory.towards((x, y, self._height_goal), dt_s)
        yaw, rate = self._yaw(north, east)
        return TrajectorySetpoint(
            (NAN, NAN, level.position[2]),
            (
                -out_east * speed + out_north * correction,
                out_north * speed + out_east * correction,
                level.velocity[2],
            ),
            (-out_north * inward, -out_east * inward, NAN),
            yaw,
            rate,
        )

    def _yaw(self, north: float, east: float) -> tuple[float, float]:
        """(yaw, its rate as feed-forward) on the circle."""
        around = self.speed_mps / self.radius_m
        if self.yaw_behaviour is YawBehaviour.INITIAL_HEADING:
            return self._initial_heading_rad, NAN
        if self.yaw_behaviour is YawBehaviour.UNCONTROLLED:
            return NAN, 0.0
        if self.yaw_behaviour is YawBehaviour.STICK_CONTROLLED:
            return self._heading.yaw_rad, NAN  # no stick input: unchanged
        if self.yaw_behaviour is YawBehaviour.FRONT_TANGENT:
            sign = 1.0 if self._clockwise else -1.0
            return math.atan2(sign * north, -sign * east), around
        return math.atan2(-east, -north), around


class _Heading:
    """A heading that follows another within MPC_YAWRAUTO_MAX and MPC_YAWRAUTO_ACC."""

    def __init__(self, yaw_rad: float) -> None:
        self.yaw_rad = yaw_rad
        self._rate = 0.0

    def towards(self, wanted_rad: float, dt_s: float, parameters: Parameters) -> tuple[float, float]:
        """(yaw, rate) after another `dt_s`; NaN: come to rest."""
        fastest = math.radians(parameters.positive("MPC_YAWRAUTO_MAX"))
        acceleration = math.radians(parameters.positive("MPC_YAWRAUTO_ACC"))
        left = 0.0 if math.isnan(wanted_rad) else math.remainder(wanted_rad - self.yaw_rad, math.tau)
        # as fast as allows to stop there, and no faster than reaches it in this step
        rate = min(fastest, math.sqrt(2.0 * acceleration * abs(left)), abs(left) / dt_s)
        change = acceleration * dt_s
        self._rate += min(max(math.copysign(rate, left) - self._rate, -change), change)
        self.yaw_rad = math.remainder(self.yaw_rad + self._rate * dt_s, math.tau)
        return self.yaw_rad, self._rate
