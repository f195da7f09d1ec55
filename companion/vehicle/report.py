"""A text report of the autopilot (STATUSTEXT or EVENT)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

ALL_MODES = 0xFFFF_FFFF
WARNING = 4  # MAV_SEVERITY: from 0 (emergency) to 7 (debug)
# Groups of PX4's events, and prefixes of ArduPilot's and PX4's texts, that report why it cannot arm.
_CHECK_GROUPS = ("arming_check", "health")
_CHECK_TEXTS = ("PreArm:", "Arm:", "Preflight Fail:")
# Reported at level info, and of all modes, although it prevents arming in none: the only one (PX4's source,
# v1.14 to v1.18). Where NAV_DLL_ACT requires a ground station, it is an error.
_OPTIONAL_CHECKS = ("check_rc_dl_no_dllink",)


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
        """Whether it reports why the vehicle cannot arm, in any of `modes`.

        PX4 reports at level info, too, what prevents arming: a missing mission or home position, the safety
        button, an estimator that is not initialized.
        """
        if self.group in _CHECK_GROUPS and self.name not in _OPTIONAL_CHECKS:
            return True
        return self.level <= WARNING and (self.group in _CHECK_GROUPS or self.text.startswith(_CHECK_TEXTS))


def words_of(reports: Iterable[Report]) -> str:
    """Join the distinct texts of reports, in order."""
    return "; ".join(dict.fromkeys(report.text for report in reports))
