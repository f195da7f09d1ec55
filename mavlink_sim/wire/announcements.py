"""Messages that the autopilot sends unrequested: status texts, their events, PX4's gimbal commands."""

from __future__ import annotations

import math
from dataclasses import dataclass

CRITICAL = 2  # MAV_SEVERITY_CRITICAL
INFO = 6  # MAV_SEVERITY_INFO


@dataclass(frozen=True, slots=True)
class Text:
    """A status text and the event (identifier, log levels, arguments) of the same meaning, if PX4 has one.

    An empty text is not sent: PX4 reports some facts by an event only.
    """

    severity: int
    text: str
    event: tuple[int, int, bytes] | None = None


def event_identifier(name: str) -> int:
    """PX4's identifier of an event: 24 bits of its name's FNV-1a hash, marked as the autopilot's (1)."""
    digest = 0x811C9DC5
    for byte in name.encode():
        digest = (digest ^ byte) * 0x01000193 & 0xFFFFFFFF
    return 0x01000000 | digest & 0xFFFFFF


# Event identifiers, log levels and arguments as a PX4 v1.17 emitted them in a recorded flight.
ARMED_EVENT = (0x0190CAF3, 0x66, b"\x04")
TAKEOFF_EVENT = (0x01414569, 0x66, b"")
LANDING_EVENT = (0x0132B2DE, 0x66, b"")
LANDED_EVENT = (0x019638AC, 0x66, b"")
DISARMED_EVENT = 0x01F46777
ARMING_DENIED_EVENT = (0x0102089D, 0x62, b"")
DEFAULT_ALTITUDE_EVENT = 0x013B2FC7

# command, confirmation, its seven parameters
GimbalCommand = tuple[int, int, tuple[float, float, float, float, float, float, float]]
# What PX4 sends to a gimbal at a landing: (seconds since the landing began, command as above).
_TAKE_CONTROL = (1.0, 1.0, -1.0, -1.0, 0.0, 0.0, 0.0)
GIMBAL_COMMANDS: tuple[tuple[float, GimbalCommand], ...] = (
    (0.24, (1001, 0, _TAKE_CONTROL)),
    (0.24, (1000, 0, (math.nan, math.nan, math.nan, math.nan, 2.0, 0.0, 0.0))),
    (0.24, (1001, 0, (-3.0, -3.0, -1.0, -1.0, 0.0, 0.0, 0.0))),
    (1.26, (1001, 1, _TAKE_CONTROL)),
    (1.77, (1001, 2, _TAKE_CONTROL)),
    (2.29, (1001, 3, _TAKE_CONTROL)),
)
