"""Each fault that a running service reports is found, and `status` shows the same results."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from companion.doctor.check import Check, Verdict, worst_first
from companion.doctor.facts import Facts, Service, checks_of
from companion.doctor.running import CHECKS
from companion.doctor.screens import doctor_lines, status_lines
from companion.settings import Settings
from tests.companion.bus.message_check import check_message
from tests.companion.doctor.computer import changed_status, found, service

FAULT, WARNING, UNKNOWN = Verdict.FAULT, Verdict.WARNING, Verdict.UNKNOWN
OTHER = {"via": "zenoh", "identity": "c3d4", "uptime_s": 5.0, "in_command": False}
SILENCE = {"effect": "sink", "mode": "position", "after_s": 1.1, "warning": True, "text": "it sinks"}
GIMBAL = {"answers": False, "pitch_deg": None, "primary_control": None, "ours": False, "problem": "no answer"}

# Fault → name and verdict of the result, words of its advice or of what was found, changes of the status.
FAULTS: dict[str, tuple[str, Verdict, str, dict[str, Any]]] = {
    "autopilot missing": (
        "autopilot",
        FAULT,
        "vehicle.url",
        {"parts.0.state": "missing", "parts.0.reason": "no autopilot heartbeat", "vehicle.connected": False},
    ),
    "router missing": ("zenoh", WARNING, "zenoh.connect", {"parts.2.state": "missing"}),
    "camera starting": ("camera", UNKNOWN, "again", {"parts.1.state": "starting"}),
    "camera failed": ("camera", FAULT, "no such", {"parts.1.state": "failed", "parts.1.reason": "no such"}),
    "camera silent": ("camera", FAULT, "no result for 5 s", {"unhealthy": ["camera: no result for 5 s"]}),
    "old results": ("camera", WARNING, "0.9 s", {"perception.age_s": 0.9}),
    "slow camera": ("camera", WARNING, "MJPG", {"perception.frames": 280}),
    "frozen camera": ("camera", WARNING, "restart", {"perception.frames_repeated": {"image": 30}}),
    "slow network": (
        "detector",
        WARNING,
        "image_size",
        {"perception.timing_p50_ms": {"preprocess": 2.0, "inference": 90.0, "postprocess": 3.0}},
    ),
    "a vehicle that is not flown": ("vehicle type", FAULT, "safety", {"vehicle.not_flown": "a fixed wing"}),
    "silence that endangers": ("silence", WARNING, "COM_OBL_RC_ACT", {"vehicle.silence": SILENCE}),
    "silence of ArduPilot": (
        "silence",
        WARNING,
        "GUID_TIMEOUT",
        {"vehicle.silence": SILENCE, "vehicle.autopilot": "ArduPilot"},
    ),
    "failsafe": ("link", FAULT, "status", {"vehicle.failsafe": True}),
    "lost frames": ("link", WARNING, "second reader", {"vehicle.reception.lost": 500}),
    "slow streams": ("link", WARNING, "MAV_1_MODE", {"vehicle.missing_streams": ["ATTITUDE_QUATERNION"]}),
    "no home yet": ("link", WARNING, "home", {"vehicle.missing_streams": ["HOME_POSITION"]}),
    "another service": ("other commander", FAULT, "vehicle.name", {"vehicle.other_commanders": [OTHER]}),
    "another program": (
        "other commander",
        FAULT,
        "stop one",
        {"vehicle.other_commanders": [OTHER | {"via": "mavlink"}]},
    ),
    "two services of one name": ("other commander", FAULT, "vehicle.name", {"service": "c3d4"}),
    "gimbal": ("gimbal", WARNING, "gimbals", {"gimbal": GIMBAL}),
    "messages ignored": ("messages", WARNING, "sender", {"bus.ignored": {"velocity": 3}}),
    "commands refused": ("messages", WARNING, "sender", {"bus.refused_commands": 2}),
    "log stalled": ("messages", WARNING, "disk", {"log.dropped_lines": 7}),
}


def checks_of_service(of: Service) -> list[Check]:
    settings = Settings.from_json({"source": {"uri": "/dev/video0", "rate_hz": 30.0}})
    return worst_first(checks_of(Facts(settings, None, of), CHECKS))  # type: ignore[arg-type]


def screen(of: Service, width: int = 80) -> list[str]:
    facts = Facts(Settings(), None, of)  # type: ignore[arg-type]
    return list(status_lines(facts, checks_of_service(of), width))


def test_sample_is_a_status() -> None:
    check_message("status", changed_status())
    check_message("status", changed_status({"gimbal": GIMBAL, "vehicle.other_commanders": [OTHER]}))


def test_sound_service_has_no_fault() -> None:
    checks = checks_of_service(service())
    assert {check.verdict for check in checks} == {Verdict.OK}
    assert {"service", "autopilot", "camera", "detector", "link"} <= {check.name for check in checks}


@pytest.mark.parametrize("fault", FAULTS)
def test_fault_is_found_and_shown(fault: str) -> None:
    name, verdict, words, changes = FAULTS[fault]
    faulty = service(changes)
    results = found(checks_of_service(faulty), name, verdict)
    assert any(words in f"{check.found} {check.advice}" for check in results)
    assert all(check.advice for check in results)
    shown = screen(faulty)
    assert any(line.startswith(verdict.value) and f" {name}: " in line for line in shown)


@pytest.mark.parametrize(
    ("error_ns", "verdict"), [(None, WARNING), (50_000_000, WARNING), (10**6, Verdict.OK)]
)
def test_error_of_time_synchronization_is_found(error_ns: int | None, verdict: Verdict) -> None:
    checks = checks_of_service(service(error_ns=error_ns))
    assert found(checks, "time synchronization", verdict)


def test_camera_of_unknown_settings_is_not_compared_with_ours() -> None:
    repeated = service({"perception.frames_repeated": {"image": 30}, "perception.frames": 280})
    facts = Facts(Settings(), None, repeated, settings_known=False)  # type: ignore[arg-type]
    assert found(list(checks_of(facts, CHECKS)), "camera", Verdict.OK)


def test_silent_service_is_a_fault() -> None:
    silent = Service("vehicle1", True)
    assert found(checks_of_service(silent), "service", FAULT)
    assert screen(silent)


def test_screen_of_a_sound_service_has_no_reasons() -> None:
    lines = screen(service())
    assert not [line for line in lines if line.split()[0] in set(Verdict)]
    assert len(lines) <= 24


def test_screen_has_newest_warnings_and_no_info() -> None:
    events = tuple(
        {"stamp_ns": number * 10**9, "level": level, "text": f"event {number}"}
        for number, level in enumerate(["error", "info", "warning", "warning", "warning", "warning"])
    )
    text = "\n".join(screen(replace(service(), events=events)))  # type: ignore[arg-type]
    assert [number for number in range(6) if f"event {number}" in text] == [2, 3, 4, 5]


def test_screen_shows_command_mission_and_further_cameras() -> None:
    mission = {"name": "demo", "steps": ["climb", "look"], "current": 1, "failure": "", "ended": []}
    status = changed_status(
        {
            "pilot.command": {"id": "a1b2-1", "command": "mission demo\ntext"},
            "pilot.mission": mission,
            "cameras": {"down": changed_status()["perception"]},
            "limits.fence_include": [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]],
        }
    )
    text = "\n".join(screen(Service("vehicle1", True, (status,))))
    for words in ("mission demo (step 2 of 2, look)", "fence", "\ndown "):
        assert words in text


@pytest.mark.parametrize("width", [80, 132])
def test_no_line_is_wider_than_the_terminal(width: int) -> None:
    changes: dict[str, Any] = {}
    for _, _, _, more in FAULTS.values():
        changes |= more
    faulty = service(changes | {"vehicle.status_texts": ["word " * 60], "parts.0.state": "missing"})
    assert max(map(len, screen(faulty, width))) <= width
    assert max(map(len, doctor_lines(checks_of_service(faulty), width))) <= width


def test_advice_of_every_fault_is_printed_whole() -> None:
    check = Check("serial line", FAULT, "taken", "sudo systemctl disable --now serial-getty@ttyAMA0")
    lines = list(doctor_lines([check, Check("disk", Verdict.OK, "free " * 40)], 80))
    assert any(line.endswith(check.advice) for line in lines)
    assert lines[-1] == "1 fault, 1 ok"
    assert len(lines) == 4
