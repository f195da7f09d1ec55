"""One contract, two drivers: each controls the simulated vehicle in its own process, over a real socket."""

from __future__ import annotations

import asyncio
import logging
import math
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

from companion.vehicle.autopilot_parameters import FirmwareVersion
from companion.vehicle.driver import CommandRefusedError, Driver
from companion.vehicle.drivers import DriverKind, open_driver
from companion.vehicle.state import FlightMode, HeightSource, LandedState, VehicleState
from companion.vehicle.vision_position import VisionPosition
from mavlink_sim.testing import QUICK_FLIGHT, RunningSimulator, vehicle
from tests.companion.vehicle.fake_autopilot import streaming, wait_for_state, wait_until

pytestmark = pytest.mark.realtime

# pymavlink, the default, flies so in the service's tests. What AutopilotDriver does is the same with both.
FLIGHTS = pytest.mark.parametrize("kind", ["mavsdk", pytest.param("pymavlink", marks=pytest.mark.slow)])
BOTH = pytest.mark.parametrize("kind", ["mavsdk", "pymavlink"])
SHARED = pytest.mark.parametrize("kind", ["pymavlink", pytest.param("mavsdk", marks=pytest.mark.slow)])

# Simulated seconds are short; the loss timeout is long enough in them for a busy test machine.
FLIGHT = {**QUICK_FLIGHT, "COM_OF_LOSS_T": 4.0, "COM_OBL_RC_ACT": 4.0}


@asynccontextmanager
async def connected(
    kind: DriverKind, simulator: RunningSimulator, *, system_id: int | None = None
) -> AsyncIterator[Driver]:
    url = f"udpin://127.0.0.1:{simulator.onboard_port}"
    driver = open_driver(kind, url, system_id=system_id, range_finder_height=True)
    await driver.connect(20.0)
    try:
        yield driver
    finally:
        await driver.close()


def complete(state: VehicleState) -> bool:
    return (
        state.position_fresh(time.monotonic_ns())
        and state.connected(time.monotonic_ns())
        and state.landed is not LandedState.UNKNOWN
        and state.home_position_ned_m is not None
        and state.ready_to_arm
        and state.battery_fraction is not None
        and math.isfinite(state.latitude_deg)
    )


@FLIGHTS
async def test_state_parameters_modes_and_arming_of_two_vehicles(kind: DriverKind) -> None:
    with vehicle(speed=4.0) as simulator, vehicle(speed=4.0, system_id=2, parameters=QUICK_FLIGHT) as two:
        async with connected(kind, simulator) as driver, connected(kind, two, system_id=2) as second:
            state = await wait_for_state(driver, complete)
            assert state.mode is FlightMode.HOLD
            assert state.landed is LandedState.ON_GROUND
            assert state.altitude_m == pytest.approx(0.0, abs=0.5)
            assert state.altitude_amsl_m is not None
            assert state.home_altitude_amsl_m is not None
            assert abs(state.altitude_amsl_m - state.home_altitude_amsl_m) < 1.0

            assert await driver.firmware_version() == FirmwareVersion(1, 17)
            assert await driver.get_parameter("COM_OF_LOSS_T") == 1.0
            await driver.set_parameter("COM_OF_LOSS_T", 0.75)
            await driver.set_parameter("COM_OBL_RC_ACT", 4)
            assert await driver.get_parameter("COM_OF_LOSS_T") == 0.75
            assert await driver.get_parameter("COM_OBL_RC_ACT") == 4.0
            with pytest.raises(CommandRefusedError, match=r"SUCH: .*no such"):
                await driver.get_parameter("COM_NO_SUCH")

            # Disarmed, PX4 accepts every mode, and in MISSION without a mission it is never ready to arm.
            await driver.set_mode(FlightMode.MISSION)
            await wait_for_state(driver, lambda s: not s.ready_to_arm)
            with pytest.raises(CommandRefusedError, match="valid mission available"):
                await driver.arm()
            assert not driver.state.armed
            await driver.set_mode(FlightMode.HOLD)
            await wait_for_state(driver, lambda s: s.ready_to_arm)
            await driver.arm()
            assert driver.state.armed
            await driver.disarm()
            assert not driver.state.armed

            await wait_for_state(second, complete)
            assert await second.get_parameter("COM_OF_LOSS_T") == 1.0
            await second.takeoff(3.0)
            await second.arm()
            await wait_for_state(second, lambda s: (s.altitude_m or 0.0) > 1.0)
            assert not driver.state.armed
            assert driver.state.altitude_m is not None
            assert driver.state.altitude_m < 0.5
            await second.set_mode(FlightMode.LAND)


