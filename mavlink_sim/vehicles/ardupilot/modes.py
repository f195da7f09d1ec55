"""Copter's flight modes: their numbers in HEARTBEAT.custom_mode, their names, and what each may do."""

from __future__ import annotations

from enum import IntEnum


class CopterMode(IntEnum):
    """A flight mode; the value is HEARTBEAT.custom_mode and DO_SET_MODE's parameter 2."""

    STABILIZE = 0
    ACRO = 1
    ALT_HOLD = 2
    AUTO = 3
    GUIDED = 4
    LOITER = 5
    RTL = 6
    CIRCLE = 7
    LAND = 9
    DRIFT = 11
    SPORT = 13
    FLIP = 14
    AUTOTUNE = 15
    POSHOLD = 16
    BRAKE = 17
    THROW = 18
    AVOID_ADSB = 19
    GUIDED_NOGPS = 20
    SMART_RTL = 21
    FLOWHOLD = 22
    FOLLOW = 23
    ZIGZAG = 24

    @property
    def custom_mode(self) -> int:
        return int(self)

    @property
    def title(self) -> str:
        """ArduPilot's name of the mode in its status texts."""
        return _TITLES.get(self, self.name)

    @property
    def standard_mode(self) -> int:
        """MAV_STANDARD_MODE, 0 where there is none."""
        return _STANDARD_MODES.get(self, 0)


_TITLES = {CopterMode.ALT_HOLD: "ALTHOLD", CopterMode.SMART_RTL: "SMARTRTL"}
_STANDARD_MODES = {
    CopterMode.ALT_HOLD: 4,
    CopterMode.POSHOLD: 1,
    CopterMode.AUTO: 6,
    CopterMode.RTL: 5,
    CopterMode.LAND: 7,
}


def _modes(names: str) -> frozenset[CopterMode]:
    return frozenset(CopterMode[name] for name in names.split())


# The simulated modes; a request for another one is answered as by a build without it.
SUPPORTED = _modes("STABILIZE ACRO ALT_HOLD AUTO GUIDED LOITER RTL LAND POSHOLD BRAKE")
# Possible without a horizontal position; LAND then descends without holding its position.
WITHOUT_POSITION = _modes("STABILIZE ACRO ALT_HOLD LAND")
ARMABLE = _modes("STABILIZE ACRO ALT_HOLD GUIDED LOITER POSHOLD")
# Modes with position control, shown in HEARTBEAT.base_mode as MAV_MODE_FLAG_GUIDED_ENABLED.
POSITION_CONTROLLED = _modes("AUTO GUIDED LOITER RTL LAND POSHOLD BRAKE")


def mode_of(custom_mode: int) -> CopterMode | None:
    """The mode of a number, None for one that is not simulated."""
    try:
        mode = CopterMode(custom_mode)
    except ValueError:
        return None
    return mode if mode in SUPPORTED else None
