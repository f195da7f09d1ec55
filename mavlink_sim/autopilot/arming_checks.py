"""PX4's checks before arming, each reported by an event; names and texts are PX4 1.17's."""

from __future__ import annotations

import struct
from collections.abc import Collection
from typing import Protocol

from mavlink_sim.autopilot import position_failsafe
from mavlink_sim.missions import geofence
from mavlink_sim.missions.navigator import Navigator
from mavlink_sim.px4.modes import MANUAL_MODES, MODES_PREVENTING_ARMING, Mode
from mavlink_sim.wire.announcements import CRITICAL, Text, event_identifier

_ERROR, _INFO = 0x33, 0x66  # log levels: to the vehicle's own log and to ground stations
# PX4's health_component_t
_NO_COMPONENT, _MANUAL_CONTROL, _SYSTEM = 0, 7, 20
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
GEOFENCE_CHECKS = {
    "check_gf_violation_max_hor_dist": geofence.TOO_FAR,
    "check_gf_violation_max_alt": geofence.TOO_HIGH,
    "check_gf_violation_custom_gf": geofence.OUTSIDE,
}
_ALTITUDE_CRUISE = 1 << 8  # a manual mode that this vehicle does not have


class CheckedAutopilot(Protocol):
    """What the checks use of the autopilot; see `commander.Autopilot`."""

    mode: Mode
    position_valid: bool
    navigator: Navigator

    @property
    def sensors_ready(self) -> bool: ...

    @property
    def has_setpoints(self) -> bool: ...

    @property
    def pilot_has_sticks(self) -> bool: ...

    @property
    def lacks_ground_station(self) -> bool: ...


def failing_checks(autopilot: CheckedAutopilot, only: Collection[str] | None = None) -> list[Text]:
    """An event (without text) for each check that fails, whatever the mode. `only`: of these checks."""
    with_position = [mode for mode in Mode if position_failsafe.needs_position(mode)]
    in_wrong_mode = autopilot.mode in MODES_PREVENTING_ARMING
    mission, sticks = autopilot.navigator.mission, autopilot.pilot_has_sticks
    breaches = autopilot.navigator.breaches
    unlinked = autopilot.lacks_ground_station
    checks = (
        ("check_estimator_heading_not_stable", not autopilot.sensors_ready, _ERROR, None, _NO_COMPONENT),
        ("check_modes_local_pos", not autopilot.position_valid, _ERROR, with_position, _NO_COMPONENT),
        *((name, words in breaches, _ERROR, None, _SYSTEM) for name, words in GEOFENCE_CHECKS.items()),
        ("check_rc_dl_no_dllink", unlinked, _ERROR, None, _NO_COMPONENT),
        ("check_modes_mission", not mission.valid, _INFO, [Mode.MISSION], _SYSTEM),
        ("check_modes_offboard_signal", not autopilot.has_setpoints, _ERROR, [Mode.OFFBOARD], _SYSTEM),
        ("check_modes_manual_control", not sticks, _ERROR, MANUAL_MODES, _MANUAL_CONTROL),
        ("check_modes_cannot_takeoff", in_wrong_mode, _ERROR, MODES_PREVENTING_ARMING, _SYSTEM),
    )
    return [
        Text(CRITICAL, "", (event_identifier(name), levels, struct.pack("<IB", _bits(modes), component)))
        for name, fails, levels, modes, component in checks
        if fails and (only is None or name in only)
    ]


def _bits(modes: Collection[Mode] | None) -> int:
    """Of all modes for None."""
    if modes is None:
        return _ALL_MODES
    bits = sum(1 << state for mode, state in _NAVIGATION_STATES.items() if mode in modes)
    return bits | _ALTITUDE_CRUISE if Mode.ALTCTL in modes else bits
