"""Another service like ours on the same vehicle, known by its HEARTBEAT.

That an onboard controller is there says nothing of what it does: MAVROS, a camera or a logger sends the same
type and may have the same component id. So a service that commands writes who it is into `custom_mode`, which
MAVLink leaves to the sender and no autopilot reads of an onboard controller:

    bits 31..20  0xC0D
    bit  19      it is in command now
    bits 18..0   for how long it has run, seconds (at most 6 days)

ArduPilot forwards no HEARTBEAT to a link from which the same system and component id has been heard, and all
services have the same. There the number goes out as a NAMED_VALUE_INT too, which is forwarded.
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
    """Another service.

    Attributes:
        address: system and component id of its messages.
        heard_ns: when its newest heartbeat came, CLOCK_MONOTONIC.
        uptime_s: for how long it had run then. in_command: it commanded the vehicle then.
    """

    address: Address
    heard_ns: int
    uptime_s: float
    in_command: bool


def commander_mode(uptime_s: float, in_command: bool) -> int:
    """The `custom_mode` of our own heartbeat."""
    seconds = min(int(uptime_s), _LONGEST_S)
    return _MARK << _MARK_SHIFT | (_IN_COMMAND if in_command else 0) | seconds


def read_commander(mav_type: int, custom_mode: int, address: Address, heard_ns: int) -> Commander | None:
    """Who sent a heartbeat; None: no service of ours."""
    if mav_type != ONBOARD_CONTROLLER or custom_mode >> _MARK_SHIFT != _MARK:
        return None
    uptime_s = float(custom_mode & _LONGEST_S)
    return Commander(address, heard_ns, uptime_s, bool(custom_mode & _IN_COMMAND))
