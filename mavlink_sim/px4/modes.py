"""PX4's flight modes: how HEARTBEAT and CURRENT_MODE encode them, and how DO_SET_MODE names them.

The custom mode is `main << 16 | sub << 24` (PX4's `px4_custom_mode.h`); the base mode is MAV_MODE_FLAG bits.
"""

from __future__ import annotations

from enum import Enum, IntEnum

CUSTOM_MODE_ENABLED = 1
GUIDED_ENABLED = 8
AUTO_ENABLED = 4
STABILIZE_ENABLED = 16
MANUAL_INPUT_ENABLED = 64
SAFETY_ARMED = 128


class LandedState(IntEnum):
    """MAV_LANDED_STATE."""

    ON_GROUND = 1
    IN_AIR = 2
    TAKEOFF = 3
    LANDING = 4


class SystemState(IntEnum):
    """The part of MAV_STATE that PX4 reports."""

    UNINIT = 0
    STANDBY = 3
    ACTIVE = 4
    CRITICAL = 5
    FLIGHT_TERMINATION = 8


class Mode(Enum):
    """A flight mode; the value is (main mode, sub mode) of PX4's custom mode."""

    MANUAL = (1, 0)
    ALTCTL = (2, 0)
    POSCTL = (3, 0)
    ORBIT = (3, 1)
    POSITION_SLOW = (3, 2)
    TAKEOFF = (4, 2)
    HOLD = (4, 3)
    MISSION = (4, 4)
    RTL = (4, 5)
    LAND = (4, 6)
    FOLLOW = (4, 8)
    PRECLAND = (4, 9)
    ACRO = (5, 0)
    OFFBOARD = (6, 0)
    STABILIZED = (7, 0)

    # a member is a single object: Enum's own hash is a Python function, called at every control step
    __hash__ = object.__hash__

    @property
    def custom_mode(self) -> int:
        main, sub = self.value
        return int(main << 16 | sub << 24)

    @property
    def title(self) -> str:
        """PX4's name of the mode in its status texts."""
        return _TITLES[self]

    @property
    def standard_mode(self) -> int:
        """MAV_STANDARD_MODE of the mode, 0 where there is none."""
        return _STANDARD_MODES.get(self, 0)


_TITLES = {
    Mode.MANUAL: "Manual",
    Mode.ALTCTL: "Altitude",
    Mode.POSCTL: "Position",
    Mode.ORBIT: "Orbit",
    Mode.POSITION_SLOW: "Position Slow",
    Mode.TAKEOFF: "Takeoff",
    Mode.HOLD: "Hold",
    Mode.MISSION: "Mission",
    Mode.RTL: "Return",
    Mode.LAND: "Land",
    Mode.FOLLOW: "Follow Target",
    Mode.PRECLAND: "Precision Land",
    Mode.ACRO: "Acro",
    Mode.OFFBOARD: "Offboard",
    Mode.STABILIZED: "Stabilized",
}
_STANDARD_MODES = {
    Mode.POSCTL: 1,
    Mode.ORBIT: 2,
    Mode.ALTCTL: 4,
    Mode.RTL: 5,
    Mode.MISSION: 6,
    Mode.LAND: 7,
    Mode.TAKEOFF: 8,
}

# AVAILABLE_MODES lists them in the order of PX4's navigation states.
LISTED_MODES = (
    Mode.MANUAL,
    Mode.ALTCTL,
    Mode.POSCTL,
    Mode.MISSION,
    Mode.HOLD,
    Mode.RTL,
    Mode.POSITION_SLOW,
    Mode.ACRO,
    Mode.OFFBOARD,
    Mode.STABILIZED,
    Mode.TAKEOFF,
    Mode.LAND,
    Mode.FOLLOW,
    Mode.PRECLAND,
    Mode.ORBIT,
)
MANUAL_MODES = frozenset(
    {Mode.MANUAL, Mode.ALTCTL, Mode.POSCTL, Mode.POSITION_SLOW, Mode.ACRO, Mode.STABILIZED}
)
# Modes that never allow arming; after disarming, the mode selected before one of these is restored.
MODES_PREVENTING_ARMING = frozenset({Mode.RTL, Mode.LAND, Mode.PRECLAND, Mode.ORBIT})

_BY_CUSTOM = {mode.value: mode for mode in Mode}
# Only DO_ORBIT leads to the orbit mode; DO_SET_MODE's (3, 1) is the position mode to PX4.
_BY_CUSTOM[(3, 1)] = Mode.POSCTL


def mode_of(main: int, sub: int) -> Mode | None:
    """The mode that DO_SET_MODE's parameters 2 and 3 name; None where PX4 refuses them."""
    return _BY_CUSTOM.get((main, sub if main in (3, 4) else 0))


def base_mode(mode: Mode, armed: bool, has_setpoints: bool) -> int:
    """HEARTBEAT.base_mode. `has_setpoints`: a setpoint stream is present (relevant in OFFBOARD only)."""
    if mode is Mode.OFFBOARD:
        flags = STABILIZE_ENABLED if has_setpoints else 0
    elif mode is Mode.ACRO:
        flags = MANUAL_INPUT_ENABLED
    elif mode in MANUAL_MODES:
        flags = MANUAL_INPUT_ENABLED | STABILIZE_ENABLED
    elif mode in (Mode.FOLLOW, Mode.ORBIT):
        flags = STABILIZE_ENABLED
    else:
        flags = AUTO_ENABLED | GUIDED_ENABLED | STABILIZE_ENABLED
    return CUSTOM_MODE_ENABLED | flags | (SAFETY_ARMED if armed else 0)
