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


def stopping_speed(error_m: float, top_speed_mps: float, deceleration_mps2: float) -> float:
    """Signed speed towards a stop `error_m` ahead: full speed, then √(2·a·s), then proportional."""
    distance = abs(error_m)
    speed = min(top_speed_mps, math.sqrt(2.0 * deceleration_mps2 * distance), POSITION_GAIN * distance)
    return math.copysign(speed, error_m)


def in_degrees(bearing_rad: float) -> int:
    """A bearing as people write it: 0..359."""
    return round(math.degrees(bearing_rad)) % 360


def laps_text(laps: float) -> str:
    """A number of laps as people say it."""
    return "1 lap" if laps == 1.0 else f"{laps:g} laps"
