"""SET_POSITION_TARGET_LOCAL_NED as PX4's MAVLink receiver reads it."""

from __future__ import annotations

import math
from typing import Any

from mavlink_sim.control import NAN, NOTHING, TrajectorySetpoint
from mavlink_sim.physics import Vector

LOCAL_NED = 1  # MAV_FRAME_LOCAL_NED
BODY_NED = 8  # MAV_FRAME_BODY_NED

# POSITION_TARGET_TYPEMASK
POSITION_IGNORE = (1, 2, 4)
VELOCITY_IGNORE = (8, 16, 32)
ACCELERATION_IGNORE = (64, 128, 256)
FORCE = 512
YAW_IGNORE = 1024
YAW_RATE_IGNORE = 2048


class SetpointRejectedError(ValueError):
    """PX4 drops this setpoint; the text is the STATUSTEXT it sends (without the closing tab)."""


def trajectory_setpoint(message: Any, yaw_rad: float) -> TrajectorySetpoint:
    """The setpoint of a SET_POSITION_TARGET_LOCAL_NED message.

    In LOCAL_NED each axis counts unless its ignore bit is set. In BODY_NED the position is always ignored,
    the velocity is turned by the vehicle's yaw (not by its tilt), and one ignored axis disables all three.

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
        velocity = NOTHING if mask & sum(VELOCITY_IGNORE) else _turned(velocity, yaw_rad)
        acceleration = NOTHING if mask & sum(ACCELERATION_IGNORE) else _turned(acceleration, yaw_rad)
    else:
        raise SetpointRejectedError(f"SET_POSITION_TARGET_LOCAL_NED coordinate frame {frame} unsupported")
    if mask & FORCE:
        raise SetpointRejectedError("SET_POSITION_TARGET_LOCAL_NED force not supported")
    if not any(math.isfinite(value) for value in (*position, *velocity, *acceleration)):
        raise SetpointRejectedError("SET_POSITION_TARGET_LOCAL_NED invalid")
    return TrajectorySetpoint(
        position,
        velocity,
        acceleration,
        NAN if mask & YAW_IGNORE else float(message.yaw),
        NAN if mask & YAW_RATE_IGNORE else float(message.yaw_rate),
    )


def _kept(values: Vector, mask: int, bits: tuple[int, int, int]) -> Vector:
    x, y, z = (
        NAN if mask & bit or not math.isfinite(value) else float(value)
        for value, bit in zip(values, bits, strict=True)
    )
    return (x, y, z)


def _turned(values: Vector, yaw_rad: float) -> Vector:
    x, y, z = values
    if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(z)):
        return NOTHING
    cosine, sine = math.cos(yaw_rad), math.sin(yaw_rad)
    return (cosine * x - sine * y, sine * x + cosine * y, z)
