"""PX4's checks before arming, each reported by an event; names and texts are PX4 1.17's."""

from __future__ import annotations

import struct
from collections.abc import Collection
from typing import Protocol

from mavlink_sim.autopilot.position_failsafe import needs_position
from mavlink_sim.missions import geofence
from mavlink_sim.missions.navigator import Navigator
from mavlink_sim.px4.modes import MANUAL_MODES, MODES_PREVENTING_ARMING, Mode
from mavlink_sim.wire.announcements import CRITICAL, Text, event_identifier

_ERROR, _INFO, _PROTOCOL = 0x33, 0x66, 0x88  # log levels: to the vehicle's own log and to ground stations
# PX4's health_component_t
_NO_COMPONENT, _MANUAL_CONTROL, _SYSTEM = 0, 7, 20
# Pressure, GPS, battery, magnetometer, accelerometer, gyroscope
_PRESENT = 1 << 1 | 1 << 3 | 1 << 11 | 1 << 27 | 1 << 28 | 1 << 29
_ALL_MODES = 0xFFFF_FFFF
_GROUND_STATION_CHECK = "check_rc_dl_no_dllink"
# PX4's NAVIGATION_STATE of each mode: its bit in the events' `modes`
NAVIGATION_STATES = {
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
    """What the checks read of the autopilot; see `commander.Autopilot`."""

    armed: bool
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

    @property
    def ground_station_lost(self) -> bool: ...

    @property
    def requires_mission(self) -> bool: ...

    def can_run(self, mode: Mode) -> bool: ...


def health_report(autopilot: CheckedAutopilot) -> list[Text]:
    """The events of MAVLink's health and arming check protocol, without texts.

    A summary of the modes that can be armed and flown, each failing check, the health of the components.
    """
    checks = failing_checks(autopilot)
    failing_modes = errors = 0
    for name, levels, (modes, component) in checks:
        # Reported of all modes, as PX4 reports optional checks; it prevents arming in none.
        optional = name == _GROUND_STATION_CHECK and levels == _INFO
        failing_modes |= 0 if optional else modes
        errors |= (levels == _ERROR) << component
    unavailable = _bits([mode for mode in Mode if not autopilot.can_run(mode)])
    can_arm, can_run = _ALL_MODES & ~failing_modes, _ALL_MODES & ~unavailable
    events = (
        ("commander_arming_check_summary", _PROTOCOL, struct.pack("<B4I", 0, errors, 0, can_arm, can_run)),
        *((name, levels, struct.pack("<IB", *where)) for name, levels, where in checks),
        ("commander_health_summary", _PROTOCOL, struct.pack("<B3I", 0, _PRESENT, 0, 0)),
    )
    return [Text(CRITICAL, "", (event_identifier(name), levels, values)) for name, levels, values in events]


def failing_checks(autopilot: CheckedAutopilot) -> list[tuple[str, int, tuple[int, int]]]:
    """Of each check that fails, in any mode: its event's name, log levels, (bits of modes, component)."""
    with_position = [mode for mode in Mode if needs_position(mode)]
    in_wrong_mode = not autopilot.armed and autopilot.mode in MODES_PREVENTING_ARMING
    mission, sticks = autopilot.navigator.mission, autopilot.pilot_has_sticks
    breaches = autopilot.navigator.breaches
    unlinked = autopilot.ground_station_lost
    of_link = _ERROR if autopilot.lacks_ground_station else _INFO
    of_missions = None if autopilot.requires_mission else [Mode.MISSION]
    checks = (
        ("check_estimator_heading_not_stable", not autopilot.sensors_ready, _ERROR, None, _NO_COMPONENT),
        ("check_modes_local_pos", not autopilot.position_valid, _ERROR, with_position, _NO_COMPONENT),
        *((name, words in breaches, _ERROR, None, _SYSTEM) for name, words in GEOFENCE_CHECKS.items()),
        (_GROUND_STATION_CHECK, unlinked, of_link, None, _NO_COMPONENT),
        ("check_modes_mission", not mission.valid, _INFO, of_missions, _SYSTEM),
        ("check_modes_offboard_signal", not autopilot.has_setpoints, _ERROR, [Mode.OFFBOARD], _SYSTEM),
        ("check_modes_manual_control", not sticks, _ERROR, MANUAL_MODES, _MANUAL_CONTROL),
        ("check_modes_cannot_takeoff", in_wrong_mode, _ERROR, MODES_PREVENTING_ARMING, _SYSTEM),
    )
    return [
        (name, levels, (_bits(modes), component)) for name, fails, levels, modes, component in checks if fails
    ]


def _bits(modes: Collection[Mode] | None) -> int:
    """Of all modes for None."""
    if modes is None:
        return _ALL_MODES
    bits = sum(1 << state for mode, state in NAVIGATION_STATES.items() if mode in modes)
    return bits | _ALTITUDE_CRUISE if Mode.ALTCTL in modes else bits
