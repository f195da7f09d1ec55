"""A plane, quadplane or rover at COMPANION_SITL_URL: it is connected, and gets nothing that moves it."""

from __future__ import annotations

import pytest

from companion.vehicle.harmless import COMMANDS
from companion.vehicle.vehicle_type import MULTICOPTERS
from mavlink_sim.wire.messages import dialect
from tests.sitl.conftest import Services
from tests.sitl.sitl_harness import ARDUPILOT, READY_S, AutopilotLink

pytestmark = [pytest.mark.sitl, pytest.mark.timeout(300), pytest.mark.realtime]


HOVER_M, QLAND, PLANE_GUIDED = 30.0, 20, 15  # modes of ArduPilot's Plane


def hover(link: AutopilotLink) -> None:
    """Have a pilot take a quadplane off. The service requests the streams that show it."""
    link.until(lambda: link.ready, READY_S, "ready to be armed")
    link.set_mode(PLANE_GUIDED)
    link.until(lambda: link.modes[-1][1] == PLANE_GUIDED, 5.0, "in GUIDED")
    link.command(dialect.MAV_CMD_COMPONENT_ARM_DISARM, 1)
    link.until(lambda: link.armed, 10.0, "armed")
    link.command(dialect.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, HOVER_M)
    link.until(lambda: link.height_m > HOVER_M - 1.0, 60.0, f"at {HOVER_M:g} m")


def test_quadplane_in_hover_is_left_to_its_pilot(link: AutopilotLink, services: Services) -> None:
    if link.autopilot != ARDUPILOT or link.vehicle_type in MULTICOPTERS:
        pytest.skip(f"{link.name}, MAV_TYPE {link.vehicle_type}, is no quadplane of ArduPilot")
    flight = services.flight(None)
    hover(link)
    try:
        lowest_m, asked = link.height_m, len(link.commands)
        for command in ("stop", "hold", "land", "rtl", "goto forward=5 right=0"):
            assert not flight.command(command)["success"]
            link.after(2.0)
            lowest_m = min(lowest_m, link.height_m)
        services.close()
        link.after(4.0)
        lowest_m = min(lowest_m, link.height_m)
        assert lowest_m > HOVER_M - 3.0
        assert {number for _, number in link.commands[asked:]} <= COMMANDS
        assert link.modes[-1][1] == PLANE_GUIDED
        flight.note("quadplane in hover", lowest_m=lowest_m)
    finally:
        link.set_mode(QLAND)
        link.until(lambda: not link.armed, 120.0, "landed and disarmed")


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
