"""VISION_POSITION_ESTIMATE (MAVLink common, 102): the vehicle's pose from a camera, in local NED.

PX4 and ArduPilot both take it. ODOMETRY they do not take alike: ArduPilot accepts only MAV_FRAME_LOCAL_FRD
with MAV_FRAME_BODY_FRD, which PX4 does not align with north.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.vehicle.state import Vector3


@dataclass(frozen=True, slots=True)
class VisionPosition:
    """Position and attitude of the vehicle at a capture.

    Attributes:
        captured_ns: CLOCK_MONOTONIC of the capture.
        position_ned_m: of the autopilot, in its own local NED (without `VehicleState.reset_offset_ned_m`).
        euler_rad: roll, pitch, yaw.
        covariance: upper right triangle, row by row (21 values), of the position, m², and of rotations about
            north, east and down, rad².
    """

    captured_ns: int
    position_ned_m: Vector3
    euler_rad: Vector3
    covariance: tuple[float, ...]

    def __post_init__(self) -> None:
        values = (*self.position_ned_m, *self.euler_rad, *self.covariance)
        if len(self.covariance) != 21 or not all(math.isfinite(value) for value in values):
            raise ValueError(f"expected 21 covariances and finite values, got {values}")


def vision_position_fields(vision: VisionPosition) -> dict[str, int | float | list[float]]:
    """Return the message's fields."""
    north, east, down = vision.position_ned_m
    roll, pitch, yaw = vision.euler_rad
    return {
        "usec": vision.captured_ns // 1000,
        "x": north,
        "y": east,
        "z": down,
        "roll": roll,
        "pitch": pitch,
        "yaw": yaw,
        "covariance": list(vision.covariance),
        "reset_counter": 0,
    }
