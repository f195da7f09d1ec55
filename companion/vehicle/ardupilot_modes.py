"""ArduPilot Copter's flight modes in HEARTBEAT.custom_mode and MAV_CMD_DO_SET_MODE (parameter 2).

The names are PX4's, mapped by behaviour: GUIDED is OFFBOARD, LOITER is POSITION, BRAKE is HOLD.
"""

from __future__ import annotations

from companion.vehicle.state import FlightMode

GUIDED, BRAKE = 4, 17

_MODES: dict[int, FlightMode] = {
    0: FlightMode.STABILIZED,
    1: FlightMode.ACRO,
    2: FlightMode.ALTITUDE,
    3: FlightMode.MISSION,
    GUIDED: FlightMode.OFFBOARD,
    5: FlightMode.POSITION,  # LOITER: flown by sticks
    6: FlightMode.RETURN,
    9: FlightMode.LAND,
    16: FlightMode.POSITION,  # POSHOLD
    BRAKE: FlightMode.HOLD,
    21: FlightMode.RETURN,  # SMART_RTL
    23: FlightMode.FOLLOW,
    27: FlightMode.RETURN,  # AUTO_RTL
}
_REQUESTS = {mode: number for number, mode in reversed(_MODES.items())}


def mode_of_custom_mode(custom_mode: int) -> FlightMode:
    """Return the mode of a custom_mode; UNKNOWN for modes without an equivalent here."""
    return _MODES.get(custom_mode, FlightMode.UNKNOWN)


def custom_mode_of_mode(mode: FlightMode) -> int:
    """Return the custom_mode to request. Raises ValueError for a mode that Copter does not have."""
    if mode not in _REQUESTS:
        raise ValueError(f"ArduPilot has no mode {mode!s}; available: {', '.join(_REQUESTS)}")
    return _REQUESTS[mode]
