"""The offboard setpoint messages as PX4's MAVLink receiver reads them.

SET_POSITION_TARGET_LOCAL_NED and SET_POSITION_TARGET_GLOBAL_INT become the input of the controller, a
`TrajectorySetpoint`. SET_ATTITUDE_TARGET is ignored.
"""

from __future__ import annotations

import math
from typing import Any

from mavlink_sim.flight.position_control import NAN, NOTHING, TrajectorySetpoint
from mavlink_sim.physics.geography import HOME_ALTITUDE_M, LocalFrame
from mavlink_sim.physics.rotations import Vector

LOCAL_NED = 1  # MAV_FRAME_LOCAL_NED
BODY_NED = 8  # MAV_FRAME_BODY_NED
GLOBAL_INT = 5  # MAV_FRAME_GLOBAL_INT
GLOBAL_RELATIVE_ALT_INT = 6  # MAV_FRAME_GLOBAL_RELATIVE_ALT_INT
GLOBAL_TERRAIN_ALT_INT = 11  # MAV_FRAME_GLOBAL_TERRAIN_ALT_INT

# POSITION_TARGET_TYPEMASK
POSITION_IGNORE = (1, 2, 4)
VELOCITY_IGNORE = (8, 16, 32)
ACCELERATION_IGNORE = (64, 128, 256)
FORCE = 512
YAW_IGNORE = 1024
YAW_RATE_IGNORE = 2048


class SetpointRejectedError(ValueError):
    """PX4 drops this setpoint; the text is the STATUSTEXT it sends (without the closing tab)."""


def trajectory_setpoint(
    message: Any, yaw_rad: float, roll_rad: float = 0.0, pitch_rad: float = 0.0
) -> TrajectorySetpoint:
    """The setpoint of a SET_POSITION_TARGET_LOCAL_NED message to a vehicle with this attitude.

    In LOCAL_NED each axis is used unless its ignore bit is set. In BODY_NED the position is always ignored,
    the velocity is turned by the vehicle's yaw (not by its tilt), the acceleration by its whole attitude, and
    one ignored axis disables all three.

    Raises:
        SetpointRejectedError: another frame, force setpoints, or nothing left to control.
    """
    mask = int(message.type_mask)
    frame = int(message.coordinate_frame)
    velocity = (message.vx, message.vy, message.vz)
    acceleration = (message.afx, message.afy, message.afz)
    if frame == LOCAL_NED:
        position = _kept((message.x, message.y, message.z), mask, POSITION_IGNORE)
        velocity = _kept(velocity, mask, VELOCITY_IGNORE)
        acceleration = _kept(acceleration, mask, ACCELERATION_IGNORE)
    elif frame == BODY_NED:
        position = NOTHING
        velocity = NOTHING if mask & sum(VELOCITY_IGNORE) else _turned(velocity, 0.0, 0.0, yaw_rad)
        acceleration = (
            NOTHING
            if mask & sum(ACCELERATION_IGNORE)
            else _turned(acceleration, roll_rad, pitch_rad, yaw_rad)
        )
    else:
        raise SetpointRejectedError(f"SET_POSITION_TARGET_LOCAL_NED coordinate frame {frame} unsupported")
    if mask & FORCE and _any_finite(acceleration):
        raise SetpointRejectedError("SET_POSITION_TARGET_LOCAL_NED force not supported")
    if not _any_finite(position, velocity, acceleration):
        raise SetpointRejectedError("SET_POSITION_TARGET_LOCAL_NED invalid")
    return TrajectorySetpoint(position, velocity, acceleration, *_heading(message, mask))


