"""Other programs that command the same vehicle; a companion service is detected by its HEARTBEAT.

The type does not identify it: MAVROS, a camera or a logger sends the same type and may have the same
component id. So this service identifies itself in `custom_mode`, which MAVLink leaves to the sender and no
autopilot reads from an onboard controller:

    bits 31..20  0xC0D
    bit  19      in command now
    bits 18..0   uptime, seconds (at most 6 days)

Neither ArduPilot nor a MAVLink router forwards a HEARTBEAT to a link from which it has received the same
system and component id. So each service has another component id (`companion.vehicle.own_address`). ArduPilot
forwards a NAMED_VALUE_INT nevertheless, so the number is also sent to it as one.
"""

from __future__ import annotations

from dataclasses import dataclass

from companion.vehicle.gimbal import Address

ONBOARD_CONTROLLER = 18  # MAV_TYPE
NAME = b"companion"  # of the NAMED_VALUE_INT
_MARK, _MARK_SHIFT = 0xC0D, 20
_IN_COMMAND = 1 << 19
_LONGEST_S = _IN_COMMAND - 1


@dataclass(frozen=True, slots=True)
class Commander:
    """Another companion service.

    Attributes:
        address: system and component id of its messages.
        received_ns: arrival of its newest heartbeat, CLOCK_MONOTONIC.
        uptime_s, in_command: as reported in that heartbeat.
    """

    address: Address
    received_ns: int
    uptime_s: float
    in_command: bool


@dataclass(frozen=True, slots=True)
class ForeignSetpoint:
    """A setpoint of another program, which the autopilot follows at times instead of ours.

    Attributes:
        stamp_ns: when it was last confirmed. since_ns: the first of those that count. CLOCK_MONOTONIC.
        sent, followed: ours at that time, and what the autopilot reported to follow, as text.
    """

    stamp_ns: int
    since_ns: int
    sent: str
    followed: str


def commander_mode(uptime_s: float, in_command: bool) -> int:
    """Encode the `custom_mode` of our own heartbeat."""
    seconds = min(int(uptime_s), _LONGEST_S)
    return _MARK << _MARK_SHIFT | (_IN_COMMAND if in_command else 0) | seconds


def read_commander(mav_type: int, custom_mode: int, address: Address, received_ns: int) -> Commander | None:
    """Decode the sender of a heartbeat; None if it is not a companion service."""
    if mav_type != ONBOARD_CONTROLLER or custom_mode >> _MARK_SHIFT != _MARK:
        return None
    uptime_s = float(custom_mode & _LONGEST_S)
    return Commander(address, received_ns, uptime_s, bool(custom_mode & _IN_COMMAND))
