"""PX4's flight modes in HEARTBEAT.custom_mode and MAV_CMD_DO_SET_MODE.

`custom_mode` = main mode << 16 | sub mode << 24 (PX4: src/modules/commander/px4_custom_mode.h).
"""

from __future__ import annotations

from companion.vehicle.state import FlightMode

_AUTO = 4

# (main mode, sub mode) as PX4 reports it
_MODES: dict[tuple[int, int], FlightMode] = {
    (1, 0): FlightMode.MANUAL,
    (2, 0): FlightMode.ALTITUDE,
    (3, 0): FlightMode.POSITION,
    (3, 2): FlightMode.POSITION,  # slow
    (5, 0): FlightMode.ACRO,
    (6, 0): FlightMode.OFFBOARD,
    (7, 0): FlightMode.STABILIZED,
    (_AUTO, 1): FlightMode.READY,
    (_AUTO, 2): FlightMode.TAKEOFF,
    (_AUTO, 3): FlightMode.HOLD,
    (_AUTO, 4): FlightMode.MISSION,
    (_AUTO, 5): FlightMode.RETURN,
    (_AUTO, 6): FlightMode.LAND,
    (_AUTO, 8): FlightMode.FOLLOW,
    (_AUTO, 9): FlightMode.PRECISION_LAND,
}
_REQUESTS = {mode: numbers for numbers, mode in reversed(_MODES.items())}


def mode_of_custom_mode(custom_mode: int) -> FlightMode:
    """Return the mode of a custom_mode; UNKNOWN for modes not listed here."""
    return _MODES.get(((custom_mode >> 16) & 0xFF, (custom_mode >> 24) & 0xFF), FlightMode.UNKNOWN)


def request_of_mode(mode: FlightMode) -> tuple[int, int]:
    """Return (main mode, sub mode), params 2 and 3 of MAV_CMD_DO_SET_MODE. Raises ValueError for UNKNOWN."""
    if mode not in _REQUESTS:
        raise ValueError(f"mode {mode!s} cannot be requested; known: {', '.join(_REQUESTS)}")
    return _REQUESTS[mode]


# PX4: msg/VehicleStatus.msg, NAVIGATION_STATE_*
_NAVIGATION_STATES = {
    FlightMode.MANUAL: 0,
    FlightMode.ALTITUDE: 1,
    FlightMode.POSITION: 2,
    FlightMode.MISSION: 3,
    FlightMode.HOLD: 4,
    FlightMode.RETURN: 5,
    FlightMode.ACRO: 10,
    FlightMode.OFFBOARD: 14,
    FlightMode.STABILIZED: 15,
    FlightMode.TAKEOFF: 17,
    FlightMode.LAND: 18,
    FlightMode.FOLLOW: 19,
    FlightMode.PRECISION_LAND: 20,
}


def among_modes(mode: FlightMode, modes: int) -> bool:
    """Whether a `Report.modes` bit mask includes a mode; True for modes without a number here."""
    state = _NAVIGATION_STATES.get(mode)
    return state is None or bool(modes >> state & 1)
