"""PX4's checks before arming, each told by an event; the names and words are PX4 1.17's."""

from __future__ import annotations

import struct
from collections.abc import Collection
from typing import TYPE_CHECKING

from mavlink_sim.autopilot import position_failsafe
from mavlink_sim.px4.modes import MANUAL_MODES, MODES_PREVENTING_ARMING, Mode
from mavlink_sim.wire.announcements import CRITICAL, Text, event_identifier

if TYPE_CHECKING:
    from mavlink_sim.autopilot.commander import Autopilot

_LEVELS = 0x63  # INFO to the log, ERROR to ground stations
_ALL_MODES = 0xFFFF_FFFF
# PX4's NAVIGATION_STATE of each mode: its bit in the events' `modes`
_NAVIGATION_STATES = {
    Mode.MANUAL: 0,
    Mode.ALTCTL: 1,
    Mode.POSCTL: 2,
    Mode.MISSION: 3,
    Mode.HOLD: 4,
    Mode.RTL: 5,
    Mode.POSITION_SLOW: 6,
    Mode.ACRO: 10,
    Mode.OFFBOARD: 14,
    Mode.STABILIZED: 15,
    Mode.TAKEOFF: 17,
    Mode.LAND: 18,
    Mode.FOLLOW: 19,
    Mode.PRECLAND: 20,
    Mode.ORBIT: 21,
}


def failing_checks(autopilot: Autopilot) -> list[Text]:
    """An event for each check that fails, whatever the mode; without a text of its own."""
    with_position = [mode for mode in Mode if position_failsafe.needs_position(mode)]
    checks = (
        ("check_estimator_heading_not_stable", not autopilot.sensors_ready, None),
        ("check_modes_local_pos", not autopilot.position_valid, with_position),
        ("check_gf_violation_max_hor_dist", autopilot.navigator.is_breached, None),
        ("check_modes_mission", not autopilot.navigator.mission.valid, [Mode.MISSION]),
        ("check_modes_offboard_signal", not autopilot.has_setpoints, [Mode.OFFBOARD]),
        ("check_modes_manual_control", not autopilot.pilot_has_sticks, MANUAL_MODES),
        ("check_modes_cannot_takeoff", True, MODES_PREVENTING_ARMING),
    )
    return [
        Text(CRITICAL, "", (event_identifier(name), _LEVELS, struct.pack("<IB", _bits(modes), 0)))
        for name, fails, modes in checks
        if fails
    ]


def _bits(modes: Collection[Mode] | None) -> int:
    """Of all modes for None."""
    if modes is None:
        return _ALL_MODES
    return sum(1 << state for mode, state in _NAVIGATION_STATES.items() if mode in modes)
