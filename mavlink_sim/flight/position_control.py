"""PX4's multirotor position control: position P, velocity PID, then thrust and tilt.

All vectors NED. A NaN axis is not controlled by that stage, as in PX4's trajectory setpoint.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from mavlink_sim.physics.airframe import GRAVITY_MPS2, MAX_THRUST_MPS2
from mavlink_sim.physics.rotations import Vector
from mavlink_sim.px4.parameters import Parameters

NAN = math.nan
NOTHING: Vector = (NAN, NAN, NAN)
# PX4's is 2. Less, so that a 10 m step overshoots as measured on the real vehicle (0.6-1.15 m) and still
# settles within 6 s; all other gains are PX4's.
ANTI_WINDUP = 1.3
# Far above what any vehicle can do: avoids overflow with absurd setpoints and gains, which PX4 accepts.
MAX_DEMAND_MPS2 = 1000.0
MAX_TILT_DEG = 80.0
# MPC_THR_MIN; and 0.97, within PX4's range from 1 (MPC_THR_MAX, level) to 0.954 (with MPC_THR_XY_MARG, 0.3,
# kept for tilt).
LEAST_LIFT_MPS2 = 0.12 * MAX_THRUST_MPS2
MOST_LIFT_MPS2 = 0.97 * MAX_THRUST_MPS2


# Not frozen, though never changed: a frozen dataclass takes three times as long to create, and each control
# step creates both.
@dataclass(slots=True)
class TrajectorySetpoint:
    """The setpoint of a flight task; NaN: not controlled. NED, metres, seconds, radians."""

    position: Vector = NOTHING
    velocity: Vector = NOTHING
    acceleration: Vector = NOTHING
    yaw_rad: float = NAN
    yaw_rate_radps: float = NAN


@dataclass(slots=True)
class Demand:
    """The demand to the airframe."""

    thrust_mps2: float
    roll_rad: float
    pitch_rad: float
    yaw_rate_radps: float


class PositionController:
    """The cascade with its integrator; `position`, `velocity`, `acceleration`: the last inner setpoints."""

    def __init__(self, parameters: Parameters) -> None:
        self._parameters = parameters
        self._revision = -1
        self._integral: Vector = (0.0, 0.0, 0.0)
        self.position: Vector = NOTHING
        self.velocity: Vector = NOTHING
        self.acceleration: Vector = NOTHING
        self.yaw_rad = 0.0
        self.yaw_rate_radps = 0.0
        self._load()

    def _load(self) -> None:
        value = self._parameters.number
        positive = self._parameters.positive
        self._revision = self._parameters.revision
        self._position_p = (value("MPC_XY_P"), value("MPC_XY_P"), value("MPC_Z_P"))
        self._velocity_p = (
            positive("MPC_XY_VEL_P_ACC"),
            positive("MPC_XY_VEL_P_ACC"),
            positive("MPC_Z_VEL_P_ACC"),
        )
        self._velocity_i = (value("MPC_XY_VEL_I_ACC"), value("MPC_XY_VEL_I_ACC"), value("MPC_Z_VEL_I_ACC"))
        self._velocity_d = (value("MPC_XY_VEL_D_ACC"), value("MPC_XY_VEL_D_ACC"), value("MPC_Z_VEL_D_ACC"))
        self._max_xy = value("MPC_XY_VEL_MAX")
        self._max_up = value("MPC_Z_VEL_MAX_UP")
        self._max_down = value("MPC_Z_VEL_MAX_DN")
        tilt_rad = math.radians(min(positive("MPC_TILTMAX_AIR"), MAX_TILT_DEG))
        self._max_sideways_mps2 = GRAVITY_MPS2 * math.tan(tilt_rad)
        self._yaw_p = value("MC_YAW_P")

    def reset(self, yaw_rad: float) -> None:
        """Reset the integrator and hold this yaw (on the ground)."""
        self._integral = (0.0, 0.0, 0.0)
        self.position = self.velocity = NOTHING
        self.acceleration = (0.0, 0.0, 100.0)  # PX4's "idle thrust" setpoint on the ground
        self.yaw_rad = yaw_rad
        self.yaw_rate_radps = 0.0

    def update(
        self,
        dt_s: float,
        setpoint: TrajectorySetpoint,
        position: Vector,
        velocity: Vector,
        acceleration: Vector,
        yaw_rad: float,
        max_up_mps: float = math.inf,
    ) -> Demand:
        """One control step. `max_up_mps` further limits the climb (the take-off ramp)."""
        if self._revision != self._parameters.revision:
            self._load()
        velocity_setpoint = self._velocity_setpoint(setpoint, position, max_up_mps)
        errors, demanded = self._demanded(velocity_setpoint, setpoint.acceleration, velocity, acceleration)
        thrust_mps2, achievable = self._achievable(demanded)
        self._integrate(dt_s, errors, demanded, achievable)
        self.position = setpoint.position
        self.velocity = velocity_setpoint
        self.acceleration = demanded
        roll_rad, pitch_rad = _tilt(achievable[0], achievable[1], yaw_rad)
        return Demand(thrust_mps2, roll_rad, pitch_rad, self._yaw_rate(setpoint, yaw_rad))

    def _demanded(
        self, velocity_setpoint: Vector, feed_forward: Vector, velocity: Vector, acceleration: Vector
    ) -> tuple[Vector, Vector]:
        """The velocity loop: its errors, and the acceleration that it and the feed-forward demand."""
        p_xy, _, p_z = self._velocity_p
        d_xy, _, d_z = self._velocity_d
        north, east, down = velocity_setpoint
        forward_north, forward_east, forward_down = feed_forward
        integral_north, integral_east, integral_down = self._integral
        error_north, north = _axis_demand(
            north, velocity[0], acceleration[0], forward_north, p_xy, integral_north, d_xy
        )
        error_east, east = _axis_demand(
            east, velocity[1], acceleration[1], forward_east, p_xy, integral_east, d_xy
        )
        error_down, down = _axis_demand(
            down, velocity[2], acceleration[2], forward_down, p_z, integral_down, d_z
        )
        return (error_north, error_east, error_down), (north, east, down)

    def _achievable(self, demanded: Vector) -> tuple[float, Vector]:
        """The collective thrust, m/s², and the acceleration within the limits of thrust and tilt."""
        north, east, down = demanded
        lift = GRAVITY_MPS2 - down
        if not LEAST_LIFT_MPS2 <= lift <= MOST_LIFT_MPS2:
            lift = min(max(lift, LEAST_LIFT_MPS2), MOST_LIFT_MPS2)
        # horizontal demand is relative to hover (MPC_ACC_DECOUPLE): tilt as in level flight
        sideways = math.hypot(north, east)
        if sideways > self._max_sideways_mps2:
            scale = self._max_sideways_mps2 / sideways
            north, east = north * scale, east * scale
        tilt_cosine = GRAVITY_MPS2 / math.sqrt(GRAVITY_MPS2 * GRAVITY_MPS2 + north * north + east * east)
        thrust = lift / tilt_cosine
        if thrust > MAX_THRUST_MPS2:
            thrust = MAX_THRUST_MPS2
        return thrust, (north, east, GRAVITY_MPS2 - thrust * tilt_cosine)

    def _integrate(self, dt_s: float, errors: Vector, demanded: Vector, achievable: Vector) -> None:
        """Advance the integral; back-calculation: a saturated demand must not wind it up."""
        p_xy, _, p_z = self._velocity_p
        i_xy, _, i_z = self._velocity_i
        north, east, down = self._integral
        error_north, error_east, error_down = errors
        share = ANTI_WINDUP / p_xy
        north += i_xy * (error_north - (demanded[0] - achievable[0]) * share) * dt_s
        east += i_xy * (error_east - (demanded[1] - achievable[1]) * share) * dt_s
        down += i_z * (error_down - (demanded[2] - achievable[2]) * ANTI_WINDUP / p_z) * dt_s
        limit = GRAVITY_MPS2
        self._integral = (
            limit if north > limit else -limit if north < -limit else north,
            limit if east > limit else -limit if east < -limit else east,
            limit if down > limit else -limit if down < -limit else down,
        )

    def _velocity_setpoint(self, setpoint: TrajectorySetpoint, position: Vector, max_up_mps: float) -> Vector:
        target_x, target_y, target_z = setpoint.position
        x, y, z = setpoint.velocity
        gain_x, gain_y, gain_z = self._position_p
        if target_x == target_x:
            forward = x if x == x else 0.0
            x = gain_x * (target_x - position[0]) + forward
        if target_y == target_y:
            forward = y if y == y else 0.0
            y = gain_y * (target_y - position[1]) + forward
        if target_z == target_z:
            forward = z if z == z else 0.0
            z = gain_z * (target_z - position[2]) + forward
        if x == x and y == y:
            if math.hypot(x, y) > self._max_xy:
                x, y = _limited(setpoint.velocity[:2], x, y, self._max_xy)
        else:
            x, y = (
                min(max(value, -self._max_xy), self._max_xy) if value == value else NAN for value in (x, y)
            )
        if z == z:
            up = max_up_mps if max_up_mps < self._max_up else self._max_up
            z = -up if z < -up else z
            z = self._max_down if z > self._max_down else z
        return (x, y, z)

    def _yaw_rate(self, setpoint: TrajectorySetpoint, yaw_rad: float) -> float:
        rate = setpoint.yaw_rate_radps if setpoint.yaw_rate_radps == setpoint.yaw_rate_radps else 0.0
        self.yaw_rate_radps = rate
        if setpoint.yaw_rad == setpoint.yaw_rad:
            self.yaw_rad = math.remainder(setpoint.yaw_rad, math.tau)
        elif rate != 0.0:
            self.yaw_rad = yaw_rad
            return rate
        return rate + self._yaw_p * math.remainder(self.yaw_rad - yaw_rad, math.tau)


def _axis_demand(
    setpoint_mps: float,
    mps: float,
    mps2: float,
    feed_forward_mps2: float,
    p: float,
    integral: float,
    d: float,
) -> tuple[float, float]:
    """The velocity error of one axis, m/s, and its demanded acceleration, m/s²; NaN: not controlled."""
    error = demand = 0.0
    if setpoint_mps == setpoint_mps:
        error = setpoint_mps - mps
        demand = p * error + integral - d * mps2
    if feed_forward_mps2 == feed_forward_mps2:
        demand += feed_forward_mps2
    if not -MAX_DEMAND_MPS2 < demand < MAX_DEMAND_MPS2:
        demand = min(max(demand, -MAX_DEMAND_MPS2), MAX_DEMAND_MPS2)
    return error, demand


def _limited(feed_forward: tuple[float, float], x: float, y: float, limit: float) -> tuple[float, float]:
    """A horizontal velocity within a limit; the position's part has priority over the feed-forward."""
    ahead_x, ahead_y = (value if value == value else 0.0 for value in feed_forward)
    to_x, to_y = x - ahead_x, y - ahead_y
    to, ahead = math.hypot(to_x, to_y), math.hypot(ahead_x, ahead_y)
    if to >= limit:
        return to_x / to * limit, to_y / to * limit
    if ahead == 0.0:
        return x, y
    # the share of the feed-forward at which the sum has the length of the limit
    along = (to_x * ahead_x + to_y * ahead_y) / ahead
    share = (math.sqrt(along * along + limit * limit - to * to) - along) / ahead
    return to_x + share * ahead_x, to_y + share * ahead_y


def _tilt(ax: float, ay: float, yaw_rad: float) -> tuple[float, float]:
    """(roll, pitch) whose thrust accelerates by (ax, ay) and carries the weight."""
    cosine, sine = math.cos(yaw_rad), math.sin(yaw_rad)
    forward = cosine * ax + sine * ay
    right = -sine * ax + cosine * ay
    pitch = math.atan2(-forward, GRAVITY_MPS2)
    roll = math.atan2(right * math.cos(pitch), GRAVITY_MPS2)
    return roll, pitch
