"""Guidance, pymavlink driver and a Copter in its own process: a flight until the pilot takes over."""

from __future__ import annotations

import asyncio
import math
import time

import pytest

from companion.guidance.behaviour import Outcome
from companion.vehicle.state import FlightMode, VehicleState
from mavlink_sim.testing import vehicle
from tests.companion.guidance.guidance_harness import assert_succeeded, known
from tests.companion.live_flight import LiveFlight, ground_station

pytestmark = pytest.mark.realtime

LOITER, GUIDED = 5, 4


def speed_mps(state: VehicleState) -> float:
    """Horizontal speed."""
    return math.hypot(*known(state.velocity_ned_mps)[:2])


async def test_flight_until_the_pilot_takes_over_ardupilot() -> None:
    with (
        vehicle(autopilot="ardupilot", speed=2.0, seed=3, parameters={"LAND_SPEED": 200}) as simulator,
        ground_station(simulator.gcs_port) as station,
    ):
        service = LiveFlight("pymavlink", simulator.onboard_port)
        async with service.running():
            driver, guidance = service.driver, service.guidance
            await service.until(lambda: driver.state.ready_to_arm and driver.state.home_position_ned_m)

            assert_succeeded(await service.fly("takeoff 3"))
            assert driver.state.altitude_m == pytest.approx(3.0, abs=0.6)

            assert await service.fly("orbit radius=6 speed=2") == Outcome(True, "in progress")
            await service.until(lambda: speed_mps(driver.state) > 1.5)
            assert driver.state.mode is FlightMode.OFFBOARD
            assert guidance.busy

            # The station must have received from the vehicle to know its address.
            station.mav.heartbeat_send(6, 8, 0, 0, 4)
            assert station.wait_heartbeat(timeout=10)
            station.set_mode(LOITER)
            await service.until(lambda: not guidance.in_command, 10.0)
            level, text = service.events[-1]
            assert level == "warning"
            assert "pilot" in text
            assert "position mode" in text

            # GUIDED again, but not by us: nothing is streamed.
            sent = service.streamer.sent_count
            station.set_mode(GUIDED)
            await service.until(lambda: driver.state.mode is FlightMode.OFFBOARD)
            watched_until = time.monotonic() + 1.0
            await service.until(lambda: time.monotonic() > watched_until)
            assert service.streamer.sent_count == sent
            assert not guidance.in_command

            assert_succeeded(await service.fly("stop"))
            await asyncio.to_thread(simulator.wait_for_event, "mode BRAKE")  # its log comes from a thread
            assert_succeeded(await service.fly("land"))
            assert not driver.state.armed
