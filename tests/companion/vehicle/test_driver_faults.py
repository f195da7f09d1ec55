"""Both drivers with faults of the link and the vehicle: they fulfil their contract or report why not."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import AsyncIterator
from contextlib import AbstractContextManager, asynccontextmanager
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from companion.vehicle.autopilot_driver import AutopilotDriver
from companion.vehicle.driver import CommandRefusedError, Driver
from companion.vehicle.drivers import DriverKind, open_driver
from companion.vehicle.state import FlightMode, LandedState, VehicleState
from mavlink_sim.testing import QUICK_FLIGHT, RunningSimulator, running_simulator
from tests.companion.vehicle.fake_autopilot import streaming, wait_for_state, wait_until

pytestmark = pytest.mark.realtime

# What each library does itself is tested with both in test_driver_commands.py, and below on a bad link.
SHARED = pytest.mark.parametrize("kind", ["pymavlink", pytest.param("mavsdk", marks=pytest.mark.slow)])
PARAMETERS = {**QUICK_FLIGHT, "COM_OF_LOSS_T": 2.0, "COM_OBL_RC_ACT": 4.0}


def simulated(**options: Any) -> AbstractContextManager[RunningSimulator]:
    """A vehicle that can be armed at once, at twice real time."""
    return running_simulator(**{"speed": 2.0, "ready_after": 0.0, **options})


@asynccontextmanager
async def connected(kind: DriverKind, simulator: RunningSimulator) -> AsyncIterator[AutopilotDriver]:
    driver = open_driver(kind, f"udpin://127.0.0.1:{simulator.onboard_port}")
    assert isinstance(driver, AutopilotDriver)
    await driver.connect(20.0)
    try:
        yield driver
    finally:
        await driver.close()


async def ready(driver: Driver) -> None:
    await wait_for_state(
        driver,
        lambda s: s.ready_to_arm and s.home_altitude_amsl_m is not None and s.position_ned_m is not None,
    )


async def test_commands_and_parameters_work_on_a_bad_link(kind: DriverKind) -> None:
    bad = {
        0.75: ["packet_loss 0.05", "duplicate 0.2", "reorder 0.2"],
        0.5: ["link_delay 0.2 jitter=0.1"],
        0.25: ["corrupt 0.05"],
    }
    with simulated(faults=bad[0.75], seed=2) as simulator:
        async with connected(kind, simulator) as driver:
            await ready(driver)
            for timeout_s, faults in bad.items():
                since = len(simulator.events)
                for line in ("end all", *faults):
                    simulator.fault(line)
                await asyncio.to_thread(simulator.wait_for_event, f"{faults[-1]} begins", since=since)
                await driver.set_parameter("COM_OF_LOSS_T", timeout_s)
                # A late duplicate from before the change may be taken for the first answer: PARAM_VALUE has
                # no sequence number.
                read = [await driver.get_parameter("COM_OF_LOSS_T") for _ in range(3)]
                assert read[-1] == timeout_s
                await driver.set_mode(FlightMode.HOLD)
                await driver.arm()
                assert driver.state.armed
                await driver.disarm()
                assert not driver.state.armed


@SHARED
async def test_corrupted_messages_do_not_reach_the_state(kind: DriverKind) -> None:
    """No damaged message may reach the state: the height stays near the ground and the mode is valid."""
    with simulated(faults=["corrupt 0.5 way=out"], seed=3) as simulator:
        async with connected(kind, simulator) as driver:
            seen: list[VehicleState] = []
            driver.subscribe(seen.append)
            await wait_until(lambda: len(seen) > 200, 20.0)
            for state in seen:
                assert state.mode is FlightMode.HOLD
                assert not state.armed
                assert state.position_ned_m is None or max(map(abs, state.position_ned_m)) < 2.0
                assert state.battery_fraction is None or state.battery_fraction > 0.5


@SHARED
async def test_refused_mode_fails_and_lost_acknowledgement_does_not(kind: DriverKind) -> None:
    with simulated(faults=["refuse_mode LAND"]) as simulator:
        async with connected(kind, simulator) as driver:
            await ready(driver)
            asked_s = time.monotonic()
            with pytest.raises(CommandRefusedError, match=r"land \(temporarily rejected\)"):
                await driver.set_mode(FlightMode.LAND)
            assert time.monotonic() - asked_s < 2.5  # before the timeout of 3 s
            simulator.fault("lost_ack 1 command=400")
            await asyncio.to_thread(simulator.wait_for_event, "fault 2 lost_ack")
            await driver.arm()
            assert simulator.events.count("armed") == 1
            await driver.disarm()
            simulator.fault("lost_ack command=400")
            await asyncio.to_thread(simulator.wait_for_event, "fault 3 lost_ack")
            await driver.arm()  # it is reported
            assert simulator.events.count("armed") == 2


@SHARED
async def test_link_loss_and_return_are_logged(kind: DriverKind, caplog: pytest.LogCaptureFixture) -> None:
    """With heartbeats alone it is connected, and its position is stale."""
    caplog.set_level(logging.INFO)
    with simulated() as simulator:
        async with connected(kind, simulator) as driver:
            await ready(driver)
            simulator.fault("heartbeat_only")
            await wait_until(lambda: not driver.state.position_fresh(time.monotonic_ns()), 5.0)
            before_ns = driver.state.heartbeat_ns
            await wait_until(lambda: driver.state.heartbeat_ns > before_ns, 5.0)
            assert driver.state.connected(time.monotonic_ns())
            simulator.fault("end all")
            await wait_for_state(driver, lambda s: s.position_fresh(time.monotonic_ns()))
            simulator.fault("link_loss for=10")  # simulated seconds
            await wait_until(lambda: "no heartbeat" in caplog.text, 10.0)
            assert not driver.state.connected(time.monotonic_ns())
            assert not driver.state.position_fresh(time.monotonic_ns())
            await wait_until(lambda: "received again" in caplog.text, 10.0)
            await wait_for_state(driver, lambda s: s.position_fresh(time.monotonic_ns()))


@SHARED
async def test_delayed_telemetry_has_measurement_stamps(
    kind: DriverKind,
) -> None:
    with simulated(speed=1.0) as simulator:
        async with connected(kind, simulator) as driver:
            await ready(driver)
            await wait_until(lambda: driver.state.clock is not None, 5.0)
            clock = driver.state.clock
            assert clock is not None
            assert 0 < clock.error_ns < 50_000_000
            late = []
            driver.subscribe(lambda state: late.append(time.monotonic_ns() - state.position_ns))
            simulator.fault("link_delay 0.3 way=out")
            # Stamped by its arrival it would always look fresh.
            await wait_until(lambda: bool(late) and late[-1] > 200_000_000, 5.0)


@SHARED
async def test_stopped_stream_is_requested_and_clock_jump_back_is_one_warning(
    kind: DriverKind, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    with simulated(speed=1.0) as simulator:
        async with connected(kind, simulator) as driver:
            await ready(driver)
            never = -1.0
            await driver._command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 32, never)
            await wait_until(lambda: not driver.state.position_fresh(time.monotonic_ns()), 5.0)
            await wait_for_state(driver, lambda s: "LOCAL_POSITION_NED" in s.missing_streams)
            await wait_for_state(driver, lambda s: s.position_fresh(time.monotonic_ns()))
            await wait_for_state(driver, lambda s: not s.missing_streams)

            simulator.fault("time_jump 1000")
            # A message sent before the jump does not count.
            await wait_until(
                lambda: driver._telemetry._boot_ms.get("LOCAL_POSITION_NED", 0) > 1_000_000, 10.0
            )
            seen_ns = driver.state.position_ns
            await wait_until(lambda: driver.state.position_ns > seen_ns, 5.0)
            simulator.fault("end all")
            await wait_until(lambda: "has restarted" in caplog.text, 10.0)
            await driver.arm()
            assert caplog.text.count("has restarted") == 1
            assert "no heartbeat" not in caplog.text


@SHARED
async def test_vehicle_is_usable_after_a_reboot(kind: DriverKind, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    with simulated() as simulator:
        async with connected(kind, simulator) as driver:
            await ready(driver)
            before = driver.state.home_altitude_amsl_m
            await driver.arm()
            # A restart is a clock that goes back by more than reordered datagrams do.
            await wait_until(lambda: driver._telemetry._boot_ms.get("LOCAL_POSITION_NED", 0) > 6_000, 10.0)
            simulator.fault("reboot 2")
            await wait_for_state(driver, lambda s: not s.armed)
            await wait_until(lambda: "has restarted" in caplog.text, 10.0)
            await wait_for_state(driver, lambda s: s.ready_to_arm)
            await driver.arm()
            # Home is requested again.
            await wait_for_state(driver, lambda s: s.home_altitude_amsl_m is not None)
            assert driver.state.home_altitude_amsl_m == pytest.approx(before, abs=0.5)


@SHARED
async def test_second_autopilot_is_ignored_or_prevents_arming(
    kind: DriverKind, caplog: pytest.LogCaptureFixture
) -> None:
    """With its own id it is ignored. With the same one, at the same address, they are indistinguishable: it
    is logged, and arming is refused.
    """
    caplog.set_level(logging.INFO)
    with simulated() as simulator:
        async with connected(kind, simulator) as driver:
            await ready(driver)
            seen: list[VehicleState] = []
            unsubscribe = driver.subscribe(seen.append)
            simulator.fault("second_autopilot 9")
            await wait_until(lambda: "9/1" in caplog.text, 10.0)
            await driver.arm()
            assert all(abs(state.position_ned_m[1]) < 5.0 for state in seen if state.position_ned_m)
            unsubscribe()
            await driver.disarm()
            simulator.fault("end all")
            await asyncio.to_thread(simulator.wait_for_event, "second_autopilot system=9 ends")
            since = len(simulator.events)

            simulator.fault("second_autopilot")
            await wait_until(lambda: "two autopilots" in caplog.text, 10.0)
            assert caplog.text.count("has restarted") <= 1
            with pytest.raises(CommandRefusedError, match="two autopilots"):
                await driver.arm()
            await wait_until(lambda: not driver.state.position_fresh(time.monotonic_ns()), 5.0)
            simulator.fault("end all")
            await asyncio.to_thread(simulator.wait_for_event, "second_autopilot ends", since=since)
            await wait_until(lambda: not driver._telemetry.two_autopilots(time.monotonic_ns()), 10.0)
            await wait_for_state(driver, lambda s: s.ready_to_arm)
            await driver.arm()


@SHARED
async def test_delayed_setpoints_keep_the_vehicle_in_offboard(kind: DriverKind) -> None:
    with simulated(parameters=PARAMETERS, seed=4) as simulator:
        async with connected(kind, simulator) as driver:
            await ready(driver)
            await driver.takeoff(3.0)
            await driver.arm()
            await wait_for_state(
                driver, lambda s: s.landed is LandedState.IN_AIR and s.mode is FlightMode.HOLD
            )
            async with streaming(driver, (0.0, 0.0, 0.0)) as streamer:
                await wait_until(lambda: streamer.sent_count > 0, 5.0)
                await driver.set_mode(FlightMode.OFFBOARD)
                simulator.fault("link_delay 0.3 jitter=0.1")
                simulator.fault("packet_loss 0.3")
                simulator.fault("reorder 0.3")
                before = len(simulator.events)
                sent = streamer.sent_count
                await wait_until(lambda: streamer.sent_count > sent + 120, 20.0)
                assert driver.state.mode is FlightMode.OFFBOARD
                assert not [event for event in simulator.events[before:] if "failsafe" in event]
                # Nothing is received any more: the vehicle's own failsafe acts.
                simulator.fault("link_loss for=8")
                await asyncio.to_thread(
                    simulator.wait_for_event, "failsafe: offboard setpoints lost", since=before
                )


@pytest.mark.parametrize(
    ("kind", "autopilot"),
    [
        ("pymavlink", "px4"),
        pytest.param("mavsdk", "px4", marks=pytest.mark.slow),  # as in SHARED
        ("pymavlink", "ardupilot"),
    ],
)
async def test_estimator_reset_and_loss_are_in_the_state(kind: DriverKind, autopilot: str) -> None:
    with simulated(autopilot=autopilot, speed=4.0) as simulator:
        async with connected(kind, simulator) as driver:
            await wait_for_state(driver, lambda s: s.position_valid is True and s.position_ned_m is not None)
            before = driver.state.position_ned_m
            simulator.fault("ekf_reset 5 3 -1")
            await wait_for_state(driver, lambda s: s.reset_count == 1)
            assert driver.state.reset_offset_ned_m == pytest.approx((5.0, 3.0, -1.0), abs=0.3)
            assert driver.state.position_ned_m == pytest.approx(before, abs=0.6)
            simulator.fault("gps_loss")
            await wait_for_state(driver, lambda s: s.position_valid is False, 20.0)
            assert driver.state.position_fresh(time.monotonic_ns())
            assert "estimator" in (driver.state.position_fault(time.monotonic_ns()) or "")
