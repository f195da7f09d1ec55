"""Motion control laws shared by behaviours. Local NED, metres, seconds."""

from __future__ import annotations

import math
from dataclasses import replace

from companion.vehicle.global_position import Anchor, global_problem
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import LandedState, Vector3, VehicleState, with_fields

# Gain from position error to velocity, 1/s: about PX4's own MPC_XY_P and MPC_Z_P.
POSITION_GAIN = 0.9
# Above this speed a vehicle that is to stand brakes before it holds its position, else it would fly back.
STANDING_MPS = 0.5
# Extra velocity commanded per m/s of velocity error.
VELOCITY_GAIN = 0.5
# Limit of drift corrections.
MAX_CORRECTION_MPS = 0.8
# Stopping distance of a slow vehicle: its speed times this.
STOPPING_DELAY_S = 0.5
# Below the envelope's acceleration, so that a vehicle with delay still stops in time.
STOPPING_MPS2 = 0.7
# `PositionController`: gains of position (1/s), of velocity (as VELOCITY_GAIN), of the integral (1/s²), and
# the integral's limit. Tuned in lockstep in gusts of 0.6 m/s with MPC_XY_VEL_P_ACC 1.2 to 3; PX4's own
# position hold moves by 0.66 m there. Higher gains oscillate at the envelope's acceleration limit, and these
# do at 2 m/s².
HOLD_GAIN = 2.0
HOLD_VELOCITY_GAIN = 1.5
HOLD_DOWN_GAIN = 1.3
HOLD_DOWN_VELOCITY_GAIN = 1.0
HOLD_INTEGRAL_GAIN = 0.4
HOLD_INTEGRAL_MPS = 0.5
# Farther away than this the error is remaining distance, not a disturbance to integrate.
HOLD_INTEGRAL_M = 1.0
# `VelocityBias`: natural frequency and damping of the observer, and the limits of its result and its error.
BIAS_FREQUENCY_RADPS, BIAS_DAMPING = 2.4, 0.8
# A larger error is a jump of the estimate: the observer starts again, as after a gap of the telemetry, above
# which it would not be stable.
MAX_BIAS_MPS, MAX_BIAS_ERROR_M, MAX_BIAS_GAP_S = 0.8, 0.5, 0.3
# Arrived: within this distance of the goal and slower than this...
ARRIVED_M = 0.3
ARRIVED_MPS = 0.3
# ... at the end of one of these: (distance m, speed m/s, duration s). In strong gusts no vehicle meets the
# first one.
SETTLED = ((ARRIVED_M, ARRIVED_MPS, 1.0), (0.8, 0.8, 4.0))
# A goal at a limit of height counts as reached from here. The envelope allows 0.8 m/s per metre that is left
# (FENCE_GAIN_PER_S): with an estimate of the vertical speed that is wrong by 0.8 m/s the vehicle stops there.
AT_LIMIT_M = 1.0


def position_and_yaw(state: VehicleState) -> tuple[Vector3, float]:
    """Position (local NED) and yaw. Raises RuntimeError where either is unknown (unchecked requirement)."""
    position, yaw_rad = state.position_ned_m, state.yaw_rad
    if position is None or yaw_rad is None:
        raise RuntimeError("position or attitude is unknown: the behaviour must require POSITION")
    return position, yaw_rad


def home_of(state: VehicleState) -> Vector3:
    """Home, local NED. Raises ValueError with a line for a person while it is unknown."""
    if state.home_position_ned_m is None:
        raise ValueError("home position not received")
    return state.home_position_ned_m


def local_from_global(
    state: VehicleState, now_ns: int, latitude_longitude_deg: tuple[float, float]
) -> tuple[float, float]:
    """North and east of a place (WGS 84) in local NED. Raises ValueError where the vehicle's is unknown."""
    anchor = Anchor.of(state, now_ns)
    if anchor is None:
        raise ValueError(global_problem(state, now_ns))
    return anchor.local(*latitude_longitude_deg, anchor.altitude_m)[:2]


