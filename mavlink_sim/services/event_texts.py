"""Names and texts of the vehicle's events: PX4 1.17's (https://mavlink.io/en/services/events.html)."""

from __future__ import annotations

from typing import Any

from mavlink_sim.autopilot.health_report import NAVIGATION_STATES
from mavlink_sim.wire import announcements
from mavlink_sim.wire.announcements import event_identifier

_CHECK = (("navigation_mode_group_t", "modes"), ("uint8_t", "health_component_index"))
_MODE, _ACTION, _CAUSE = (
    ("uint32_t", "mode"),
    ("px4::failsafe_action_t", "action"),
    ("px4::failsafe_cause_t", "cause"),
)
_DELAY = ("uint16_t", "seconds")
Arguments = tuple[tuple[str, str], ...]

# From a recorded flight: identifier, name, text, arguments.
_RECORDED: tuple[tuple[int, str, str, Arguments], ...] = (
    (
        announcements.ARMED_EVENT[0],
        "commander_armed_by",
        "Armed by {1}",
        (("px4::arm_disarm_reason_t", "reason"),),
    ),
    (announcements.TAKEOFF_EVENT[0], "land_detector_takeoff", "Takeoff detected", ()),
    (announcements.LANDING_EVENT[0], "navigator_mode_land", "Landing at current position", ()),
    (announcements.LANDED_EVENT[0], "land_detector_landed", "Landing detected", ()),
    (
        announcements.DISARMED_EVENT,
        "commander_disarmed_by",
        "Disarmed by {1}",
        (("px4::arm_disarm_reason_t", "reason"),),
    ),
    (
        announcements.ARMING_DENIED_EVENT[0],
        "commander_arm_denied_resolve_failures",
        "Arming denied: Resolve system health failures first",
        (),
    ),
    (
        announcements.DEFAULT_ALTITUDE_EVENT,
        "navigator_takeoff_min_alt",
        "Using default takeoff altitude: {1:.2m_v}",
        (("float", "takeoff_min_alt"),),
    ),
)
_DEFAULT: dict[str, tuple[str, Arguments]] = {
    "commander_arm_denied_throttle_center": ("Arming denied: throttle above center", ()),
    "commander_arm_denied_throttle_high": ("Arming denied: high throttle", ()),
    "commander_arm_denied_not_manual": ("Arming denied: switch to manual mode first", ()),
    "commander_kill_sw_engaged": ("Kill engaged", ()),
    "commander_kill_sw_disengaged": ("Kill disengaged", ()),
    "commander_gcs_lost": ("Connection to ground control station lost", ()),
    "commander_dl_regained": ("GCS connection regained", ()),
    "commander_rc_override": ("Pilot took over using sticks", ()),
    "failsafe_rc_override": ("Pilot took over using sticks", ()),
    "commander_failsafe_enter": ("{3}: switching to {2}", (_MODE, _ACTION, _CAUSE)),
    "commander_failsafe_enter_generic": ("Failsafe activated: switching to {2}", (_MODE, _ACTION)),
    "commander_failsafe_enter_autopilot_disengaged": (
        "Failsafe activated: Autopilot disengaged, switching to {2}",
        (_MODE, _ACTION),
    ),
    "commander_failsafe_enter_hold": (
        "{4}: switching to {2} in {3} seconds",
        (_MODE, _ACTION, _DELAY, _CAUSE),
    ),
    "commander_failsafe_enter_generic_hold": (
        "Failsafe activated: switching to {2} in {3} seconds",
        (_MODE, _ACTION, _DELAY),
    ),
    "commander_failsafe_enter_warn": ("Failsafe warning: {2}", (_MODE, _CAUSE)),
    "commander_failsafe_enter_generic_warn": ("Failsafe warning:", (_MODE,)),
    "commander_failsafe_enter_low_bat": ("Low battery level, return advised", ()),
    "commander_failsafe_enter_crit_bat_warn": ("Critical battery level, land now", ()),
    "commander_failsafe_enter_crit_low_bat_warn": ("Emergency battery level, land immediately", ()),
}
_ARMING_CHECKS: dict[str, tuple[str, Arguments]] = {
    "check_estimator_heading_not_stable": ("Heading estimate not stable", _CHECK),
    "check_modes_local_pos": ("Navigation error: No valid position estimate", _CHECK),
    "check_gf_violation_max_hor_dist": ("Geofence violation: exceeding maximum distance to Home", _CHECK),
    "check_gf_violation_max_alt": ("Geofence violation: exceeding maximum altitude above Home", _CHECK),
    "check_gf_violation_custom_gf": ("Geofence violation: approaching or outside geofence", _CHECK),
    "check_rc_dl_no_dllink": ("No connection to the ground control station", _CHECK),
    "check_modes_mission": ("No valid mission available", _CHECK),
    "check_modes_offboard_signal": ("No offboard signal", _CHECK),
    "check_modes_manual_control": ("No manual control input", _CHECK),
    "check_modes_cannot_takeoff": ("Mode not suitable for arming", _CHECK),
}
# The two events around the checks: PX4's health and arming check protocol
_HEALTH, _MODES = "px4::health_component_t", "px4::navigation_mode_group_t"
_SUMMARIES: dict[str, tuple[str, Arguments]] = {
    "commander_arming_check_summary": (
        "Arming checks",
        (
            ("uint8_t", "chunk_idx"),
            (_HEALTH, "error"),
            (_HEALTH, "warning"),
            (_MODES, "can_arm"),
            (_MODES, "can_run"),
        ),
    ),
    "commander_health_summary": (
        "Health report",
        (("uint8_t", "chunk_idx"), (_HEALTH, "is_present"), (_HEALTH, "error"), (_HEALTH, "warning")),
    ),
}
_BITFIELDS = ("health_component_t", "navigation_mode_group_t")
_ENUMS: dict[str, tuple[str, dict[int, str]]] = {
    "failsafe_action_t": (
        "uint8_t",
        {
            0: "",
            1: "warning",
            2: "Position mode",
            3: "Altitude mode",
            4: "Stabilized mode",
            5: "Hold",
            6: "RTL",
            7: "Land",
            8: "Descend",
            9: "disarm",
            10: "terminate",
        },
    ),
    "failsafe_cause_t": (
        "uint8_t",
        {
            0: "",
            1: "Manual control loss",
            2: "GCS connection loss",
            3: "Low battery level",
            4: "Critical battery level",
            5: "Emergency battery level",
            6: "Remaining flight time low",
        },
    ),
    "health_component_t": (
        "uint32_t",
        {
            1 << 0: "None",
            1 << 1: "Absolute pressure",
            1 << 3: "GPS",
            1 << 7: "Remote Control (RC or Joystick)",
            1 << 11: "Battery",
            1 << 20: "System",
            1 << 27: "Magnetometer",
            1 << 28: "Accelerometer",
            1 << 29: "Gyroscope",
        },
    ),
    "navigation_mode_group_t": (
        "uint32_t",
        {1 << state: mode.title for mode, state in NAVIGATION_STATES.items()},
    ),
    "arm_disarm_reason_t": (
        "uint8_t",
        {
            1: "stick gesture",
            2: "RC switch",
            3: "internal command",
            4: "external command",
            5: "mission start",
            6: "landing",
            7: "preflight inaction",
            8: "kill switch",
            13: "RC button",
            14: "failsafe",
        },
    ),
}


