"""Both drivers on links and vehicles that fail: what they promise they still do, or they say why not."""

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
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import FlightMode, LandedState, VehicleState
from companion.vehicle.streamer import Streamer
from mavlink_sim.testing import RunningSimulator, running_simulator
from tests.companion.vehicle.fake_autopilot import state_shows, wait_until

PARAMETERS = {"COM_OF_LOSS_T": 2.0, "COM_OBL_RC_ACT": 4.0}


def simulated(**options: Any) -> AbstractContextManager[RunningSimulator]:
    """A vehicle that can be armed at once, at twice the pace."""
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
    await state_shows(
        driver,
        lambda s: s.ready_to_arm and s.home_altitude_amsl_m is not None and s.position_ned_m is not None,
    )


@asynccontextmanager
async def hovering(driver: Driver) -> AsyncIterator[Streamer]:
    """A setpoint stream of standing still."""
    streamer = Streamer(driver.send_setpoint, brake_s=0.1)

    async def want() -> None:
        while True:
            streamer.submit(Setpoint.velocity((0.0, 0.0, 0.0), time.monotonic_ns(), yaw_rate_radps=0.0))
            await asyncio.sleep(0.05)

    tasks = [asyncio.create_task(want()), asyncio.create_task(streamer.run())]
    try:
        yield streamer
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


@pytest.mark.parametrize(
    "faults",
    [
        pytest.param(["link_delay 0.2 jitter=0.1"], id="late and jittering"),
        pytest.param(["packet_loss 0.05", "duplicate 0.2", "reorder 0.2"], id="losing, doubling, reordering"),
        pytest.param(["corrupt 0.05"], id="corrupting"),
    ],
)
async def test_on_a_bad_link_commands_and_parameters_still_come_through(
    kind: DriverKind, faults: list[str]
) -> None:
    with simulated(faults=faults, seed=2) as simulator:
        async with connected(kind, simulator) as driver:
            await ready(driver)
            await driver.set_parameter("COM_OF_LOSS_T", 0.75)
            # A late duplicate of an answer from before the change may be taken for the first one's answer:
            # PARAM_VALUE has no number to tell them apart by.
            read = [await driver.get_parameter("COM_OF_LOSS_T") for _ in range(3)]
            assert read[-1] == 0.75
            await driver.set_mode(FlightMode.HOLD)
            await driver.arm()
            assert driver.state.armed
            await driver.disarm()
            assert not driver.state.armed


async def test_what_corruption_lets_through_is_true(kind: DriverKind) -> None:
    """No damaged message may reach the state: heights stay near the ground and the mode a mode."""
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


async def test_a_lost_acknowledgement_costs_a_repetition_and_all_of_them_an_answer(kind: DriverKind) -> None:
    with simulated() as simulator:
        async with connected(kind, simulator) as driver:
            await ready(driver)
            simulator.fault("lost_ack 1 command=400")
            await asyncio.to_thread(simulator.wait_for_event, "fault 1 lost_ack")
            await driver.arm()
            assert simulator.events.count("armed") == 1
            await driver.disarm()
            simulator.fault("lost_ack command=400")
            await asyncio.to_thread(simulator.wait_for_event, "fault 2 lost_ack")
            with pytest.raises(CommandRefusedError, match=r"does not answer command 400"):
                await driver.arm()


async def test_a_refused_mode_is_told_of_at_once(kind: DriverKind) -> None:
    with simulated(faults=["refuse_mode LAND"]) as simulator:
        async with connected(kind, simulator) as driver:
            await ready(driver)
            asked_s = time.monotonic()
            with pytest.raises(CommandRefusedError, match=r"refused mode land \(temporarily rejected\)"):
                await driver.set_mode(FlightMode.LAND)
            assert time.monotonic() - asked_s < 2.5  # not by the timeout of 3 s