def global_trajectory_setpoint(
    message: Any, frame: LocalFrame, home_altitude_m: float | None, ground_altitude_m: float = HOME_ALTITUDE_M
) -> TrajectorySetpoint | None:
    """The setpoint of a SET_POSITION_TARGET_GLOBAL_INT message; None where PX4 drops it silently.

    The position is used as a whole: one ignored axis disables all three, and then the frame is irrelevant.
    Only the _INT frames are known; velocity and acceleration are NED and each axis has its own ignore bit.
    Altitudes relative to home are computed as in PX4, with the wrong sign of home altitude minus origin
    altitude: with a home 2 m above the origin the goal is 4 m too low.

    Args:
        frame: the vehicle's local frame.
        home_altitude_m: of home, AMSL; None before the vehicle has a position: then positions are dropped.
        ground_altitude_m: of the terrain below the vehicle, AMSL.

    Raises:
        SetpointRejectedError: a position in another frame, or force setpoints.
    """
    mask = int(message.type_mask)
    mav_frame = int(message.coordinate_frame)
    position = NOTHING
    if not mask & sum(POSITION_IGNORE):
        if home_altitude_m is None:
            return None
        altitude = float(message.alt)
        if mav_frame == GLOBAL_RELATIVE_ALT_INT:
            altitude = 2.0 * HOME_ALTITUDE_M - home_altitude_m + altitude
        elif mav_frame == GLOBAL_TERRAIN_ALT_INT:
            altitude += ground_altitude_m
        elif mav_frame != GLOBAL_INT:
            raise SetpointRejectedError(
                f"SET_POSITION_TARGET_GLOBAL_INT invalid coordinate frame {mav_frame}"
            )
        position = _finite(frame.local(message.lat_int / 1e7, message.lon_int / 1e7, altitude))
    velocity = _kept((message.vx, message.vy, message.vz), mask, VELOCITY_IGNORE)
    acceleration = _kept((message.afx, message.afy, message.afz), mask, ACCELERATION_IGNORE)
    if mask & FORCE and _any_finite(acceleration):
        raise SetpointRejectedError("SET_POSITION_TARGET_GLOBAL_INT force not supported")
    if not _any_finite(position, velocity, acceleration):
        return None
    return TrajectorySetpoint(position, velocity, acceleration, *_heading(message, mask))


def flyable(setpoint: TrajectorySetpoint) -> TrajectorySetpoint:
    """The setpoint itself, or "stop and wait" where PX4's position controller cannot follow it.

    Every axis needs a position, a velocity or an acceleration, and north and east of each come in pairs.
    """
    # unrolled for speed: a stream of setpoints takes a tenth of a flight in lockstep
    x, y, z = setpoint.position
    vx, vy, vz = setpoint.velocity
    ax, ay, az = setpoint.acceleration
    complete = (
        (x == x or vx == vx or ax == ax)
        and (y == y or vy == vy or ay == ay)
        and (z == z or vz == vz or az == az)
    )
    paired = (x == x) == (y == y) and (vx == vx) == (vy == vy) and (ax == ax) == (ay == ay)
    return setpoint if complete and paired else TrajectorySetpoint(velocity=(0.0, 0.0, 0.0))


def _heading(message: Any, mask: int) -> tuple[float, float]:
    """(yaw, yaw rate) of either position target message."""
    return (
        NAN if mask & YAW_IGNORE else _number(message.yaw),
        NAN if mask & YAW_RATE_IGNORE else _number(message.yaw_rate),
    )


def _number(value: float) -> float:
    return float(value) if math.isfinite(value) else NAN


def _finite(values: Vector) -> Vector:
    x, y, z = (_number(value) for value in values)
    return (x, y, z)


def _any_finite(*vectors: Vector) -> bool:
    return any(math.isfinite(x) or math.isfinite(y) or math.isfinite(z) for x, y, z in vectors)


def _kept(values: Vector, mask: int, bits: tuple[int, int, int]) -> Vector:
    x, y, z = values
    bit_x, bit_y, bit_z = bits
    if mask & bit_x and mask & bit_y and mask & bit_z:
        return NOTHING
    return (
        NAN if mask & bit_x else _number(x),
        NAN if mask & bit_y else _number(y),
        NAN if mask & bit_z else _number(z),
    )


def _turned(values: Vector, roll_rad: float, pitch_rad: float, yaw_rad: float) -> Vector:
    """A body vector in NED."""
    x, y, z = values
    if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(z)):
        return NOTHING
    cr, sr = math.cos(roll_rad), math.sin(roll_rad)
    cp, sp = math.cos(pitch_rad), math.sin(pitch_rad)
    cy, sy = math.cos(yaw_rad), math.sin(yaw_rad)
    return (
        cy * cp * x + (cy * sp * sr - sy * cr) * y + (cy * sp * cr + sy * sr) * z,
        sy * cp * x + (sy * sp * sr + cy * cr) * y + (sy * sp * cr - cy * sr) * z,
        -sp * x + cp * sr * y + cp * cr * z,
    )
