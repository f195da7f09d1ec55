"""A plane, quadplane or rover at COMPANION_SITL_URL: it is connected, and gets nothing that moves it."""

from __future__ import annotations

import pytest

from companion.vehicle.harmless import COMMANDS
from companion.vehicle.vehicle_type import MULTICOPTERS
from tests.sitl.conftest import Services
from tests.sitl.sitl_harness import AutopilotLink

pytestmark = [pytest.mark.sitl, pytest.mark.timeout(300), pytest.mark.realtime]


def test_vehicle_that_is_not_flown_gets_no_command(link: AutopilotLink, services: Services) -> None:
    if link.vehicle_type in MULTICOPTERS:
        pytest.skip(f"MAV_TYPE {link.vehicle_type} is flown")
    flight = services.flight(None)
    link.until(lambda: flight.status, 30.0, "status")
    modes, armed, asked = list(link.modes), link.armed, len(link.commands)
    for command in ("takeoff 20", "hold", "stop", "land", "rtl", "goto forward=5 right=0"):
        reply = flight.command(command)
        assert not reply["success"]
        assert f"MAV_TYPE {link.vehicle_type}" in reply["reason"]
    services.close()  # the end of the service requests no HOLD
    link.after(2.0)
    assert {number for _, number in link.commands[asked:]} <= COMMANDS
    assert not link.setpoints_s
    assert link.armed is armed
    assert link.modes[-1:] == modes[-1:]
    flight.note("not flown", MAV_TYPE=float(link.vehicle_type))
