"""SET_POSITION_TARGET_LOCAL_NED for a velocity or for a position; who streams it decides the rate."""

from __future__ import annotations

import math
from typing import Any

from mavlink_sim.wire.links import AUTOPILOT_COMPONENT
from mavlink_sim.wire.messages import dialect

# POSITION_TARGET_TYPEMASK: what is to be ignored.
_ONLY_VELOCITY = 0b0001_1100_0111
_ONLY_POSITION = 0b0001_1111_1000
_IGNORE_YAW, _IGNORE_YAW_RATE = 0b0100_0000_0000, 0b1000_0000_0000


def velocity_setpoint(
    north_mps: float, east_mps: float, down_mps: float, yaw_rad: float | None = None, *, system_id: int = 1
) -> Any:
    """A velocity over ground, local NED, metres per second.

    >>> velocity_setpoint(2.0, 0.0, -0.5, yaw_rad=1.5).vx
    2.0

    Args:
        yaw_rad: heading, clockwise from north; None: unchanged (a yaw rate of 0).
        system_id: the vehicle's.

    Raises:
        ValueError: a number is not finite.
    """
    return _setpoint(_ONLY_VELOCITY, (0.0, 0.0, 0.0, north_mps, east_mps, down_mps), yaw_rad, system_id)


def position_setpoint(
    north_m: float, east_m: float, down_m: float, yaw_rad: float | None = None, *, system_id: int = 1
) -> Any:
    """A position, local NED, metres. Otherwise as `velocity_setpoint`."""
    return _setpoint(_ONLY_POSITION, (north_m, east_m, down_m, 0.0, 0.0, 0.0), yaw_rad, system_id)


def _setpoint(mask: int, values: tuple[float, ...], yaw_rad: float | None, system_id: int) -> Any:
    numbers = values if yaw_rad is None else (*values, yaw_rad)
    if not all(math.isfinite(number) for number in numbers):
        raise ValueError(f"a setpoint needs finite numbers, got {values} and yaw {yaw_rad}")
    return dialect.MAVLink_set_position_target_local_ned_message(
        0,
        system_id,
        AUTOPILOT_COMPONENT,
        dialect.MAV_FRAME_LOCAL_NED,
        mask | (_IGNORE_YAW if yaw_rad is None else _IGNORE_YAW_RATE),
        *values,
        0.0,
        0.0,
        0.0,
        yaw_rad or 0.0,
        0.0,
    )
