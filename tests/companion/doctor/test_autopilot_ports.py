"""What the parameters of the autopilot's serial ports say, as a running service has read them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from companion.bus.bodies.service import PortParametersBody
from companion.doctor.autopilot_ports import CHECKS
from companion.doctor.check import Check, Verdict
from companion.doctor.facts import Facts, Machine, checks_of
from companion.settings import Settings
from tests.companion.doctor.computer import service

ONBOARD = {"MAV_1_CONFIG": 102.0, "MAV_1_MODE": 2.0, "MAV_1_FORWARD": 0.0, "SER_TEL2_BAUD": 921600.0}
STATION = {"MAV_0_CONFIG": 101.0, "MAV_0_MODE": 0.0, "MAV_0_FORWARD": 1.0, "SER_TEL1_BAUD": 57600.0}
COPTER = {"SERIAL1_PROTOCOL": 2.0, "SERIAL1_BAUD": 57.0, "SERIAL2_PROTOCOL": 2.0, "SERIAL2_BAUD": 921.0}
SERIAL = "serial:///dev/ttyAMA0:921600"


def checks(
    parameters: dict[str, float], url: str = SERIAL, *, not_read: str = "", ports: Any = ...
) -> list[Check]:
    body: PortParametersBody = {"parameters": parameters, "not_read": not_read}
    facts = Facts(
        Settings.model_validate({"vehicle": {"url": url}}),
        Machine(),
        replace(service(), ports=body if ports is ... else ports),
    )
    return list(checks_of(facts, CHECKS))


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({**ONBOARD, "MAV_1_MODE": 0.0}, "MAV_1_MODE 2"),
        ({**ONBOARD, **STATION, "MAV_1_MODE": 1.0}, "MAV_1_MODE 2"),
        ({**COPTER, "SERIAL2_PROTOCOL": 1.0}, "SERIAL2_PROTOCOL 2"),
    ],
)
def test_port_of_our_baud_rate_with_another_mode_is_a_warning(
    parameters: dict[str, float], words: str
) -> None:
    (check,) = checks(parameters)
    assert check.verdict is Verdict.WARNING
    assert words in check.advice


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({**STATION, **ONBOARD}, ("MAV_0 at TEL1: Normal, 57600", "MAV_1 at TEL2: Onboard, 921600")),
        ({**ONBOARD, "MAV_1_RATE": 1200.0}, ("1200 B/s", "does not forward")),
        (COPTER, ("SERIAL1: MAVLink 2, 57600", "SERIAL2: MAVLink 2, 921600")),
    ],
)
def test_ports_with_mavlink_are_listed(parameters: dict[str, float], words: tuple[str, ...]) -> None:
    (check,) = checks(parameters)
    assert check.verdict is Verdict.OK
    for word in words:
        assert word in check.found


def test_which_port_is_ours_is_not_assumed() -> None:
    same_baud = {**STATION, "SER_TEL1_BAUD": 921600.0, **ONBOARD}
    assert [check.verdict for check in checks(same_baud)] == [Verdict.OK]
    other_mode = {**ONBOARD, "MAV_1_MODE": 0.0}
    assert [check.verdict for check in checks(other_mode, "udpin://127.0.0.1:14540")] == [Verdict.OK]


def test_reason_is_said_where_nothing_is_read() -> None:
    (check,) = checks({}, not_read="the vehicle is armed")
    assert check.verdict is Verdict.UNKNOWN
    assert "the vehicle is armed" in check.found


def test_nothing_is_said_of_an_autopilot_without_ports() -> None:
    assert checks({}) == []
    assert checks({}, ports=None) == []  # an older service
    assert checks({"MAV_1_CONFIG": 0.0, "MAV_1_MODE": 2.0}) == []
