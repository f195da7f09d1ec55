"""Guidance with a real driver, a real socket and the simulated vehicle in its own process."""

import asyncio
import math
import time
from typing import Any

import pytest
from pymavlink import mavutil

from companion.guidance.behaviour import Outcome
from companion.vehicle.state import FlightMode, Vector3, VehicleState
from mavlink_sim.testing import QUICK_FLIGHT, running_simulator
from tests.companion.guidance.guidance_harness import assert_succeeded, known
from tests.companion.live_flight import LiveFlight, ground_station

pytestmark = pytest.mark.realtime

SPEED = 2.0


def choose_mode(station: Any, main: int, sub: int) -> None:
    station.mav.command_long_send(1, 1, mavutil.mavlink.MAV_CMD_DO_SET_MODE, 0, 1, main, sub, 0, 0, 0, 0)


def speed_mps(state: VehicleState) -> float:
    """Horizontal speed."""
    return math.hypot(*known(state.velocity_ned_mps)[:2])


def off_m(state: VehicleState, north_m: float, east_m: float) -> float:
    """Horizontal distance from a point that is given from home."""
    home, here = known(state.home_position_ned_m), state.position_ned_m
    return math.dist(known(here)[:2], (home[0] + north_m, home[1] + east_m))


@pytest.mark.parametrize("kind", ["pymavlink", pytest.param("mavsdk", marks=pytest.mark.slow)])
async def test_flight_until_the_pilot_takes_over(kind: str) -> None:
    # Arming moves home by what the height has drifted.
    drift = ["height_drift 0.73 over=2"]
    with (
        running_simulator(speed=SPEED, parameters=QUICK_FLIGHT, faults=drift) as simulator,
        ground_station(simulator.gcs_port) as station,
    ):
        service = LiveFlight(kind, simulator.onboard_port)
        async with service.running():
            driver, guidance = service.driver, service.guidance
            await service.until(lambda: driver.state.ready_to_arm and driver.state.position_ned_m)
            assert not driver.state.armed

            assert_succeeded(await service.fly("takeoff 3"))
            assert driver.state.altitude_m == pytest.approx(3.0, abs=0.6)

            path = "follow-path 0,0 5,0 5,5 speed=2 laps=0"
            assert await service.fly(path) == Outcome(True, "in progress")
            assert driver.state.mode is FlightMode.OFFBOARD
            await service.until(lambda: off_m(driver.state, 5.0, 0.0) < 1.0)
            await service.until(lambda: off_m(driver.state, 5.0, 3.0) < 1.0)
            await service.until(lambda: speed_mps(driver.state) > 1.5)
            assert guidance.busy

            # The station must have received from the vehicle to know its address.
            assert await asyncio.to_thread(station.wait_heartbeat, timeout=10)
            choose_mode(station, 4, 3)  # AUTO.LOITER
            await service.until(lambda: not guidance.in_command, 10.0)
            sent = service.streamer.sent_count
            level, text = service.events[-1]
            assert level == "warning"
            assert "pilot" in text
            assert "hold mode" in text

            # Longer than PX4 takes to return to OFFBOARD if setpoints come.
            watched_until = time.monotonic() + 2.0
            await service.until(lambda: time.monotonic() > watched_until)
            assert service.streamer.sent_count == sent
            # By value, as mypy has narrowed the enum to OFFBOARD.
            assert service.driver.state.mode is FlightMode.HOLD
            assert not guidance.in_command

            # Only an operator's new command takes the vehicle back.
            assert_succeeded(await service.fly("land"))
            assert not driver.state.armed
            assert service.streamer.sent_count == sent


@pytest.mark.slow
async def test_goto_and_follow_path_with_the_built_in_vehicle() -> None:
    """By the telemetry's position: where goto ends, and the cross-track error of follow-path."""
    with running_simulator(speed=SPEED, seed=3, parameters=QUICK_FLIGHT) as simulator:
        service = LiveFlight("pymavlink", simulator.onboard_port)
        async with service.running():
            driver = service.driver
            await service.until(lambda: driver.state.ready_to_arm and driver.state.position_ned_m)
            assert (await service.fly("takeoff 3")).success
            home = known(driver.state.home_position_ned_m)

            outcome = assert_succeeded(await service.fly("goto 6 -3 altitude=5 speed=4"))
            here = known(driver.state.position_ned_m)
            north, east, down = here
            assert math.dist((north - home[0], east - home[1], home[2] - down), (6, -3, 5)) < 1.2

            positions: list[Vector3 | None] = []
            unsubscribe = driver.subscribe(lambda state: positions.append(state.position_ned_m))
            outcome = await service.fly("follow-path 6,5 0,5 0,0,3")
            unsubscribe()
            assert outcome.success, outcome.reason
            for corner in ((6.0, 5.0), (0.0, 5.0), (0.0, 0.0)):
                wanted = (home[0] + corner[0], home[1] + corner[1])
                assert min(math.dist(wanted, (position or ())[:2]) for position in positions) < 1.5, corner
            assert (await service.fly("land")).success
