"""Who controls the vehicle: after a loss of command no model moves it until an operator has commanded."""

from __future__ import annotations

import re
from collections import deque
from dataclasses import dataclass

from companion.client.commands import NON_FLIGHT
from companion.vehicle.state import FlightMode

STICK_MODES = frozenset(
    {
        FlightMode.MANUAL,
        FlightMode.ACRO,
        FlightMode.STABILIZED,
        FlightMode.ALTITUDE,
        FlightMode.POSITION,
    }
)
# The autopilot flies them, for an operator, a pilot or a failsafe.
AUTOPILOT_MODES = frozenset(
    {
        FlightMode.TAKEOFF,
        FlightMode.MISSION,
        FlightMode.FOLLOW,
        FlightMode.RETURN,
        FlightMode.LAND,
        FlightMode.PRECISION_LAND,
    }
)
_COMMAND = re.compile(r"command: (?P<text>.+?)(?: \(\d+ before it not logged\))?")
_LOST = "command lost: "
_IN_PROGRESS = re.compile(r"(?P<text>.+): in progress(; took over from .+)?")
_KEPT_SENT = 50


@dataclass(frozen=True, slots=True)
class Control:
    """Who controls the vehicle.

    Attributes:
        lost: why command was lost, until the next command that flies; None: it was not.
        mode: the flight mode of an armed vehicle; empty: disarmed.
        active: the active endless command of this program; None: none is.
    """

    lost: str | None = None
    mode: str = ""
    active: str | None = None

    def taken(self, *, flying: bool = False) -> str | None:
        """Why no model may move the vehicle; None: it may. `flying`: a command of this program is active."""
        if self.lost is not None:
            return f"command was lost ({self.lost})"
        if self.mode in STICK_MODES or (self.mode in AUTOPILOT_MODES and not flying):
            return f"the vehicle flies in {self.mode.replace('_', ' ')} mode, chosen by someone else"
        return None


class CommandEvents:
    """What the service's events report about commands, read in their order.

    Attributes:
        lost, active: as in `Control`.
    """

    def __init__(self) -> None:
        self.lost: str | None = None
        self.active: str | None = None
        self._sent: deque[str] = deque(maxlen=_KEPT_SENT)

    def send(self, text: str) -> None:
        """Note a command of this program, before it is sent."""
        line = text.partition("\n")[0]
        if line.split(" ")[0] not in NON_FLIGHT - {"stop"}:
            self._sent.append(line)

    def take(self, level: str, text: str) -> None:
        """Read an event."""
        if (found := _COMMAND.fullmatch(text)) is not None:
            self._begun(found["text"])
        elif text.startswith(_LOST):
            self.lost, self.active = text.removeprefix(_LOST), None
        elif (found := _IN_PROGRESS.fullmatch(text)) is not None:
            self.active = found["text"] if found["text"] in self._sent else None
        elif self.active is not None and self._ends(self.active, level, text):
            self.active = None

    def _begun(self, command: str) -> None:
        word = command.split(" ")[0]
        if word not in NON_FLIGHT:
            self.lost = None
        if command not in self._sent and word not in NON_FLIGHT - {"stop"}:
            self.active = None

    def _ends(self, active: str, level: str, text: str) -> bool:
        word = active.split(" ")[0]
        if text.startswith(f"{word} ended: ") or f": {word} ends, " in text:
            return True
        # A later command of this program became active; a refused one leaves the earlier one as it is.
        return level == "info" and any(text.startswith(f"{sent}: ") for sent in self._sent)