def ground_speed(state: VehicleState) -> float:
    """Horizontal speed, m/s; 0 while the velocity is unknown."""
    north, east, _ = state.velocity_ned_mps or (0.0, 0.0, 0.0)
    return math.hypot(north, east)


def correction(error_m: float, limit_mps: float = MAX_CORRECTION_MPS) -> float:
    """Velocity that corrects a position error, m/s."""
    return max(-limit_mps, min(limit_mps, POSITION_GAIN * error_m))


def towards(
    point: Vector3, position: Vector3, gain: float, limit_mps: float = MAX_CORRECTION_MPS
) -> tuple[float, float]:
    """Horizontal velocity (north, east) towards a point."""
    north, east = point[0] - position[0], point[1] - position[1]
    distance = math.hypot(north, east)
    scale = min(gain, limit_mps / distance) if distance > 1e-6 else 0.0
    return (north * scale, east * scale)


def add_velocity_error(
    wanted: tuple[float, float], state: VehicleState, top_speed_mps: float, gain: float = VELOCITY_GAIN
) -> tuple[float, float]:
    """A horizontal velocity command plus a share of the velocity error, limited to the top speed.

    The integral of PX4's velocity controller (MPC_XY_VEL_I_ACC) has compensated drag and persists for seconds
    when the vehicle should stop: 0.5 m of overshoot measured. The extra command acts like a higher
    MPC_XY_VEL_P_ACC: 2.7 instead of 1.8, well inside the range PX4 allows.
    """
    north_mps, east_mps, _ = state.velocity_ned_mps or (*wanted, 0.0)
    north = wanted[0] + gain * (wanted[0] - north_mps)
    east = wanted[1] + gain * (wanted[1] - east_mps)
    speed = math.hypot(north, east)
    scale = min(1.0, top_speed_mps / speed) if speed > 1e-6 else 1.0
    return (north * scale, east * scale)


def stopping_speed(
    error_m: float, top_speed_mps: float, deceleration_mps2: float, gain: float = POSITION_GAIN
) -> float:
    """Signed speed towards a stop `error_m` ahead: full speed, then √(2·a·s), then proportional."""
    distance = abs(error_m)
    speed = min(top_speed_mps, math.sqrt(2.0 * deceleration_mps2 * distance), gain * distance)
    return math.copysign(speed, error_m)


def stopping_point(state: VehicleState) -> Vector3:
    """Where a slow vehicle comes to rest, local NED."""
    position, _ = position_and_yaw(state)
    velocity = state.velocity_ned_mps or (0.0, 0.0, 0.0)
    north, east, down = (p + v * STOPPING_DELAY_S for p, v in zip(position, velocity, strict=True))
    return (north, east, down)


def speed_of(state: VehicleState) -> float:
    """Speed in all three axes, m/s; 0 while the velocity is unknown."""
    return math.hypot(*(state.velocity_ned_mps or (0.0,)))


