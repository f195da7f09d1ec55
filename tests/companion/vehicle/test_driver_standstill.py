"""Both drivers after a suspend: nothing that moves the vehicle leaves before it is acknowledged."""

from __future__ import annotations

import asyncio
import contextlib
import time

import pytest

from companion.host.clock import StandstillWatch, boottime_ns
from companion.vehicle.autopilot_driver import AutopilotDriver
from companion.vehicle.driver import CommandRefusedError, Driver, SystemStatus
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import FlightMode
from tests.companion.vehicle.fake_autopilot import HOLD, SETPOINT, FakeAutopilot, wait_until

pytestmark = pytest.mark.realtime
ARM, SET_MODE, TAKEOFF = 400, 176, 22


class Suspend:
    """The driver's clocks. `seconds` of suspend are added to CLOCK_BOOTTIME."""

    def __init__(self, driver: Driver) -> None:
        assert isinstance(driver, AutopilotDriver)
        self.seconds = 0.0
        self.watch = StandstillWatch(lambda: boottime_ns() + round(self.seconds * 1e9))
        driver.watch = self.watch

    def acknowledge(self) -> None:
        self.watch.acknowledge(self.watch.observe())


def commands(autopilot: FakeAutopilot) -> list[int]:
    """Those that change mode or arming."""
    received = [message.command for message in autopilot.received_named("COMMAND_LONG")]
    return [command for command in received if command in (ARM, SET_MODE, TAKEOFF)]


async def one_message_later(driver: Driver, autopilot: FakeAutopilot) -> None:
    """Wait until a message that is sent now has arrived: what was sent before has arrived too."""
    count = len(autopilot.received_named("HEARTBEAT"))
    driver.send_heartbeat(SystemStatus.ACTIVE)
    await autopilot.wait_for("HEARTBEAT", count + 1)


async def test_no_setpoint_leaves_after_a_suspend(driver: Driver, autopilot: FakeAutopilot) -> None:
    suspend = Suspend(driver)
    old = Setpoint.brake(time.monotonic_ns(), lifetime_s=5.0)
    driver.send_setpoint(old)
    await autopilot.wait_for(SETPOINT)
    suspend.seconds = 2.0
    driver.send_setpoint(old)
    driver.send_setpoint(Setpoint.brake(time.monotonic_ns()))
    driver.send_setpoint(Setpoint.brake(suspend.watch.now_ns()))
    await one_message_later(driver, autopilot)
    assert len(autopilot.received_named(SETPOINT)) == 1
    suspend.acknowledge()
    driver.send_setpoint(Setpoint.brake(time.monotonic_ns()))
    await autopilot.wait_for(SETPOINT, 2)


async def test_no_command_starts_after_a_suspend(driver: Driver, autopilot: FakeAutopilot) -> None:
    suspend = Suspend(driver)
    autopilot.home()
    await wait_until(lambda: driver.state.home_altitude_amsl_m is not None, 5.0)
    suspend.seconds = 60.0
    tasks = [
        asyncio.create_task(request)
        for request in (driver.arm(), driver.set_mode(FlightMode.OFFBOARD), driver.disarm())
    ]
    await asyncio.wait(tasks, timeout=1.5)
    for task in tasks:
        task.cancel()
    results = await asyncio.gather(*tasks, return_exceptions=True)
    assert all(isinstance(each, CommandRefusedError | asyncio.CancelledError) for each in results)
    await one_message_later(driver, autopilot)
    assert commands(autopilot) == []


async def test_pending_arming_is_not_repeated_after_a_suspend(
    driver: Driver, autopilot: FakeAutopilot
) -> None:
    suspend = Suspend(driver)
    autopilot.answers["COMMAND_LONG"] = lambda message: None
    arming = asyncio.create_task(driver.arm())
    await wait_until(lambda: commands(autopilot) == [ARM], 5.0)
    suspend.seconds = 42.0
    await asyncio.wait({arming}, timeout=1.2)  # two repetitions are due
    arming.cancel()  # as the guidance loop does in its first step
    suspend.acknowledge()
    with contextlib.suppress(asyncio.CancelledError, CommandRefusedError):
        await arming
    await asyncio.sleep(1.2)
    await one_message_later(driver, autopilot)
    assert commands(autopilot) == [ARM]


async def test_discarded_state_waits_for_new_messages(driver: Driver, autopilot: FakeAutopilot) -> None:
    await wait_until(lambda: driver.state.connected(time.monotonic_ns()), 5.0)
    autopilot.sends_heartbeats = False
    await one_message_later(driver, autopilot)
    driver.discard_received()
    assert not driver.state.connected(time.monotonic_ns())
    assert driver.state.position_fault(time.monotonic_ns()) is not None
    autopilot.sends_heartbeats, autopilot.custom_mode = True, HOLD
    await wait_until(lambda: driver.state.connected(time.monotonic_ns()), 5.0)


async def test_what_waits_in_the_socket_is_discarded(driver: Driver, autopilot: FakeAutopilot) -> None:
    await wait_until(lambda: driver.state.mode is FlightMode.HOLD, 5.0)
    autopilot.sends_heartbeats = False
    await one_message_later(driver, autopilot)
    autopilot.custom_mode = 0x00060000  # OFFBOARD
    autopilot.heartbeat()  # in the buffer: this test has not returned to the loop
    driver.discard_received()
    await one_message_later(driver, autopilot)
    assert driver.state.mode is FlightMode.HOLD
    assert driver.state.heartbeat_ns == 0


async def test_expired_request_is_not_sent(driver: Driver, autopilot: FakeAutopilot) -> None:
    suspend = Suspend(driver)
    until_ns = suspend.watch.now_ns() + 1_000_000_000
    suspend.seconds = 0.2  # no standstill, but it counts
    for request in (driver.arm, driver.disarm):
        with pytest.raises(CommandRefusedError):
            await request(valid_until_ns=until_ns - 900_000_000)
    with pytest.raises(CommandRefusedError):
        await driver.set_mode(FlightMode.OFFBOARD, valid_until_ns=until_ns - 900_000_000)
    await one_message_later(driver, autopilot)
    assert commands(autopilot) == []


async def test_request_is_not_repeated_after_its_validity(driver: Driver, autopilot: FakeAutopilot) -> None:
    suspend = Suspend(driver)
    autopilot.answers["COMMAND_LONG"] = lambda message: None
    until_ns = suspend.watch.now_ns() + 250_000_000
    with pytest.raises(CommandRefusedError):
        await driver.arm(valid_until_ns=until_ns)
    assert commands(autopilot) == [ARM]


async def test_abandoned_request_is_not_repeated(driver: Driver, autopilot: FakeAutopilot) -> None:
    autopilot.answers["COMMAND_LONG"] = lambda message: None
    arming = asyncio.create_task(driver.arm())
    await wait_until(lambda: commands(autopilot) == [ARM], 5.0)
    driver.abandon("suspended")
    with pytest.raises(CommandRefusedError, match="suspended"):
        await arming
    await asyncio.sleep(1.2)
    assert commands(autopilot) == [ARM]
