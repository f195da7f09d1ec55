"""The texts and events of a failsafe that begins."""

from __future__ import annotations

import struct

from mavlink_sim.autopilot.failsafe_responses import (
    Action,
    Cause,
)
from mavlink_sim.px4.modes import Mode
from mavlink_sim.wire.announcements import CRITICAL, Text, event_identifier

# Log levels of an EVENT: the lower four bits for ground stations, the upper four for the vehicle's own log.
INFO_LEVELS = 0x66
WARNING_LEVELS = 0x44
CRITICAL_LEVELS = 0x42


def failsafe_entered(intended: Mode, action: Action, delayed: Action, cause: Cause, delay_s: float) -> Text:
    """The text and event of an action that begins.

    Args:
        delayed: the action that follows `action` in `delay_s` seconds; NONE: no other.
    """
    mode = struct.pack("<I", intended.custom_mode)
    if action is Action.HOLD and delayed is not Action.NONE:
        seconds = int(delay_s + 0.5)
        arguments = mode + struct.pack("<BH", delayed, seconds)
        name = "commander_failsafe_enter_generic_hold"
        if cause is not Cause.GENERIC:
            name, arguments = "commander_failsafe_enter_hold", arguments + bytes([cause])
        text = f"Failsafe activated: entering Hold for {seconds} seconds\t"
        return failsafe_event(name, CRITICAL_LEVELS, arguments, text)
    text = "" if action is Action.WARN else "Failsafe activated\t"
    if cause is not Cause.GENERIC:
        if action is Action.WARN:
            return _warning(mode, cause)
        return failsafe_event(
            "commander_failsafe_enter", CRITICAL_LEVELS, mode + bytes([action, cause]), text
        )
    if action is Action.WARN:
        return failsafe_event("commander_failsafe_enter_generic_warn", WARNING_LEVELS, mode)
    name = "commander_failsafe_enter_generic"
    if action in (Action.DESCEND, Action.FALLBACK_ALTITUDE, Action.FALLBACK_STABILIZED):
        name = "commander_failsafe_enter_autopilot_disengaged"
    return failsafe_event(name, CRITICAL_LEVELS, mode + bytes([action]), text)


_BATTERY_WARNINGS = {
    Cause.BATTERY_LOW: ("commander_failsafe_enter_low_bat", 0x64),
    Cause.BATTERY_CRITICAL: ("commander_failsafe_enter_crit_bat_warn", 0x62),
    Cause.BATTERY_EMERGENCY: ("commander_failsafe_enter_crit_low_bat_warn", 0x60),
}


def _warning(mode: bytes, cause: Cause) -> Text:
    if cause in _BATTERY_WARNINGS:
        return failsafe_event(*_BATTERY_WARNINGS[cause])
    return failsafe_event("commander_failsafe_enter_warn", WARNING_LEVELS, mode + bytes([cause]))


def failsafe_event(name: str, levels: int, arguments: bytes = b"", text: str = "") -> Text:
    return Text(CRITICAL, text, (event_identifier(name), levels, arguments))
