"""One contract, two drivers: discovery, control and pointing of a gimbal over a real socket."""

from __future__ import annotations

import asyncio
import contextlib
import math
import time
from collections.abc import AsyncIterator
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from companion.vehicle.driver import CommandRefusedError, Driver
from companion.vehicle.drivers import DriverKind, open_driver
from companion.vehicle.gimbal import NOBODY, GimbalAim, YawFrame
from companion.vehicle.state import VehicleState
from mavlink_sim.testing import vehicle
from tests.companion.live_flight import ground_station
from tests.companion.vehicle.fake_autopilot import FakeAutopilot, gimbal_of, wait_for_state, wait_until
from vision.attitude import quaternion_from_euler

pytestmark = [pytest.mark.usefixtures("short_measurement"), pytest.mark.realtime]
OURS = (1, 191)


@contextlib.asynccontextmanager
async def connected(kind: DriverKind, port: int) -> AsyncIterator[Driver]:
    driver = open_driver(kind, f"udpin://127.0.0.1:{port}")
    await driver.connect(20.0)
    try:
        yield driver
    finally:
        await driver.close()


async def test_gimbal_control_is_taken_used_and_released(kind: DriverKind) -> None:
    with (
        vehicle(speed=2.0, gimbal=True) as simulator,
        ground_station(simulator.gcs_port) as station,
    ):
        async with connected(kind, simulator.onboard_port) as driver:
            state = await wait_for_state(
                driver, lambda s: s.gimbal is not None and s.gimbal.information_ns > 0
            )
            assert state.gimbal is not None
            assert math.degrees(state.gimbal.lowest_pitch_rad) == pytest.approx(-135.0)
            assert math.degrees(state.gimbal.highest_pitch_rad) == pytest.approx(45.0)
            state = await wait_for_state(
                driver,
                lambda s: (
                    gimbal_of(s).attitude_fresh(time.monotonic_ns())
                    and gimbal_of(s).primary_control == NOBODY
                ),
            )
            assert gimbal_of(state).yaw_frame is YawFrame.NORTH
            # Without a request it is sent 5 times a second, at twice real time here: 10 take 0.9 s.
            stamps: list[int] = []
            unsubscribe = driver.subscribe(lambda s: stamps.append(gimbal_of(s).attitude_ns))
            await wait_until(
                lambda: len(ten := sorted(set(stamps))[-10:]) == 10 and ten[-1] - ten[0] < 0.5e9, 10.0
            )
            unsubscribe()

            with pytest.raises(CommandRefusedError, match=r"\(denied\)"):
                await driver.point_gimbal(GimbalAim(-0.5))
            await driver.take_gimbal()
            await wait_for_state(driver, lambda s: gimbal_of(s).primary_control == OURS)
            for frame in YawFrame:
                aim = GimbalAim(math.radians(-40.0), math.radians(25.0), frame)
                await driver.point_gimbal(aim)

                def aimed(s: VehicleState, aim: GimbalAim = aim) -> bool:
                    assert s.yaw_rad is not None
                    off_rad = gimbal_of(s).off_rad(aim, s.yaw_rad)
                    assert off_rad is not None
                    return off_rad < math.radians(1.0)

                pitch_rad = gimbal_of(await wait_for_state(driver, aimed)).pitch_rad
                assert pitch_rad is not None
                assert math.degrees(pitch_rad) == pytest.approx(-40.0, abs=1.0)

            # The ground station takes control: it is reported, and our command is denied.
            assert await asyncio.to_thread(station.wait_heartbeat, timeout=10)
            station.mav.command_long_send(1, 1, 1001, 0, 245, 190, -1, -1, 0, 0, 0)
            await wait_for_state(driver, lambda s: gimbal_of(s).primary_control == (245, 190))
            with pytest.raises(CommandRefusedError, match="denied"):
                await driver.point_gimbal(GimbalAim(0.0))
            await driver.give_gimbal_back()  # not ours: nothing changes
            since_ns = gimbal_of(driver.state).status_ns
            state = await wait_for_state(driver, lambda s: gimbal_of(s).status_ns > since_ns)
            assert gimbal_of(state).primary_control == (245, 190)

            await driver.take_gimbal()
            await driver.give_gimbal_back()
            await wait_for_state(driver, lambda s: gimbal_of(s).primary_control == NOBODY)


