"""The lines of docs/boards.md in a real mavlink-router: service and ground station share a serial line."""

from __future__ import annotations

import asyncio
import contextlib
import os
import pty
import re
import shutil
import socket
import subprocess
import tty
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from companion.vehicle.state import FlightMode
from mavlink_sim.testing import QUICK_FLIGHT, free_udp_ports, running_simulator
from tests.companion.guidance.guidance_harness import assert_succeeded
from tests.companion.live_flight import LiveFlight, ground_station

PAGE = Path(__file__).parents[2] / "docs" / "boards.md"
AUTOPILOT, SERVICE = (1, mavlink.MAV_COMP_ID_AUTOPILOT1), (1, mavlink.MAV_COMP_ID_ONBOARD_COMPUTER)


def lines_of_page(**replaced: str) -> str:
    """The page's configuration of the router, with other values of keys that it has: `endpoint_Key=value`."""
    (text,) = re.findall(r"^```ini\n(.*?)^```", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    for name, value in replaced.items():
        endpoint, key = name.split("_")
        text, count = re.subn(
            rf"(\[\w+ {endpoint}\]\n(?:\w+ = .*\n)*?{key} = ).*", rf"\g<1>{value}", text, flags=re.IGNORECASE
        )
        assert count == 1, name
    return str(text)


@contextlib.asynccontextmanager
async def serial_line(vehicle_port: int) -> AsyncIterator[str]:
    """A serial device with what a vehicle sends to a UDP port. The name is that of the device."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    os.set_blocking(master, False)
    loop = asyncio.get_running_loop()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        udp.bind(("127.0.0.1", vehicle_port))
        udp.setblocking(False)
        vehicle: list[Any] = []

        def to_line() -> None:
            data, source = udp.recvfrom(65535)
            vehicle[:] = [source]
            with contextlib.suppress(BlockingIOError):  # nobody reads the line yet
                os.write(master, data)

        def to_vehicle() -> None:
            data = os.read(master, 4096)
            if vehicle:
                udp.sendto(data, vehicle[0])

        loop.add_reader(udp.fileno(), to_line)
        loop.add_reader(master, to_vehicle)
        try:
            yield os.ttyname(slave)
        finally:
            loop.remove_reader(udp.fileno())
            loop.remove_reader(master)
            os.close(master)
            os.close(slave)


@contextlib.contextmanager
def router(configuration: Path) -> Iterator[None]:
    program = shutil.which("mavlink-routerd")
    assert program is not None
    # It also reads a folder of the system, for which there is no other value than a folder.
    process = subprocess.Popen([program, "-c", str(configuration), "-d", str(configuration.parent / "none")])
    try:
        yield
        assert process.poll() is None
    finally:
        process.kill()
        process.wait()


class Station:
    """A ground station. `senders`: whose heartbeats it received. `answers`: (command, result)."""

    def __init__(self, link: Any) -> None:
        self.link = link
        self.senders: set[tuple[int, int]] = set()
        self.answers: list[tuple[int, int]] = []

    async def until(self, condition: Callable[[], object], timeout_s: float = 30.0) -> None:
        async with asyncio.timeout(timeout_s):
            while not condition():
                while (message := self.link.recv_match()) is not None:
                    if message.get_type() == "HEARTBEAT":
                        self.senders.add((message.get_srcSystem(), message.get_srcComponent()))
                    elif message.get_type() == "COMMAND_ACK":
                        self.answers.append((message.command, message.result))
                await asyncio.sleep(0.01)

    def command(self, number: int, *parameters: float) -> None:
        values = (*parameters, *[0.0] * (7 - len(parameters)))
        self.link.mav.command_long_send(*AUTOPILOT, number, 0, *values)


@pytest.mark.needs("mavlink-router")
@pytest.mark.realtime
async def test_service_and_station_fly_over_the_lines_of_the_page(tmp_path: Path) -> None:
    ours, theirs = free_udp_ports(2)
    with running_simulator(speed=2.0, parameters=QUICK_FLIGHT) as simulator:
        async with serial_line(simulator.onboard_port) as device:
            configuration = tmp_path / "main.conf"
            configuration.write_text(
                lines_of_page(
                    autopilot_Device=device,
                    companion_Port=str(ours),
                    station_Address="127.0.0.1",
                    station_Port=str(theirs),
                )
            )
            service = LiveFlight("pymavlink", ours)
            with router(configuration), ground_station(theirs) as link:
                station = Station(link)
                async with service.running():
                    state = service.driver
                    await service.until(lambda: state.state.ready_to_arm and state.state.position_ned_m)
                    await station.until(lambda: {AUTOPILOT, SERVICE} <= station.senders)
                    assert_succeeded(await service.fly("takeoff 3"))

                    station.command(mavlink.MAV_CMD_DO_SET_MODE, 1, 4, 6)  # AUTO.LAND of PX4
                    answer = (mavlink.MAV_CMD_DO_SET_MODE, mavlink.MAV_RESULT_ACCEPTED)
                    await station.until(lambda: answer in station.answers)
                    await service.until(lambda: state.state.mode is FlightMode.LAND)
                    await service.until(lambda: not state.state.armed)


def test_page_uses_the_defaults_of_service_and_station() -> None:
    lines = lines_of_page()
    assert "Port = 14540" in lines.partition("companion]")[2]
    assert "Port = 14550" in lines.partition("station]")[2]
    assert "#" not in lines  # a comment at the end of a line is part of the value
