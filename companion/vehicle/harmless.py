"""What may be sent to a vehicle that is not flown: requests for data, and the gimbal's commands.

These have the same meaning for every type of vehicle. Everything else is withheld, also what only corrects or
informs the autopilot: VISION_POSITION_ESTIMATE moves its position, OBSTACLE_DISTANCE stops a pilot's flight,
LANDING_TARGET steers its landing, PARAM_SET changes how it flies.
"""

from __future__ import annotations

from companion.vehicle.framing import REQUEST_EVENT_ID, Frame, frames_of

# MAVLink common.
_COMMAND_INT_ID, _COMMAND_LONG_ID = 75, 76
_MESSAGES = frozenset(
    {
        0,  # HEARTBEAT
        4,  # PING
        20,  # PARAM_REQUEST_READ
        21,  # PARAM_REQUEST_LIST
        110,  # FILE_TRANSFER_PROTOCOL: files are only read
        111,  # TIMESYNC
        252,  # NAMED_VALUE_INT
        REQUEST_EVENT_ID,
    }
)
COMMANDS = frozenset(
    {
        511,  # SET_MESSAGE_INTERVAL
        512,  # REQUEST_MESSAGE
        520,  # REQUEST_AUTOPILOT_CAPABILITIES
        1000,  # DO_GIMBAL_MANAGER_PITCHYAW
        1001,  # DO_GIMBAL_MANAGER_CONFIGURE
    }
)
_COMMAND_AT, _COMMAND_END = 28, 30  # of both command messages


def are_harmless(data: bytes) -> bool:
    """Whether bytes of ours are harmless frames and nothing else."""
    frames = list(frames_of(data))
    # What is no frame here may be one to the autopilot, whose definitions may be others.
    return sum(len(frame.raw) for frame in frames) == len(data) and all(map(_is_harmless, frames))


def _is_harmless(frame: Frame) -> bool:
    if frame.message_id in (_COMMAND_LONG_ID, _COMMAND_INT_ID):
        command = frame.padded(_COMMAND_END)[_COMMAND_AT:_COMMAND_END]
        return int.from_bytes(command, "little") in COMMANDS
    return frame.message_id in _MESSAGES
