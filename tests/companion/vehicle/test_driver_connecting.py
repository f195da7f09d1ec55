"""How both drivers find their autopilot, and their errors without one."""

from __future__ import annotations

import asyncio
import os
import time

import pytest
from pymavlink.dialects.v20 import common as mavlink

from companion.service.factory import driver_of
from companion.settings.reading import load_settings
from companion.vehicle.autopilot_driver import AutopilotDriver
from companion.vehicle.driver import CommandRefusedError, Driver, LinkError, NoAnswerError, SystemStatus
from companion.vehicle.drivers import DriverKind, open_driver
from companion.vehicle.framing import CURRENT_MODE_ID
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import FlightMode
from mavlink_sim.testing import free_port
from tests.companion.vehicle.fake_autopilot import SETPOINT, FakeAutopilot, wait_until

pytestmark = [pytest.mark.usefixtures("short_measurement"), pytest.mark.realtime]


async def test_missing_autopilot_is_one_line(kind: DriverKind, port: int) -> None:
    driver = open_driver(kind, f"udpin://127.0.0.1:{port}")
    with pytest.raises(LinkError) as caught:
        await driver.connect(0.3)
    text = str(caught.value)
    assert "no autopilot" in text
    assert f"udpin://127.0.0.1:{port} within 0.3 s" in text
    assert "\n" not in text
    await driver.close()


async def test_other_heartbeat_senders_are_named(kind: DriverKind, port: int) -> None:
    station = FakeAutopilot(port, system_id=255, component_id=190, autopilot=8)
    station.start()
    try:
        with pytest.raises(LinkError, match="only system/component 255/190"):
            await open_driver(kind, f"udpin://127.0.0.1:{port}").connect(0.5)
    finally:
        await station.stop()


async def test_driver_waits_for_the_wanted_system(
    kind: DriverKind, port: int, autopilot: FakeAutopilot
) -> None:
    second = FakeAutopilot(port, system_id=7)
    second.start()
    driver = open_driver(kind, f"udpin://127.0.0.1:{port}", system_id=7)
    try:
        await driver.connect(10.0)
        driver.send_setpoint(Setpoint.brake(time.monotonic_ns()))
        (message,) = await second.wait_for(SETPOINT)
        assert message.target_system == 7
    finally:
        await driver.close()
        await second.stop()
    with pytest.raises(LinkError, match="system 9"):
        await open_driver(kind, f"udpin://127.0.0.1:{port}", system_id=9).connect(0.5)


@pytest.mark.parametrize(
    ("kind", "autopilot_kind", "reason"),
    [
        (
            "mavsdk",
            3,
            'ArduPilot; set vehicle.driver = "pymavlink"',
        ),
        ("pymavlink", 0, "system 1 .*generic"),
    ],
)
async def test_unsupported_autopilot_is_refused(
    kind: DriverKind, autopilot_kind: int, reason: str, port: int
) -> None:
    other = FakeAutopilot(port, autopilot=autopilot_kind)
    other.start()
    try:
        with pytest.raises(LinkError, match=reason):
            await open_driver(kind, f"udpin://127.0.0.1:{port}").connect(5.0)
    finally:
        await other.stop()


@pytest.mark.parametrize(
    ("autopilot_kind", "name"),
    [(mavlink.MAV_AUTOPILOT_PX4, "PX4"), (mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, "ArduPilot")],
)
async def test_auto_supports_either_autopilot(autopilot_kind: int, name: str, port: int) -> None:
    answering = FakeAutopilot(port, autopilot=autopilot_kind)
    answering.start()
    chosen = {"vehicle.driver": "auto", "vehicle.url": f"udpin://127.0.0.1:{port}"}
    driver = driver_of(load_settings(os.devnull, chosen, {}))
    try:
        await driver.connect(5.0)
        assert (driver.library, driver.state.autopilot) == ("pymavlink", name)
    finally:
        await driver.close()
        await answering.stop()


async def test_one_heartbeat_suffices_to_connect(
    kind: DriverKind, port: int, autopilot: FakeAutopilot
) -> None:
    autopilot.sends_heartbeats = False
    driver = open_driver(kind, f"udpin://127.0.0.1:{port}")
    assert isinstance(driver, AutopilotDriver)
    connecting = asyncio.create_task(driver.connect(10.0))
    try:
        await wait_until(lambda: driver._link is not None, 5.0)
        autopilot.heartbeat()
        await connecting
        assert driver.state.autopilot == "PX4"
    finally:
        await driver.close()


async def test_busy_port_is_reported(kind: DriverKind, driver: Driver, port: int) -> None:
    with pytest.raises(LinkError, match=rf"{port} is .*use: .*QGroundControl"):
        await open_driver(kind, f"udpin://127.0.0.1:{port}").connect(5.0)


async def test_driver_can_reconnect_after_closing_twice(
    kind: DriverKind, port: int, autopilot: FakeAutopilot
) -> None:
    driver = open_driver(kind, f"udpin://127.0.0.1:{port}")
    await driver.close()
    for _ in range(3):
        await driver.connect(10.0)
        assert driver.state.mode is FlightMode.HOLD
        with pytest.raises(LinkError, match="already"):
            await driver.connect(1.0)
        await driver.close()
        await driver.close()
    driver.send_setpoint(Setpoint.brake(time.monotonic_ns()))
    driver.send_heartbeat(SystemStatus.ACTIVE)
    with pytest.raises(CommandRefusedError, match="not connected"):
        await driver.arm()
    with pytest.raises(CommandRefusedError, match="not connected"):
        await driver.get_parameter("COM_OF_LOSS_T")


