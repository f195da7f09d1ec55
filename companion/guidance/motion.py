"""Small laws of motion that several behaviours share. Local NED, metres, seconds."""

from __future__ import annotations

import math

from companion.vehicle.state import Vector3, VehicleState

# Answer of a velocity command to an error of position, 1/s: about PX4's own MPC_XY_P and MPC_Z_P.
POSITION_GAIN = 0.9
# How much more is asked for of each m/s that the vehicle is off what is wanted.
VELOCITY_GAIN = 0.5
# Corrections of drift are slow on purpose.
MAX_CORRECTION_MPS = 0.8
# A slow vehicle that is asked to stop flies on for its speed times this.
STOPPING_DELAY_S = 0.5
# Under the envelope's acceleration, so that a vehicle that answers late still stops in time.
STOPPING_MPS2 = 0.7
# `PositionController`: gains of position (1/s), of velocity (as VELOCITY_GAIN), of the integral (1/s²), and
# the integral's limit. Tuned in lockstep in gusts of 0.6 m/s with MPC_XY_VEL_P_ACC 1.2 to 3: 0.17 m
# horizontally (p95), where PX4's own position hold has 0.66 m. Higher gains oscillate at the envelope's
# acceleration limit, and these do at 2 m/s².
HOLD_GAIN = 1.8
HOLD_VELOCITY_GAIN = 1.5
HOLD_DOWN_GAIN = 1.3
HOLD_INTEGRAL_GAIN = 0.4
HOLD_INTEGRAL_MPS = 0.5
# Farther away than this the error is the way to go, not a disturbance to be integrated.
HOLD_INTEGRAL_M = 1.0
# Arrived: within so much of the goal and slower than so much...
ARRIVED_M = 0.3
ARRIVED_MPS = 0.3
# ... at the end of one of these: (distance m, speed m/s, duration s). In strong gusts no vehicle stands as
# still as the first one asks for.
SETTLED = ((ARRIVED_M, ARRIVED_MPS, 1.0), (0.8, 0.8, 4.0))


def position_and_yaw(state: VehicleState) -> tuple[Vector3, float]:
    """Both, of a state that has them. Raises RuntimeError where a requirement was not checked."""
    position, yaw_rad = state.position_ned_m, state.yaw_rad
    if position is None or yaw_rad is None:
        raise RuntimeError("position or attitude is unknown: the behaviour must require POSITION")
    return position, yaw_rad


def home_of(state: VehicleState) -> Vector3:
    """Home, local NED. Raises ValueError with a line for a person while it is not known."""
    if state.home_position_ned_m is None:
        raise ValueError("the vehicle has not told where home is")
    return state.home_position_ned_m


def ground_speed(state: VehicleState) -> float:
    """Horizontal speed, m/s; 0 while the velocity is unknown."""
    north, east, _ = state.velocity_ned_mps or (0.0, 0.0, 0.0)
    return math.hypot(north, east)


def correction(error_m: float, limit_mps: float = MAX_CORRECTION_MPS) -> float:
    """Speed that takes an error of position away."""
    return max(-limit_mps, min(limit_mps, POSITION_GAIN * error_m))


def towards(
    place: Vector3, position: Vector3, gain: float, limit_mps: float = MAX_CORRECTION_MPS
) -> tuple[float, float]:
    """Velocity over ground (north, east) that takes the vehicle to a place."""
    north, east = place[0] - position[0], place[1] - position[1]
    distance = math.hypot(north, east)
    scale = min(gain, limit_mps / distance) if distance > 1e-6 else 0.0
    return (north * scale, east * scale)


def stay_at(place: Vector3, position: Vector3) -> Vector3:
    """Velocity that keeps the vehicle at a place (for setpoints that also carry a yaw rate)."""
    return (*towards(place, position, POSITION_GAIN), correction(place[2] - position[2]))


def pressed(
    wanted: tuple[float, float], state: VehicleState, top_speed_mps: float, gain: float = VELOCITY_GAIN
) -> tuple[float, float]:
    """A velocity over ground, with more of it where the vehicle does not follow; never above the top speed.

    PX4's velocity controller has gathered what drag cost it on the way (MPC_XY_VEL_I_ACC), and goes on with
    that for seconds when it should stop: measured half a metre of overshoot. Asking for more than is wanted
    acts like a higher MPC_XY_VEL_P_ACC: 2.7 instead of 1.8, well inside the range PX4 allows.
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
    """Velocity setpoints that fly to a point and keep the vehicle there, in wind and gusts.

    A velocity proportional to the distance left, more of it where the vehicle does not follow (see
    `pressed`), and an integral near the point.
    """

    def __init__(self) -> None:
        self._integral_mps = (0.0, 0.0)

    def velocity(
        self, goal_ned_m: Vector3, state: VehicleState, dt_s: float, top_speed_mps: float = MAX_CORRECTION_MPS
    ) -> Vector3:
        """The velocity to ask for, local NED m/s.

        Args:
            goal_ned_m: where to stand, local NED. dt_s: since the last call.
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
        north_mps, east_mps = pressed(wanted, state, most_mps, HOLD_VELOCITY_GAIN)
        return (
            north_mps + self._integral_mps[0],
            east_mps + self._integral_mps[1],
            max(-top_speed_mps, min(top_speed_mps, HOLD_DOWN_GAIN * down)),
        )


class Arrival:
    """Whether the vehicle has arrived: near its goal, slow, and settled there."""

    def __init__(self) -> None:
        self._since_ns: list[int | None] = [None] * len(SETTLED)

    def update(self, distance_m: float, speed_mps: float, now_ns: int, near_m: float = ARRIVED_M) -> bool:
        """Call at every update with the distance to the goal and the speed. `near_m`: `ARRIVED_M` or less."""
        arrived = False
        for index, (tolerance_m, slow_mps, lasting_s) in enumerate(SETTLED):
            since_ns = self._since_ns[index]
            allowed_m = near_m if index == 0 else tolerance_m
            if not (distance_m <= allowed_m and speed_mps <= slow_mps):
                self._since_ns[index] = None
            elif since_ns is None:
                self._since_ns[index] = now_ns
            elif now_ns - since_ns >= lasting_s * 1e9:
                arrived |= distance_m <= near_m and speed_mps <= ARRIVED_MPS
        return arrived


def in_degrees(bearing_rad: float) -> int:
    """A bearing as people write it: 0..359."""
    return round(math.degrees(bearing_rad)) % 360


def laps_text(laps: float) -> str:
    """A number of laps as people say it."""
    return "1 lap" if laps == 1.0 else f"{laps:g} laps"
