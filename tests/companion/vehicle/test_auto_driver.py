"""driver = "auto": the driver is chosen by the autopilot, on the one link that was opened."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest
from pymavlink.dialects.v20 import common as mavlink

from companion.vehicle import autopilot_driver
from companion.vehicle.auto_driver import AutoDriver
from companion.vehicle.autopilot_driver import AutopilotDriver
from companion.vehicle.autopilot_profile import ARDUPILOT, PX4
from companion.vehicle.byte_link import ByteLink, Received, open_link
from companion.vehicle.driver import Driver, LinkError
from companion.vehicle.drivers import open_driver
from companion.vehicle.link_url import LinkUrl
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import VehicleState
from mavlink_sim.testing import running_simulator
from tests.companion.vehicle.fake_autopilot import SETPOINT, FakeAutopilot, wait_for_state, wait_until

pytestmark = pytest.mark.realtime

AUTOPILOTS = [(PX4, "mavsdk", "PX4"), (ARDUPILOT, "pymavlink", "ArduPilot")]


@asynccontextmanager
async def answering(port: int, autopilot: int) -> AsyncIterator[FakeAutopilot]:
    fake = FakeAutopilot(port, autopilot=autopilot)
    fake.start()
    try:
        yield fake
    finally:
        await fake.stop()


def auto(port: int) -> Driver:
    return open_driver("auto", f"udpin://127.0.0.1:{port}")


@pytest.mark.parametrize(("autopilot", "library", "name"), AUTOPILOTS)
async def test_driver_is_chosen_by_the_autopilot(
    port: int, autopilot: int, library: str, name: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    driver = auto(port)
    assert driver.library == "auto"
    async with answering(port, autopilot) as fake:
        try:
            await driver.connect(10.0)
            assert (driver.library, driver.state.autopilot) == (library, name)
            assert f"{name}, system 1: {library} driver" in caplog.text
            driver.send_setpoint(Setpoint.velocity((1.0, 0.0, 0.0), time.monotonic_ns()))
            (message,) = await fake.wait_for(SETPOINT)
            assert message.vx == 1.0
        finally:
            await driver.close()


@pytest.mark.parametrize(("autopilot", "library", "name"), AUTOPILOTS)
async def test_one_heartbeat_and_one_socket_suffice(
    port: int, autopilot: int, library: str, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The socket stays open: a new one would wait for the next heartbeat to learn the peer address."""
    opened: list[LinkUrl] = []

    async def counted(url: LinkUrl, received: Received) -> ByteLink:
        link = await open_link(url, received)
        opened.append(url)
        return link

    monkeypatch.setattr(autopilot_driver, "open_link", counted)
    driver = auto(port)
    async with answering(port, autopilot) as fake:
        fake.sends_heartbeats = False
        connecting = asyncio.create_task(driver.connect(10.0))
        await wait_until(lambda: bool(opened), 5.0)
        fake.heartbeat()
        await connecting
        try:
            driver.send_setpoint(Setpoint.brake(time.monotonic_ns()))
            await fake.wait_for(SETPOINT)
            assert (len(opened), driver.library) == (1, library)
        finally:
            await driver.close()


async def test_tcp_peer_is_connected_once() -> None:
    peers: list[asyncio.StreamWriter] = []
    closed = asyncio.Event()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        peers.append(writer)
        heartbeat = mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_QUADROTOR, PX4, 29, 0x03040000, 3, 3)
        writer.write(heartbeat.pack(mavlink.MAVLink(None, 1, 1)))
        await reader.read()  # until the driver closes it
        writer.close()
        closed.set()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    driver = open_driver("auto", f"tcp://127.0.0.1:{server.sockets[0].getsockname()[1]}")
    try:
        await driver.connect(10.0)
        assert (len(peers), driver.library) == (1, "mavsdk")
    finally:
        await driver.close()
        await asyncio.wait_for(closed.wait(), 5.0)
        server.close()


async def test_subscription_made_before_connect_works_until_ended(port: int) -> None:
    driver, seen = auto(port), list[VehicleState]()
    end = driver.subscribe(seen.append)
    async with answering(port, PX4):
        try:
            await driver.connect(10.0)
            await wait_until(lambda: len(seen) > 3, 5.0)
            end()
            count = len(seen)
            before_ns = driver.state.heartbeat_ns
            await wait_for_state(driver, lambda s: s.heartbeat_ns > before_ns)
            assert len(seen) == count
        finally:
            await driver.close()


async def test_reconnects_to_another_autopilot(port: int) -> None:
    driver = auto(port)
    for autopilot, library, _ in (*AUTOPILOTS, AUTOPILOTS[0]):
        async with answering(port, autopilot):
            await driver.connect(10.0)
            assert driver.library == library
            with pytest.raises(LinkError, match="already"):
                await driver.connect(1.0)
            assert driver.library == library
            await driver.close()
            await driver.close()


async def test_pymavlink_is_used_when_mavsdk_cannot_be_loaded(
    port: int, caplog: pytest.LogCaptureFixture
) -> None:
    def broken() -> AutopilotDriver:
        raise OSError("libmavsdk.so: cannot open shared object file")

    listener = open_driver("pymavlink", f"udpin://127.0.0.1:{port}")
    assert isinstance(listener, AutopilotDriver)
    driver = AutoDriver(listener, broken)
    async with answering(port, PX4):
        await driver.connect(10.0)
        await driver.close()
    assert "libmavsdk.so" in caplog.text
    assert "pymavlink driver" in caplog.text


async def test_failed_connect_frees_the_port(port: int) -> None:
    driver = auto(port)
    with pytest.raises(LinkError, match=r"no autopilot .*0\.2 s"):
        await driver.connect(0.2)
    async with answering(port, 0):
        with pytest.raises(LinkError, match="only PX4 and ArduPilot"):
            await driver.connect(5.0)
    async with answering(port, PX4):
        await driver.connect(10.0)
        await driver.close()


@pytest.mark.parametrize("firmware", ["px4", "ardupilot"])
async def test_both_built_in_vehicles_arm(firmware: str) -> None:
    with running_simulator(autopilot=firmware, ready_after=0.0, speed=2.0) as simulator:
        driver = auto(simulator.onboard_port)
        await driver.connect(20.0)
        try:
            await wait_for_state(driver, lambda s: s.ready_to_arm and s.position_ned_m is not None)
            await driver.arm()
            await driver.disarm()
        finally:
            await driver.close()