class PositionController:
    """Velocity setpoints that fly to a point and hold it in wind and gusts.

    A velocity proportional to the distance left, the velocity error (see `add_velocity_error`), and an
    integral near the point.
    """

    def __init__(self) -> None:
        self._integral_mps = (0.0, 0.0)
        self._down_integral_mps = 0.0

    def velocity(
        self, goal_ned_m: Vector3, state: VehicleState, dt_s: float, top_speed_mps: float = MAX_CORRECTION_MPS
    ) -> Vector3:
        """The velocity command, local NED m/s.

        Args:
            goal_ned_m: point to hold, local NED. dt_s: since the last call.
            top_speed_mps: horizontally, and vertically.

        Raises:
            RuntimeError: the position or the attitude is unknown.
        """
        position, _ = position_and_yaw(state)
        north, east, down = (g - p for g, p in zip(goal_ned_m, position, strict=True))
        distance = math.hypot(north, east)
        speed = stopping_speed(distance, top_speed_mps, STOPPING_MPS2, HOLD_GAIN)
        scale = speed / distance if distance > 1e-6 else 0.0
        if distance < HOLD_INTEGRAL_M:
            gain = HOLD_INTEGRAL_GAIN * dt_s
            integral = (self._integral_mps[0] + gain * north, self._integral_mps[1] + gain * east)
            shorten = min(1.0, HOLD_INTEGRAL_MPS / max(math.hypot(*integral), 1e-6))
            self._integral_mps = (integral[0] * shorten, integral[1] * shorten)
        else:
            self._integral_mps = (0.0, 0.0)
        wanted = (north * scale, east * scale)
        most_mps = top_speed_mps + HOLD_INTEGRAL_MPS
        north_mps, east_mps = add_velocity_error(wanted, state, most_mps, HOLD_VELOCITY_GAIN)
        return (
            north_mps + self._integral_mps[0],
            east_mps + self._integral_mps[1],
            self._down_mps(down, state, dt_s, top_speed_mps),
        )

    def _down_mps(self, down_m: float, state: VehicleState, dt_s: float, top_speed_mps: float) -> float:
        """The same control law vertically."""
        wanted = max(-top_speed_mps, min(top_speed_mps, HOLD_DOWN_GAIN * down_m))
        down_mps = wanted if state.velocity_ned_mps is None else state.velocity_ned_mps[2]
        integral = self._down_integral_mps + HOLD_INTEGRAL_GAIN * dt_s * down_m
        near = abs(down_m) < HOLD_INTEGRAL_M
        self._down_integral_mps = max(-HOLD_INTEGRAL_MPS, min(HOLD_INTEGRAL_MPS, integral)) if near else 0.0
        asked = wanted + HOLD_DOWN_VELOCITY_GAIN * (wanted - down_mps) + self._down_integral_mps
        return max(-top_speed_mps, min(top_speed_mps, asked))


class Standing:
    """Brakes, then holds where the vehicle comes to rest.

    Attributes:
        point: held, local NED metres; None: it still brakes.
    """

    def __init__(self, point: Vector3 | None = None) -> None:
        self.point = point
        self._controller = PositionController()

    def velocity(self, state: VehicleState, dt_s: float) -> Vector3:
        """The velocity command, local NED m/s; arguments and errors as of `PositionController.velocity`."""
        if self.point is None and speed_of(state) < STANDING_MPS:
            self.point = stopping_point(state)
        if self.point is None:
            # Opposes the motion: PX4's integral would carry the vehicle on for seconds.
            return (*add_velocity_error((0.0, 0.0), state, ground_speed(state), HOLD_VELOCITY_GAIN), 0.0)
        return self._controller.velocity(self.point, state, dt_s)

    def setpoint(self, state: VehicleState, now_ns: int, dt_s: float, yaw_rad: float | None) -> Setpoint:
        """The same as a setpoint. `yaw_rad`: of the nose; None: it does not turn."""
        rate_radps = 0.0 if yaw_rad is None else None
        velocity = self.velocity(state, dt_s)
        return Setpoint.velocity(velocity, now_ns, yaw_rad=yaw_rad, yaw_rate_radps=rate_radps)