async def test_connecting_can_be_cancelled(kind: DriverKind, port: int) -> None:
    driver = open_driver(kind, f"udpin://127.0.0.1:{port}")
    connecting = asyncio.create_task(driver.connect(60.0))
    await asyncio.sleep(0)
    connecting.cancel()
    with pytest.raises(asyncio.CancelledError):
        await connecting
    await driver.close()


async def test_streams_are_requested_again_after_a_restart(driver: Driver, autopilot: FakeAutopilot) -> None:
    def asked() -> int:
        return sum(
            m.command == 511 and m.param1 == CURRENT_MODE_ID for m in autopilot.received_named("COMMAND_LONG")
        )

    autopilot.send(mavlink.MAVLink_local_position_ned_message(60_000, 0, 0, 0, 0, 0, 0))
    await wait_until(lambda: asked() == 1, 10.0)
    autopilot.send(mavlink.MAVLink_local_position_ned_message(500, 0, 0, 0, 0, 0, 0))
    began_s, before = time.monotonic(), asked()
    await wait_until(lambda: asked() > before, 10.0)
    assert time.monotonic() - began_s < 1.9  # the pause after the first request is 2 s


@pytest.mark.parametrize("message_id", [2, 33])  # SYSTEM_TIME, GLOBAL_POSITION_INT
async def test_restart_is_detected_by_any_clocked_message(
    driver: Driver, autopilot: FakeAutopilot, message_id: int, caplog: pytest.LogCaptureFixture
) -> None:
    for boot_ms in (60_000, 500):
        if message_id == 2:
            autopilot.send(mavlink.MAVLink_system_time_message(0, boot_ms))
        else:
            autopilot.send(mavlink.MAVLink_global_position_int_message(boot_ms, 0, 0, 0, 0, 0, 0, 0, 0))
    await wait_until(lambda: "has restarted" in caplog.text, 5.0)


async def test_booting_heartbeat_is_a_restart(
    driver: Driver, autopilot: FakeAutopilot, caplog: pytest.LogCaptureFixture
) -> None:
    autopilot.system_status = mavlink.MAV_STATE_BOOT
    await wait_until(lambda: "has restarted" in caplog.text, 5.0)
    seen_ns = driver.state.heartbeat_ns
    await wait_until(lambda: driver.state.heartbeat_ns > seen_ns, 5.0)
    assert caplog.text.count("has restarted") == 1
    assert driver.link_count == 2


async def test_absent_streams_are_missing(driver: Driver, autopilot: FakeAutopilot) -> None:
    await wait_until(lambda: "LOCAL_POSITION_NED" in driver.state.missing_streams, 5.0)
    assert "CURRENT_MODE" in driver.state.missing_streams


async def test_two_drivers_control_two_vehicles(
    kind: DriverKind, driver: Driver, autopilot: FakeAutopilot
) -> None:
    port = free_port()
    other = FakeAutopilot(port, system_id=2)
    other.start()
    second = open_driver(kind, f"udpin://127.0.0.1:{port}", own_component_id=192)
    try:
        await second.connect(10.0)
        driver.send_setpoint(Setpoint.velocity((1.0, 0.0, 0.0), time.monotonic_ns()))
        second.send_setpoint(Setpoint.velocity((2.0, 0.0, 0.0), time.monotonic_ns()))
        (first_message,) = await autopilot.wait_for(SETPOINT)
        (second_message,) = await other.wait_for(SETPOINT)
        assert (first_message.vx, first_message.get_srcComponent()) == (1.0, 191)
        assert (second_message.vx, second_message.get_srcComponent()) == (2.0, 192)
    finally:
        await second.close()
        await other.stop()


async def test_udp_out_sends_the_first_heartbeat(kind: DriverKind, port: int) -> None:
    """udpout: the vehicle listens, and replies to the sender."""
    vehicle = FakeAutopilot(port)
    vehicle.sends_heartbeats = False
    vehicle.answers["HEARTBEAT"] = lambda _: setattr(vehicle, "sends_heartbeats", True)
    vehicle.start()
    driver = open_driver(kind, f"udpout://127.0.0.1:{vehicle.socket.getsockname()[1]}")
    try:
        await driver.connect(10.0)
        driver.send_setpoint(Setpoint.brake(time.monotonic_ns()))
        await vehicle.wait_for(SETPOINT)
    finally:
        await driver.close()
        await vehicle.stop()


async def test_no_answer_with_heartbeats_only_names_the_link(
    kind: DriverKind, port: int, autopilot: FakeAutopilot
) -> None:
    autopilot.answers.clear()
    driver = open_driver(kind, f"udpin://127.0.0.1:{port}")
    try:
        await driver.connect(10.0)
        with pytest.raises(NoAnswerError, match=r"heartbeats .*on this link$"):
            await driver.arm()
        autopilot.send(mavlink.MAVLink_local_position_ned_message(60_000, 0, 0, 0, 0, 0, 0))
        await wait_until(lambda: driver.state.position_ned_m is not None, 5.0)
        with pytest.raises(NoAnswerError, match=r"command 400 .*router"):
            await driver.arm()
    finally:
        await driver.close()
