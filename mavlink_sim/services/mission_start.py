"""MISSION_START: mode MISSION and arming in one command."""

from __future__ import annotations

import math

from mavlink_sim.autopilot.commander import Autopilot
from mavlink_sim.px4.modes import Mode
from mavlink_sim.wire.announcements import CRITICAL, Text

ACCEPTED, TEMPORARILY_REJECTED, DENIED = 0, 1, 2  # MAV_RESULT


def mission_start(autopilot: Autopilot, first: float) -> int:
    """MAV_RESULT of MISSION_START. `first`: index of the item to begin with, -1 for the current one."""
    mission = autopilot.navigator.mission
    if not mission.valid:
        autopilot.texts.append(Text(CRITICAL, "Mission start denied! No valid mission\t"))
        return DENIED
    if not (math.isfinite(first) and -1.0 <= first < len(mission.items)):
        return DENIED
    if first >= 0.0:
        autopilot.navigator.set_current(int(first))
    if autopilot.set_mode(Mode.MISSION) == ACCEPTED and autopilot.arm() == ACCEPTED:
        return ACCEPTED
    autopilot.report_unavailable(Mode.MISSION)
    return TEMPORARILY_REJECTED
