"""The targets of GUIDED, and how Copter reads them from the position target messages."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from mavlink_sim.flight.position_control import NAN
from mavlink_sim.flight.setpoints import (
    ACCELERATION_IGNORE,
    BODY_NED,
    FORCE,
    GLOBAL_INT,
    GLOBAL_RELATIVE_ALT_INT,
    GLOBAL_TERRAIN_ALT_INT,
    LOCAL_NED,
    POSITION_IGNORE,
    VELOCITY_IGNORE,
    YAW_IGNORE,
    YAW_RATE_IGNORE,
)
from mavlink_sim.physics.geography import HOME_ALTITUDE_M, LocalFrame
from mavlink_sim.physics.rotations import Vector

LOCAL_OFFSET_NED = 7  # MAV_FRAME_LOCAL_OFFSET_NED
BODY_OFFSET_NED = 9  # MAV_FRAME_BODY_OFFSET_NED
GLOBAL = 0  # MAV_FRAME_GLOBAL
GLOBAL_RELATIVE_ALT = 3  # MAV_FRAME_GLOBAL_RELATIVE_ALT
GLOBAL_TERRAIN_ALT = 10  # MAV_FRAME_GLOBAL_TERRAIN_ALT
_BODY = (BODY_NED, BODY_OFFSET_NED)
_LOCAL = (LOCAL_NED, LOCAL_OFFSET_NED, *_BODY)
_ABSOLUTE = (GLOBAL, GLOBAL_INT)
# the ground is flat here: above terrain is above home
_ABOVE_HOME = (GLOBAL_RELATIVE_ALT, GLOBAL_RELATIVE_ALT_INT, GLOBAL_TERRAIN_ALT, GLOBAL_TERRAIN_ALT_INT)
MAX_SANE = 1000.0  # m/s or m/s²: beyond it, or if not finite, ArduPilot stops
MAX_POSITION_M = 1e6


@dataclass(frozen=True, slots=True)
class GuidedTarget:
    """The target of GUIDED: local NED metres and seconds; None: that part is not set.

    `yaw_rad`, `yaw_rate_radps`: NaN for none; with neither, the heading follows the direction of flight.
    """

    position: Vector | None = None
    velocity: Vector | None = None
    acceleration: Vector | None = None
    yaw_rad: float = NAN
    yaw_rate_radps: float = NAN


STOP = GuidedTarget(velocity=(0.0, 0.0, 0.0))


def local_target(message: Any, position: Vector, yaw_rad: float) -> GuidedTarget:
    """The target of a SET_POSITION_TARGET_LOCAL_NED message to a vehicle with this position and heading."""
    frame, mask = int(message.coordinate_frame), int(message.type_mask)
    if frame not in _LOCAL or _asks_for_force(mask):
        return STOP
    heading = yaw_rad if frame in _BODY else 0.0
    point = _given((message.x, message.y, message.z), mask, POSITION_IGNORE, heading)
    if point is not None and frame != LOCAL_NED:
        point = (point[0] + position[0], point[1] + position[1], point[2] + position[2])
    return _combined(message, point, heading)


def global_target(message: Any, local_frame: LocalFrame, home: Vector) -> GuidedTarget:
    """The target of a SET_POSITION_TARGET_GLOBAL_INT message, `home` in local NED."""
    frame, mask = int(message.coordinate_frame), int(message.type_mask)
    if _asks_for_force(mask):
        return STOP
    point = None
    if not mask & sum(POSITION_IGNORE):
        latitude, longitude = message.lat_int / 1e7, message.lon_int / 1e7
        if abs(latitude) > 90.0 or abs(longitude) > 180.0 or not math.isfinite(message.alt):
            return STOP
        if frame in _ABSOLUTE:
            altitude = float(message.alt)
        elif frame in _ABOVE_HOME:
            altitude = HOME_ALTITUDE_M - home[2] + float(message.alt)
        else:
            return STOP
        point = local_frame.local(latitude, longitude, altitude)
    return _combined(message, point, 0.0)


def _combined(message: Any, point: Vector | None, heading_rad: float) -> GuidedTarget:
    mask = int(message.type_mask)
    velocity = _given((message.vx, message.vy, message.vz), mask, VELOCITY_IGNORE, heading_rad)
    acceleration = _given((message.afx, message.afy, message.afz), mask, ACCELERATION_IGNORE, heading_rad)
    for vector, limit in ((point, MAX_POSITION_M), (velocity, MAX_SANE), (acceleration, MAX_SANE)):
        if vector is not None and not all(abs(value) <= limit for value in vector):
            return STOP
    if point is None and velocity is None and acceleration is None:
        return STOP
    if point is not None and velocity is None and acceleration is not None:
        return STOP
    yaw = NAN if mask & YAW_IGNORE or not math.isfinite(message.yaw) else float(message.yaw) + heading_rad
    rate = NAN if mask & YAW_RATE_IGNORE or not math.isfinite(message.yaw_rate) else float(message.yaw_rate)
    return GuidedTarget(point, velocity, acceleration, yaw, rate)


def _asks_for_force(mask: int) -> bool:
    return bool(mask & FORCE) and not mask & sum(ACCELERATION_IGNORE)


def _given(values: Vector, mask: int, ignore: tuple[int, int, int], heading_rad: float) -> Vector | None:
    """The vector rotated by the heading into NED; None if any of its axes is ignored."""
    if mask & sum(ignore):
        return None
    x, y, z = values
    cosine, sine = math.cos(heading_rad), math.sin(heading_rad)
    return (cosine * x - sine * y, sine * x + cosine * y, z)
