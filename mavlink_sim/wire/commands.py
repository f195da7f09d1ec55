"""COMMAND_LONG and COMMAND_INT as one value."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

NOT_GIVEN = 2**31 - 1  # x and y of COMMAND_INT
NAN_AS_INTEGER = 0x7FF80000


@dataclass(frozen=True, slots=True)
class Command:
    """A command; of its parameters, 5 and 6 are latitude and longitude in degrees, 7 is AMSL metres."""

    identifier: int
    parameters: tuple[float, float, float, float, float, float, float]
    source_component: int
    source_system: int = 0


def command_of(message: Any) -> Command:
    """The command of a COMMAND_LONG or COMMAND_INT message."""
    if message.get_type() == "COMMAND_INT":
        # both INT32_MAX: "not given", as NaN in COMMAND_LONG. PX4 ignores the frame, z is always AMSL
        given = (message.x, message.y) != (NOT_GIVEN, NOT_GIVEN)
        point = (message.x / 1e7, message.y / 1e7) if given else (math.nan, math.nan)
        tail = (*point, message.z)
    else:
        tail = (message.param5, message.param6, message.param7)
    head = (message.param1, message.param2, message.param3, message.param4)
    return Command(int(message.command), head + tail, message.get_srcComponent(), message.get_srcSystem())


def is_misencoded(message: Any) -> bool:
    """Whether the position of a COMMAND_INT is a float NaN stored as an integer; PX4 denies it."""
    return message.get_type() == "COMMAND_INT" and (message.x, message.y) == (NAN_AS_INTEGER, NAN_AS_INTEGER)
