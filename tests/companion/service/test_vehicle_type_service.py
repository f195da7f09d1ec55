"""The service on a vehicle that it does not fly: it runs, says so, and sends nothing that moves it."""

from __future__ import annotations

import asyncio
import time

import pytest

from companion.vehicle.driver import CommandRefusedError
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import FlightMode
from mavlink_sim.testing import free_port
from tests.companion.live_flight import LiveFlight
from tests.companion.vehicle.fake_autopilot import OFFBOARD, SETPOINT, FakeAutopilot
from tests.companion.vehicle.test_vehicle_type import ALLOWED_COMMANDS

pytestmark = pytest.mark.realtime
FIXED_WING, QUADROTOR = 1, 2
MC, FW = 3, 4  # MAV_VTOL_STATE


@pytest.mark.parametrize(
    ("kind", "autopilot", "mav_type"),
    [
        ("pymavlink", 3, FIXED_WING),
        ("pymavlink", 3, QUADROTOR),  # a quadplane that claims to be one, in forward flight
        ("pymavlink", 12, FIXED_WING),
        ("mavsdk", 12, FIXED_WING),
    ],
)
async def test_plane_gets_no_mode_no_arming_and_one_line(kind: str, autopilot: int, mav_type: int) -> None:
    port = free_port()
    plane = FakeAutopilot(port, autopilot=autopilot)
    plane.mav_type, plane.vtol_state, plane.base_mode = mav_type, MC, 29 | 128
    if mav_type == QUADROTOR:
        plane.vtol_state = FW
    plane.start()
    flight = LiveFlight(kind, port)
    try:
        async with flight.running():
            plane.landed(2)
            await flight.until(lambda: flight.driver.state.vtol_state is not None)
            for text in ("takeoff 5", "hold", "stop", "land", "rtl", "goto 5 0"):
                outcome = await flight.fly(text, 5.0)
                assert (outcome.success, "MAV_TYPE" in outcome.reason) == (False, True), (text, outcome)
            with pytest.raises(CommandRefusedError):
                await flight.driver.set_mode(FlightMode.HOLD)
            await flight.loop.shut_down()
        lines = [text for _, text in flight.events if text.startswith("no flight commands: ")]
        assert len(lines) == 1
        assert f"(MAV_TYPE {mav_type})" in lines[0]
        plane.drain()
        sent = {message.command for message in plane.received_named("COMMAND_LONG")}
        assert sent <= ALLOWED_COMMANDS
        assert not plane.received_named(SETPOINT)
    finally:
        await plane.stop()


async def test_shutdown_after_a_change_of_type_sends_no_mode() -> None:
    port = free_port()
    vehicle = FakeAutopilot(port)
    vehicle.start()
    flight = LiveFlight("pymavlink", port)
    try:
        async with flight.running():
            vehicle.mav_type, vehicle.custom_mode = FIXED_WING, OFFBOARD
            await flight.until(lambda: flight.driver.state.not_flown)
            vehicle.drain()
            before = len(vehicle.received_named("COMMAND_LONG"))
            flight.streamer.submit(Setpoint.brake(time.monotonic_ns()))
            flight.streamer.tick(time.monotonic_ns())  # streaming, so a shutdown requests HOLD
            await asyncio.wait_for(flight.loop.shut_down(), 10.0)
            vehicle.drain()
            assert [level for level, text in flight.events if text.startswith("shutdown: ")] == ["error"]
            assert not vehicle.received_named(SETPOINT)
            commands = {message.command for message in vehicle.received_named("COMMAND_LONG")[before:]}
            assert commands <= ALLOWED_COMMANDS
    finally:
        await vehicle.stop()