def events_metadata() -> dict[str, Any]:
    """The JSON document, by MAVLink's events schema."""
    default = {identifier: (name, words, arguments) for identifier, name, words, arguments in _RECORDED}
    default |= {event_identifier(name): (name, *text) for name, text in _DEFAULT.items()}
    checks = {event_identifier(name): (name, *text) for name, text in _ARMING_CHECKS.items()}
    arming, health = ({event_identifier(name): (name, *text)} for name, text in _SUMMARIES.items())
    return {
        "version": 2,
        "components": {
            "1": {
                "namespace": "px4",
                "supported_protocols": ["health_and_arming_check"],
                "navigation_mode_groups": {
                    "groups": {str(state): [mode.custom_mode] for mode, state in NAVIGATION_STATES.items()}
                },
                "enums": {
                    name: _enum(kind, entries, is_bitfield=name in _BITFIELDS)
                    for name, (kind, entries) in _ENUMS.items()
                },
                "event_groups": {
                    "default": {"events": _events(default)},
                    "arming_check": {"events": _events(arming, "summary") | _events(checks)},
                    "health": {"events": _events(health, "summary")},
                },
            }
        },
    }


def _events(texts: dict[int, tuple[str, str, Arguments]], kind: str = "") -> dict[str, Any]:
    return {
        str(identifier & 0xFFFFFF): {
            "name": name,
            "message": words,
            **({"type": kind} if kind else {}),
            **(
                {"arguments": [{"type": each, "name": word} for each, word in arguments]} if arguments else {}
            ),
        }
        for identifier, (name, words, arguments) in texts.items()
    }


def _enum(kind: str, entries: dict[int, str], *, is_bitfield: bool = False) -> dict[str, Any]:
    named = {str(value): {"name": f"value_{value}", "description": words} for value, words in entries.items()}
    return {"type": kind, **({"is_bitfield": True} if is_bitfield else {}), "entries": named}