async def test_a_dead_link_is_told_of_and_its_return_too(
    kind: DriverKind, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    with simulated() as simulator:
        async with connected(kind, simulator) as driver:
            await ready(driver)
            simulator.fault("link_loss for=10")  # simulated seconds
            await wait_until(lambda: "is silent" in caplog.text, 10.0)
            assert not driver.state.connected(time.monotonic_ns())
            assert not driver.state.position_fresh(time.monotonic_ns())
            await wait_until(lambda: "is back" in caplog.text, 10.0)
            await state_shows(driver, lambda s: s.position_fresh(time.monotonic_ns()))


async def test_late_telemetry_bears_the_time_when_it_was_true(
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
            # By its arrival it would look fresh for ever.
            await wait_until(lambda: bool(late) and late[-1] > 200_000_000, 5.0)


async def test_with_heartbeats_alone_the_vehicle_is_connected_but_its_position_is_stale(
    kind: DriverKind,
) -> None:
    with simulated() as simulator:
        async with connected(kind, simulator) as driver:
            await ready(driver)
            simulator.fault("heartbeat_only")
            await wait_until(lambda: not driver.state.position_fresh(time.monotonic_ns()), 5.0)
            heard_ns = driver.state.heartbeat_ns
            await wait_until(lambda: driver.state.heartbeat_ns > heard_ns, 5.0)
            assert driver.state.connected(time.monotonic_ns())


async def test_a_stream_that_somebody_stopped_is_asked_for_until_it_comes(kind: DriverKind) -> None:
    with simulated() as simulator:
        async with connected(kind, simulator) as driver:
            await ready(driver)
            never = -1.0
            await driver._command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 32, never)
            await wait_until(lambda: not driver.state.position_fresh(time.monotonic_ns()), 5.0)
            await state_shows(driver, lambda s: "LOCAL_POSITION_NED" in s.missing_streams)
            await state_shows(driver, lambda s: s.position_fresh(time.monotonic_ns()))
            await state_shows(driver, lambda s: not s.missing_streams)


async def test_a_reboot_is_noticed_and_the_vehicle_can_be_used_again(
    kind: DriverKind, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    with simulated() as simulator:
        async with connected(kind, simulator) as driver:
            await ready(driver)
            before = driver.state.home_altitude_amsl_m
            await driver.arm()
            # A restart is a clock that goes back by more than datagrams overtake each other.
            await wait_until(lambda: driver._telemetry._boot_ms.get("LOCAL_POSITION_NED", 0) > 6_000, 10.0)
            simulator.fault("reboot 2")
            await state_shows(driver, lambda s: not s.armed)
            await wait_until(lambda: "has restarted" in caplog.text, 10.0)
            await state_shows(driver, lambda s: s.ready_to_arm)
            await driver.arm()
            # what was known of home is asked for again
            await state_shows(driver, lambda s: s.home_altitude_amsl_m is not None)
            assert driver.state.home_altitude_amsl_m == pytest.approx(before, abs=0.5)


async def test_a_clock_that_jumps_back_costs_one_warning_and_no_data(
    kind: DriverKind, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    with simulated() as simulator:
        async with connected(kind, simulator) as driver:
            await ready(driver)
            simulator.fault("time_jump 1000")
            # A message that was still on its way from before would not do.
            await wait_until(
                lambda: driver._telemetry._boot_ms.get("LOCAL_POSITION_NED", 0) > 1_000_000, 10.0
            )
            seen_ns = driver.state.position_ns
            await wait_until(lambda: driver.state.position_ns > seen_ns, 5.0)
            simulator.fault("end all")
            await wait_until(lambda: "has restarted" in caplog.text, 10.0)
            await driver.arm()
            assert caplog.text.count("has restarted") == 1
            assert "is silent" not in caplog.text


async def test_a_second_autopilot_with_its_own_system_id_changes_nothing(
    kind: DriverKind, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    with simulated() as simulator:
        async with connected(kind, simulator) as driver:
            await ready(driver)
            seen: list[VehicleState] = []
            driver.subscribe(seen.append)
            simulator.fault("second_autopilot 9")
            await wait_until(lambda: "9/1" in caplog.text, 10.0)
            await driver.arm()
            assert all(abs(state.position_ned_m[1]) < 5.0 for state in seen if state.position_ned_m)


async def test_a_second_autopilot_of_the_same_id_is_named(
    kind: DriverKind, caplog: pytest.LogCaptureFixture
) -> None:
    """From the same address the two cannot be told apart; what can be done is to say it, and not fly."""
    caplog.set_level(logging.WARNING)
    with simulated() as simulator:
        async with connected(kind, simulator) as driver:
            await ready(driver)
            simulator.fault("second_autopilot")
            await wait_until(lambda: "two autopilots send as system 1" in caplog.text, 10.0)
            assert caplog.text.count("has restarted") <= 1
            with pytest.raises(CommandRefusedError, match="two autopilots answer as system 1"):
                await driver.arm()
            await wait_until(lambda: not driver.state.position_fresh(time.monotonic_ns()), 5.0)
            simulator.fault("end all")
            await asyncio.to_thread(simulator.wait_for_event, "second_autopilot ends")
            await wait_until(lambda: not driver._telemetry.two_autopilots(time.monotonic_ns()), 10.0)
            await state_shows(driver, lambda s: s.ready_to_arm)
            await driver.arm()


async def test_setpoints_that_come_late_and_with_gaps_keep_the_vehicle_in_offboard(kind: DriverKind) -> None:
    with simulated(parameters=PARAMETERS, seed=4) as simulator:
        async with connected(kind, simulator) as driver:
            await ready(driver)
            await driver.takeoff(3.0)
            await driver.arm()
            await state_shows(driver, lambda s: s.landed is LandedState.IN_AIR and s.mode is FlightMode.HOLD)
            async with hovering(driver) as streamer:
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
                # nothing gets through any more: the vehicle's own failsafe acts, and is seen afterwards
                simulator.fault("link_loss for=8")
                await asyncio.to_thread(
                    simulator.wait_for_event, "failsafe: offboard setpoints lost", since=before
                )


@pytest.mark.parametrize(
    ("kind", "autopilot"), [("pymavlink", "px4"), ("mavsdk", "px4"), ("pymavlink", "ardupilot")]
)
async def test_a_reset_of_the_estimate_and_its_loss_are_known(kind: DriverKind, autopilot: str) -> None:
    with simulated(autopilot=autopilot, speed=4.0) as simulator:
        async with connected(kind, simulator) as driver:
            await state_shows(driver, lambda s: s.position_valid is True and s.position_ned_m is not None)
            before = driver.state.position_ned_m
            simulator.fault("ekf_reset 5 3 -1")
            await state_shows(driver, lambda s: s.reset_count == 1)
            assert driver.state.reset_offset_ned_m == pytest.approx((5.0, 3.0, -1.0), abs=0.3)
            assert driver.state.position_ned_m == pytest.approx(before, abs=0.6)
            simulator.fault("gps_loss")
            await state_shows(driver, lambda s: s.position_valid is False, 20.0)
            assert driver.state.position_fresh(time.monotonic_ns())
            fault = driver.state.position_fault(time.monotonic_ns())
            assert fault == "the autopilot's estimator reports it as not valid"
