"""A text report of the autopilot (STATUSTEXT or EVENT)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

ALL_MODES = 0xFFFF_FFFF
WARNING = 4  # MAV_SEVERITY: from 0 (emergency) to 7 (debug)
# Groups of PX4's events, and prefixes of ArduPilot's and PX4's texts, that report why it cannot arm.
_CHECK_GROUPS = ("arming_check", "health")
_CHECK_TEXTS = ("PreArm:", "Arm:", "Preflight Fail:")


@dataclass(frozen=True, slots=True)
class Report:
    """One text report of the autopilot.

    Attributes:
        stamp_ns: CLOCK_MONOTONIC of its arrival.
        level: MAV_SEVERITY, 0 (emergency) to 7 (debug).
        group: event group ("default", "arming_check", "health"); empty for a status text.
        name: event name in the metadata; empty for a status text.
        modes: affected modes; bit n is PX4's navigation state n.
    """

    stamp_ns: int
    level: int
    text: str
    group: str = ""
    name: str = ""
    modes: int = ALL_MODES

    @property
    def is_check(self) -> bool:
        """Whether it reports why the vehicle cannot arm."""
        return self.level <= WARNING and (self.group in _CHECK_GROUPS or self.text.startswith(_CHECK_TEXTS))

    @property
    def is_listed_check(self) -> bool:
        """Whether it is one of PX4's failing checks, at any level.

        At level info PX4 reports also what prevents arming in all modes: a missing mission (COM_ARM_MIS_REQ),
        the safety button, an estimator that is not initialized (v1.14 to v1.18, by source).
        """
        return self.group in _CHECK_GROUPS


def words_of(reports: Iterable[Report]) -> str:
    """Join the distinct texts of reports, in order."""
    return "; ".join(dict.fromkeys(report.text for report in reports))
