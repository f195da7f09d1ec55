"""One thing an autopilot said of itself in words."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

ALL_MODES = 0xFFFF_FFFF
WARNING = 4  # MAV_SEVERITY: from 0 (emergency) to 7 (debug)
# Groups of PX4's events, and how ArduPilot's and PX4's texts begin, that tell what keeps it from arming.
_CHECK_GROUPS = ("arming_check", "health")
_CHECK_TEXTS = ("PreArm:", "Arm:", "Preflight Fail:")


@dataclass(frozen=True, slots=True)
class Report:
    """One thing the autopilot said.

    Attributes:
        stamp_ns: CLOCK_MONOTONIC of its arrival.
        level: MAV_SEVERITY, 0 (emergency) to 7 (debug).
        group: of an event ("default", "arming_check", "health"); empty for a status text.
        name: of an event, as its metadata calls it; empty for a status text.
        modes: which modes it is about; bit n is PX4's navigation state n.
    """

    stamp_ns: int
    level: int
    text: str
    group: str = ""
    name: str = ""
    modes: int = ALL_MODES

    @property
    def of_a_check(self) -> bool:
        """It tells what keeps the vehicle from arming."""
        return self.level <= WARNING and (self.group in _CHECK_GROUPS or self.text.startswith(_CHECK_TEXTS))

    @property
    def of_some_modes(self) -> bool:
        """It is of a check, whatever its level, that not every mode needs."""
        return self.group in _CHECK_GROUPS and self.modes != ALL_MODES


def words_of(reports: Iterable[Report]) -> str:
    """Their texts, each once, in their order."""
    return "; ".join(dict.fromkeys(report.text for report in reports))