@FLIGHTS
async def test_px4_failsafe_acts_when_setpoints_end(kind: DriverKind) -> None:
    with vehicle(speed=6.0, parameters=FLIGHT) as simulator:
        async with connected(kind, simulator) as driver:
            await wait_for_state(driver, complete)
            await driver.takeoff(3.0)
            await driver.arm()
            await wait_for_state(
                driver, lambda s: s.landed is LandedState.IN_AIR and s.mode is FlightMode.HOLD
            )
            assert driver.state.altitude_m == pytest.approx(3.0, abs=1.0)
            assert driver.state.height_source is HeightSource.DISTANCE_SENSOR
            assert driver.state.ground_height_m == pytest.approx(driver.state.altitude_m, abs=0.5)
            assert driver.state.horizontal_sigma_m == pytest.approx(0.28)

            with pytest.raises(CommandRefusedError, match="in air"):
                await driver.disarm()
            # PX4 acknowledges both with ACCEPTED first.
            with pytest.raises(CommandRefusedError, match=r"mission .*hold"):
                await driver.set_mode(FlightMode.MISSION)
            with pytest.raises(CommandRefusedError, match=r"offboard .*setpoint stream"):
                await driver.set_mode(FlightMode.OFFBOARD)

            async with streaming(driver, (1.5, 0.0, 0.0)) as streamer:
                await wait_until(lambda: streamer.sent_count > 0, 5.0)
                await driver.set_mode(FlightMode.OFFBOARD)
                await wait_for_state(driver, lambda s: abs((s.velocity_ned_mps or (0.0,))[0] - 1.5) < 0.3)
                assert driver.state.mode is FlightMode.OFFBOARD
            await wait_for_state(driver, lambda s: s.failsafe and s.mode is FlightMode.LAND)
            await wait_for_state(driver, lambda s: not s.armed and s.landed is LandedState.ON_GROUND, 30.0)


@SHARED
async def test_driver_continues_after_a_vehicle_restart(
    kind: DriverKind, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    with vehicle(speed=4.0) as first:
        async with connected(kind, first) as driver:
            await wait_for_state(driver, complete)
            first.kill()
            await wait_until(lambda: "no heartbeat" in caplog.text, 15.0)
            assert not driver.state.connected(time.monotonic_ns())
            with vehicle(speed=4.0, onboard_port=first.onboard_port):
                await wait_until(lambda: "received again" in caplog.text, 15.0)
                await wait_for_state(driver, complete)
                assert driver.link_count > 1
                await driver.arm()
                await driver.disarm()
    lines = [record.getMessage() for record in caplog.records]
    assert sum("no heartbeat" in line or "received again" in line for line in lines) == 2


@BOTH
async def test_vision_position_reaches_the_estimator(kind: DriverKind) -> None:
    covariance = tuple(0.01 if index in (0, 6, 11, 15, 18, 20) else 0.0 for index in range(21))
    with vehicle(parameters={"EKF2_EV_CTRL": 1}) as simulator:
        async with connected(kind, simulator) as driver:
            await wait_for_state(driver, complete)
            simulator.fault("gps_loss")
            until_s = time.monotonic() + 10.0
            while time.monotonic() < until_s:
                now_ns = time.monotonic_ns()
                driver.send_vision_position(
                    VisionPosition(now_ns, (3.0, -2.0, 0.0), (0.0, 0.0, 0.0), covariance)
                )
                await asyncio.sleep(0.04)
                state = driver.state
                if math.hypot(*state.reset_offset_ned_m[:2]) > 3.0:
                    break
            north, east, _ = driver.state.reset_offset_ned_m
            assert (north, east) == pytest.approx((3.0, -2.0), abs=0.6)
