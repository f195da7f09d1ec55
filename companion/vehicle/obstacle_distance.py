"""OBSTACLE_DISTANCE (MAVLink common, 330): obstacle sectors for the autopilot's own collision prevention.

72 sectors of 5° in MAV_FRAME_BODY_FRD, clockwise from the nose. PX4 uses it in Position mode (`CP_DIST`).
"""

from __future__ import annotations

import math

from vision.obstacle_sectors import SECTOR_RAD, SECTORS, ObstacleSectors

FRAME_BODY_FRD = 12  # MAV_FRAME
TYPE_UNKNOWN = 4  # MAV_DISTANCE_SENSOR
UNKNOWN_CM = 65535  # UINT16_MAX
# PX4 does not brake for a distance at or below the minimum; the maximum plus one means nothing in range.
MINIMUM_CM, MAXIMUM_CM = 10, 2000
SECTOR_DEG = 5


def obstacle_distance_fields(sectors: ObstacleSectors, yaw_rad: float) -> dict[str, int | float | list[int]]:
    """Return the message's fields.

    Args:
        sectors: clockwise from north.
        yaw_rad: the vehicle's newest yaw: the autopilot takes the message as relative to its nose now.
    """
    # The nose's sector comes first; `angle_offset` holds the rest of the rotation, within half a sector.
    first = round(yaw_rad / SECTOR_RAD)
    distances = [_centimetres(sectors.distance_m[(first + index) % SECTORS]) for index in range(SECTORS)]
    return {
        "time_usec": sectors.captured_ns // 1000,
        "sensor_type": TYPE_UNKNOWN,
        "distances": distances,
        "increment": SECTOR_DEG,
        "min_distance": MINIMUM_CM,
        "max_distance": MAXIMUM_CM,
        "increment_f": float(SECTOR_DEG),
        "angle_offset": math.degrees(first * SECTOR_RAD - yaw_rad),
        "frame": FRAME_BODY_FRD,
    }


def _centimetres(distance_m: float) -> int:
    if math.isnan(distance_m):
        return UNKNOWN_CM
    return round(min(max(distance_m * 100.0, MINIMUM_CM + 1.0), MAXIMUM_CM + 1.0))
