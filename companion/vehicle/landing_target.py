"""LANDING_TARGET (MAVLink common, 149): the position of a landing target, in each autopilot's form.

PX4 takes a position in MAV_FRAME_LOCAL_NED with `position_valid`; it treats angles as those of an infrared
beacon, and refuses any other frame. ArduPilot takes a vector in MAV_FRAME_BODY_FRD with `position_valid` and
`distance`; releases without vector support use the two angles from straight down: `angle_x` to the right,
`angle_y` to the back. Both are relative to the body at the time of capture.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.vehicle.state import Vector3
from companion.vehicle.vehicle_type import ARDUPILOT

FRAME_LOCAL_NED, FRAME_BODY_FRD = 1, 12  # MAV_FRAME
TYPE_VISION_FIDUCIAL = 2  # LANDING_TARGET_TYPE
LARGEST_NUMBER = 255


@dataclass(frozen=True, slots=True)
class LandingTarget:
    """A landing target as detected in one image.

    Attributes:
        captured_ns: CLOCK_MONOTONIC of the capture.
        identifier: of the marker.
        position_ned_m: of its centre, local NED.
        offset_frd_m: from the autopilot to its centre, in the body frame at the capture.
        size_m: side of the marker.
    """

    captured_ns: int
    identifier: int
    position_ned_m: Vector3
    offset_frd_m: Vector3
    size_m: float

    def __post_init__(self) -> None:
        values = (*self.position_ned_m, *self.offset_frd_m, self.size_m)
        if not all(math.isfinite(value) for value in values):
            raise ValueError(f"all values of a landing target must be finite, got {values}")


def landing_target_fields(
    target: LandingTarget, autopilot: int, offset_ned_m: Vector3 = (0.0, 0.0, 0.0)
) -> dict[str, int | float | list[float]]:
    """Return the message's fields for an autopilot (MAV_AUTOPILOT); PX4's form for any but ArduPilot.

    `offset_ned_m` is `VehicleState.reset_offset_ned_m`: the message uses the autopilot's own coordinates.
    """
    forward, right, down = target.offset_frd_m
    distance_m = math.hypot(forward, right, down)
    fields: dict[str, int | float | list[float]] = {
        "time_usec": target.captured_ns // 1000,
        "target_num": min(target.identifier, LARGEST_NUMBER),
        "frame": FRAME_LOCAL_NED,
        "angle_x": 0.0,
        "angle_y": 0.0,
        "distance": distance_m,
        "size_x": 0.0,
        "size_y": 0.0,
        "q": [1.0, 0.0, 0.0, 0.0],
        "type": TYPE_VISION_FIDUCIAL,
        "position_valid": 1,
    }
    north, east, down_m = (p + o for p, o in zip(target.position_ned_m, offset_ned_m, strict=True))
    position = (north, east, down_m)
    if autopilot == ARDUPILOT:
        position = target.offset_frd_m
        fields["frame"] = FRAME_BODY_FRD
    if down > 0.0:
        fields["angle_x"], fields["angle_y"] = math.atan2(right, down), math.atan2(-forward, down)
        fields["size_x"] = fields["size_y"] = 2 * math.atan2(target.size_m / 2, distance_m)
    fields["x"], fields["y"], fields["z"] = position
    return fields