class VelocityBias:
    """Difference between the rate of change of the estimated position and the estimated velocity.

    PX4's estimates disagree by 0.3 m/s for seconds (1.17 and 1.18, SIH). The vehicle flies its velocity
    estimate to the setpoint, so its position drifts by the difference. A second-order observer, which gusts
    do not disturb. Behaviours get the velocity that fits the position, and the autopilot gets what they want
    in terms of its own estimate.
    """

    def __init__(self) -> None:
        self._stamp_ns = 0
        # Of the stamp: the predicted position, and the estimated velocity.
        self._predicted: tuple[tuple[float, float], Vector3] | None = None
        # At most `MAX_BIAS_MPS`; 0 on the ground, and while position or velocity is unknown.
        self._bias_mps = (0.0, 0.0)

    def update(self, state: VehicleState) -> None:
        """To be called in every step."""
        position, velocity = state.position_ned_m, state.velocity_ned_mps
        dt_s, self._stamp_ns = (state.position_ns - self._stamp_ns) / 1e9, state.position_ns
        # An estimate that drifts before or at lift-off is no reason to lean there.
        flies = state.landed not in (LandedState.ON_GROUND, LandedState.TAKING_OFF)
        if position is None or velocity is None or not flies or not 0.0 <= dt_s <= MAX_BIAS_GAP_S:
            self._predicted, self._bias_mps = None, (0.0, 0.0)
            return
        if self._predicted is None:
            self._predicted = position[:2], velocity
            return
        predicted = [
            p + (0.5 * (before + v) + b) * dt_s
            for p, before, v, b in zip(*self._predicted, velocity, self._bias_mps, strict=False)
        ]
        error = (position[0] - predicted[0], position[1] - predicted[1])
        if math.hypot(*error) > MAX_BIAS_ERROR_M:
            predicted, error, self._bias_mps = [*position[:2]], (0.0, 0.0), (0.0, 0.0)
        gain = 2.0 * BIAS_DAMPING * BIAS_FREQUENCY_RADPS * dt_s
        self._predicted = (predicted[0] + gain * error[0], predicted[1] + gain * error[1]), velocity
        bias = [b + BIAS_FREQUENCY_RADPS**2 * e * dt_s for b, e in zip(self._bias_mps, error, strict=True)]
        shorten = min(1.0, MAX_BIAS_MPS / max(math.hypot(*bias), 1e-6))
        self._bias_mps = (bias[0] * shorten, bias[1] * shorten)

    def fitting(self, state: VehicleState) -> VehicleState:
        """The state with the velocity at which its position changes."""
        if state.velocity_ned_mps is None or self._bias_mps == (0.0, 0.0):
            return state
        return with_fields(state, velocity_ned_mps=self._plus(state.velocity_ned_mps, 1.0))

    def command(self, setpoint: Setpoint, top_mps: float) -> Setpoint:
        """The setpoint that changes the position at a setpoint's velocity; horizontally at most `top_mps`."""
        if setpoint.velocity_ned_mps is None or self._bias_mps == (0.0, 0.0):
            return setpoint
        north, east, down_mps = self._plus(setpoint.velocity_ned_mps, -1.0)
        shorten = min(1.0, top_mps / max(math.hypot(north, east), 1e-6))
        return replace(setpoint, velocity_ned_mps=(shorten * north, shorten * east, down_mps))

    def _plus(self, velocity_ned_mps: Vector3, share: float) -> Vector3:
        north_mps, east_mps, down_mps = velocity_ned_mps
        return (north_mps + share * self._bias_mps[0], east_mps + share * self._bias_mps[1], down_mps)


class Lasting:
    """Measures for how long a condition has held without interruption."""

    def __init__(self) -> None:
        self._since_ns: int | None = None

    def held_s(self, holds: bool, now_ns: int) -> float:
        """Seconds for which it has held at every update; negative: it does not hold now."""
        if not holds:
            self._since_ns = None
            return -1.0
        if self._since_ns is None:
            self._since_ns = now_ns
        return (now_ns - self._since_ns) / 1e9


class Arrival:
    """Arrival detector: near the goal, slow, and settled there."""

    def __init__(self) -> None:
        self._settled = [Lasting() for _ in SETTLED]

    def update(self, distance_m: float, speed_mps: float, now_ns: int, near_m: float = ARRIVED_M) -> bool:
        """True once arrived. Call it at every update. `near_m`: at most `ARRIVED_M`."""
        arrived = False
        for index, (tolerance_m, slow_mps, lasting_s) in enumerate(SETTLED):
            settles = distance_m <= (near_m if index == 0 else tolerance_m) and speed_mps <= slow_mps
            if self._settled[index].held_s(settles, now_ns) >= lasting_s:
                arrived |= distance_m <= near_m and speed_mps <= ARRIVED_MPS
        return arrived


def in_degrees(bearing_rad: float) -> int:
    """A bearing in whole degrees, 0..359."""
    return round(math.degrees(bearing_rad)) % 360


def laps_text(laps: float) -> str:
    """A number of laps in words."""
    return "1 lap" if laps == 1.0 else f"{laps:g} laps"