# Both drivers search it with the same code.
@pytest.mark.parametrize("kind", ["pymavlink", pytest.param("mavsdk", marks=pytest.mark.slow)])
async def test_missing_gimbal_is_not_logged(kind: DriverKind, caplog: pytest.LogCaptureFixture) -> None:
    with vehicle(speed=4.0) as simulator:
        async with connected(kind, simulator.onboard_port) as driver:
            assert not await driver.find_gimbal()
            assert driver.state.gimbal is None
    assert "gimbal" not in caplog.text


def information(device: int) -> Any:
    return mavlink.MAVLink_gimbal_manager_information_message(
        7, 0, device, math.nan, math.nan, -1.5, 0.5, math.nan, math.nan
    )


def attitude(flags: int, pitch_rad: float, yaw_rad: float, device: int = 0) -> Any:
    q = quaternion_from_euler(0.0, pitch_rad, yaw_rad)
    nan = math.nan
    return mavlink.MAVLink_gimbal_device_attitude_status_message(
        0, 0, 123_456, flags, list(q), nan, nan, nan, 0, nan, nan, device
    )


async def test_late_gimbal_is_queried(driver: Driver, autopilot: FakeAutopilot) -> None:
    def answer(message: Any) -> None:
        autopilot.acknowledge(message.command)
        if (message.command, message.param1) == (512, 280):
            autopilot.send(information(1))

    await autopilot.wait_for("COMMAND_LONG")
    assert driver.state.gimbal is None
    autopilot.answers["COMMAND_LONG"] = answer
    autopilot.send(mavlink.MAVLink_gimbal_manager_status_message(9, 0, 1, 0, 0, 0, 0))
    state = await wait_for_state(driver, lambda s: s.gimbal is not None and s.gimbal.information_ns > 0)
    assert (gimbal_of(state).device, gimbal_of(state).lowest_pitch_rad) == (1, -1.5)

    def asked() -> set[tuple[float, float]]:
        return {(m.param1, m.param2) for m in autopilot.received_named("COMMAND_LONG") if m.command == 511}

    await wait_until(lambda: {(285, 20_000), (281, 200_000)} <= asked(), 10.0, asked)


async def test_separate_gimbal_component_is_stamped_on_arrival(
    driver: Driver, autopilot: FakeAutopilot, port: int
) -> None:
    other, gimbal = (FakeAutopilot(port, component_id=component) for component in (171, 154))
    autopilot.send(information(154))
    await wait_for_state(driver, lambda s: s.gimbal is not None)
    # As PX4 forwards it: from the gimbal's own component, by the same socket.
    for sender in (other, gimbal):
        sender.socket.close()
        sender.socket = autopilot.socket
    before_ns = time.monotonic_ns()
    other.send(attitude(16, 0.3, 0.0))
    gimbal.send(attitude(32, -0.7, 0.2))
    state = await wait_for_state(driver, lambda s: gimbal_of(s).attitude is not None)
    assert gimbal_of(state).pitch_rad == pytest.approx(-0.7, abs=1e-6)
    assert gimbal_of(state).yaw_frame is YawFrame.NOSE
    assert before_ns <= gimbal_of(state).attitude_ns <= time.monotonic_ns()


async def test_gimbal_commands_of_the_autopilot_are_not_answered(
    driver: Driver, autopilot: FakeAutopilot
) -> None:
    for command, values in (
        (1001, (1.0, 1.0, -1.0, -1.0, 0.0, 0.0, 0.0)),
        (1000, (math.nan, math.nan, math.nan, math.nan, 2.0, 0.0, 0.0)),
        (1001, (-3.0, -3.0, -1.0, -1.0, 0.0, 0.0, 0.0)),
    ):
        for confirmation in (0, 1):
            autopilot.send(mavlink.MAVLink_command_long_message(1, 0, command, confirmation, *values))
    # A later command is answered: the driver works, and all messages before it were processed.
    await driver.point_gimbal(GimbalAim(-0.2))
    await autopilot.wait_for("COMMAND_LONG")
    assert not autopilot.received_named("COMMAND_ACK")
    assert driver.state.gimbal is None
