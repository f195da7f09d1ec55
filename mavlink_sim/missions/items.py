"""One item of a mission, a geofence or the rally points: what PX4 stores of a MISSION_ITEM, and returns.

PX4 does not store the message: it keeps the fields that its firmware knows for the command and drops the
rest, so a downloaded plan is not byte for byte the uploaded one.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from mavlink_sim.physics.geography import LocalFrame
from mavlink_sim.physics.rotations import Vector
from mavlink_sim.wire.messages import dialect


class PlanType(IntEnum):
    """The part of MAV_MISSION_TYPE that PX4 stores."""

    MISSION = 0
    FENCE = 1
    RALLY = 2


# MAV_MISSION_RESULT
ACCEPTED = 0
ERROR = 1
UNSUPPORTED_FRAME = 2
UNSUPPORTED = 3
NO_SPACE = 4
INVALID_PARAM1 = 6

# MAV_FRAME
GLOBAL = 0
FRAME_MISSION = 2
GLOBAL_RELATIVE_ALT = 3
GLOBAL_INT = 5
GLOBAL_RELATIVE_ALT_INT = 6
RELATIVE_FRAMES = frozenset({GLOBAL_RELATIVE_ALT, GLOBAL_RELATIVE_ALT_INT})

# MAV_CMD
IDLE = 0
WAYPOINT = 16
LOITER_UNLIMITED = 17
LOITER_TIME = 19
RETURN_TO_LAUNCH = 20
LAND = 21
TAKEOFF = 22
LOITER_TO_ALTITUDE = 31
NAV_ROI = 80
VTOL_TAKEOFF = 84
VTOL_LAND = 85
NAV_DELAY = 93
DO_JUMP = 177
DO_CHANGE_SPEED = 178
DO_LAND_START = 189
SET_ROI_LOCATION = 195
SET_ROI_NEXT_WAYPOINT = 196
SET_ROI_NONE = 197
SET_ROI = 201
DIGICAM_CONTROL = 203
GRIPPER = 211
AUTOTUNE = 212
ARM_DISARM = 400
SET_CAMERA_MODE = 530
SET_CAMERA_SOURCE = 534
GIMBAL_PITCH_YAW = 1000
START_CAPTURE = 2000
STOP_CAPTURE = 2001
START_VIDEO = 2500
STOP_VIDEO = 2501
VTOL_TRANSITION = 3000
GATE = 4501
FENCE_RETURN_POINT = 5000
FENCE_POLYGON_INCLUSION = 5001
FENCE_POLYGON_EXCLUSION = 5002
FENCE_CIRCLE_INCLUSION = 5003
FENCE_CIRCLE_EXCLUSION = 5004
RALLY_POINT = 5100
WINCH = 42600

FENCE_POLYGONS = frozenset({FENCE_POLYGON_INCLUSION, FENCE_POLYGON_EXCLUSION})
FENCE_AND_RALLY_COMMANDS = FENCE_POLYGONS | {FENCE_CIRCLE_INCLUSION, FENCE_CIRCLE_EXCLUSION, RALLY_POINT}
POSITION_COMMANDS = frozenset(
    {WAYPOINT, LOITER_UNLIMITED, LOITER_TIME, LAND, TAKEOFF, LOITER_TO_ALTITUDE, VTOL_TAKEOFF, VTOL_LAND}
)

# Which of parameters 1 to 4 PX4 keeps of an item with a position. 4 is a heading, wrapped to 0-360 degrees.
_KEPT: dict[int, tuple[int, ...]] = {
    WAYPOINT: (1, 2, 4),
    LOITER_UNLIMITED: (3, 4),
    LOITER_TIME: (1, 2, 3, 4),
    LAND: (2, 4),
    TAKEOFF: (4,),
    LOITER_TO_ALTITUDE: (1, 2, 4),
    NAV_ROI: (1,),
    SET_ROI: (1,),
    SET_ROI_LOCATION: (),
    VTOL_TAKEOFF: (4,),
    VTOL_LAND: (4,),
    GATE: (),
    FENCE_RETURN_POINT: (),
    FENCE_POLYGON_INCLUSION: (1,),
    FENCE_POLYGON_EXCLUSION: (1,),
    FENCE_CIRCLE_INCLUSION: (1,),
    FENCE_CIRCLE_EXCLUSION: (1,),
    RALLY_POINT: (),
    ARM_DISARM: (1,),
    AUTOTUNE: (1, 2),
}
_HEADING_COMMANDS = frozenset(
    {WAYPOINT, LOITER_UNLIMITED, LOITER_TIME, LAND, TAKEOFF, VTOL_TAKEOFF, VTOL_LAND}
)
# Commands without a position, frame MAV_FRAME_MISSION: camera, gimbal, trigger and vehicle actions.
_WITHOUT_POSITION_COMMANDS = frozenset(
    {RETURN_TO_LAUNCH, NAV_DELAY, 112, 114, DO_JUMP, DO_CHANGE_SPEED, 179, 187, DO_LAND_START}
    | {NAV_ROI, SET_ROI_NEXT_WAYPOINT, SET_ROI_NONE, 200, SET_ROI, DIGICAM_CONTROL, 204, 205, 206, GRIPPER}
    | {AUTOTUNE, 214, 260, ARM_DISARM, SET_CAMERA_MODE, 532, SET_CAMERA_SOURCE, GIMBAL_PITCH_YAW, 1001}
    | {START_CAPTURE, STOP_CAPTURE, 2003, START_VIDEO, STOP_VIDEO, VTOL_TRANSITION, WINCH}
)
_ROI_NONE, _ROI_NEXT, _ROI_INDEX, _ROI_LOCATION = range(4)  # MAV_ROI

_HASHED = struct.Struct("<BHB7f")
_HASHED_INT = struct.Struct("<BHB4fiif")


class ItemRejectedError(ValueError):
    """PX4 refuses this item. `result` is the MAV_MISSION_RESULT of the answer."""

    def __init__(self, result: int, reason: str) -> None:
        super().__init__(reason)
        self.result = result


@dataclass(frozen=True, slots=True)
class MissionItem:
    """What is stored of an item.

    Attributes:
        command: MAV_CMD. frame: MAV_FRAME, as it was sent.
        parameters: 1 to 7. With a global frame 5 and 6 are degrees, 7 is metres above sea or above home.
        autocontinue: continue with the next item automatically.
    """

    command: int
    frame: int = FRAME_MISSION
    parameters: tuple[float, float, float, float, float, float, float] = (0.0,) * 7
    autocontinue: bool = True

    @property
    def has_position(self) -> bool:
        """Whether the vehicle flies to it (PX4's `item_contains_position`)."""
        return self.command in POSITION_COMMANDS

    @property
    def is_relative(self) -> bool:
        """The altitude is above home."""
        return self.frame in RELATIVE_FRAMES

    @property
    def yaw_rad(self) -> float:
        """The demanded heading, NaN for none."""
        return math.radians(self.parameters[3])

    @property
    def hold_s(self) -> float:
        """Seconds to stay; 0 where the command has no such parameter."""
        if self.command not in (WAYPOINT, LOITER_TIME, NAV_DELAY):
            return 0.0
        return max(self.parameters[0], 0.0) if math.isfinite(self.parameters[0]) else 0.0

    def local_position(self, home: Vector, frame: LocalFrame) -> Vector:
        """Local NED metres of the item, altitudes above home taken from `home` (local NED)."""
        latitude, longitude, altitude = self.parameters[4:]
        if self.is_relative:
            altitude += frame.geographic(home)[2]
        return frame.local(latitude, longitude, altitude)


def item_of(message: Any) -> MissionItem:
    """The item in a MISSION_ITEM_INT or MISSION_ITEM message.

    Raises ItemRejectedError with PX4's MAV_MISSION_RESULT for a frame or a command it does not take.
    """
    whole = message.get_type() == "MISSION_ITEM_INT"
    frame, command = int(message.frame), int(message.command)
    given = (message.param1, message.param2, message.param3, message.param4)
    if frame in (GLOBAL, GLOBAL_RELATIVE_ALT) or (whole and frame in (GLOBAL_INT, GLOBAL_RELATIVE_ALT_INT)):
        scale = 1e-7 if whole else 1.0
        command, head = _with_position(command, given)
        tail = (message.x * scale, message.y * scale, float(message.z))
    elif frame == FRAME_MISSION:
        command, head = _without_position(command, given)
        tail = (float(message.x), float(message.y), float(message.z))
    else:
        raise ItemRejectedError(UNSUPPORTED_FRAME, f"frame {frame} is none of 0, 2, 3, 5, 6")
    return MissionItem(command, frame, head + tail, bool(message.autocontinue))


_Head = tuple[float, float, float, float]


def _with_position(command: int, given: _Head) -> tuple[int, _Head]:
    if command not in _KEPT:
        raise ItemRejectedError(UNSUPPORTED, f"command {command} with a position is not supported")
    kept = [value if index in _KEPT[command] else 0.0 for index, value in enumerate(given, start=1)]
    if command in (NAV_ROI, SET_ROI):
        if _whole(given[0]) not in (_ROI_LOCATION, _ROI_NONE):
            raise ItemRejectedError(INVALID_PARAM1, f"a region of interest with a position, mode {given[0]}")
        command = SET_ROI
    elif command in _HEADING_COMMANDS:
        # Twice: the remainder of a tiny negative angle is 360 itself.
        kept[3] = kept[3] % 360.0 % 360.0 if math.isfinite(kept[3]) else math.nan
    if command == LOITER_TIME:
        kept[1] = float(kept[1] > 0.0)
    elif command == LOITER_TO_ALTITUDE:
        kept[0], kept[3] = float(kept[0] > 0.0), float(kept[3] > 0.0)
    elif command == LAND:
        kept[1] = float(_whole(kept[1]) & 0xFF)
    elif command in FENCE_POLYGONS:
        kept[0] = float(_whole(kept[0] + 0.5) & 0xFFFF)
    return command, (kept[0], kept[1], kept[2], kept[3])


def _without_position(command: int, given: _Head) -> tuple[int, _Head]:
    if command not in _WITHOUT_POSITION_COMMANDS:
        raise ItemRejectedError(UNSUPPORTED, f"command {command} without a position is not supported")
    if command in (NAV_ROI, SET_ROI) and _whole(given[0]) not in (_ROI_NONE, _ROI_NEXT, _ROI_INDEX):
        raise ItemRejectedError(INVALID_PARAM1, f"a region of interest without a position, mode {given[0]}")
    return SET_ROI if command == NAV_ROI else command, given


def _whole(value: float) -> int:
    return int(value) if math.isfinite(value) else 0


def message_of(
    item: MissionItem,
    sequence: int,
    plan: PlanType,
    target: tuple[int, int],
    *,
    current: bool = False,
    whole: bool = True,
) -> Any:
    """MISSION_ITEM_INT (MISSION_ITEM if not `whole`) of a stored item, addressed to (system, component)."""
    frame, x, y = item.frame, item.parameters[4], item.parameters[5]
    if frame != FRAME_MISSION and whole:
        frame = GLOBAL_RELATIVE_ALT_INT if item.is_relative else GLOBAL_INT
        x, y = x * 1e7, y * 1e7
    elif frame != FRAME_MISSION:
        frame = GLOBAL_RELATIVE_ALT if item.is_relative else GLOBAL
    head = list(item.parameters[:4])
    if item.command == LOITER_TIME:
        head[3] = float(head[3] > 0.0)  # PX4 returns whether to exit on a tangent, not the heading
    make = dialect.MAVLink_mission_item_int_message if whole else dialect.MAVLink_mission_item_message
    point = (_int32(x), _int32(y)) if whole else (x, y)
    return make(
        *target,
        sequence,
        frame,
        item.command,
        int(current),
        int(item.autocontinue),
        *head,
        *point,
        item.parameters[6],
        int(plan),
    )


def _int32(value: float) -> int:
    return min(max(round(value), -(2**31)), 2**31 - 1) if math.isfinite(value) else 0


def plan_identifier(messages: Iterable[Any]) -> int:
    """PX4's opaque id of a plan: CRC-32 without inversions over the items as they were sent."""
    crc = 0xFFFFFFFF
    for message in messages:
        layout = _HASHED_INT if message.get_type() == "MISSION_ITEM_INT" else _HASHED
        packed = layout.pack(
            message.frame,
            message.command,
            message.autocontinue,
            message.param1,
            message.param2,
            message.param3,
            message.param4,
            message.x,
            message.y,
            message.z,
        )
        crc = zlib.crc32(packed, crc)
    return crc ^ 0xFFFFFFFF
