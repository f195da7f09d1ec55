"""A scripted autopilot on a real UDP socket, which records what it receives."""

from __future__ import annotations

import asyncio
import socket
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from companion.vehicle.driver import Driver
from companion.vehicle.framing import frames_of
from companion.vehicle.gimbal import GimbalState
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import VehicleState
from companion.vehicle.streamer import Streamer

HOLD, OFFBOARD, MISSION, TAKEOFF = 0x03040000, 0x00060000, 0x04040000, 0x02040000
SETPOINT = "SET_POSITION_TARGET_LOCAL_NED"


class FakeAutopilot:
    """Sends to `port` on loopback, as PX4's onboard link does, then to the source of received messages.

    Attributes:
        received: (decoded message, raw frame) in the order of arrival.
        answers: message name → called with every received message of that name.
        parameters: those that it has.
    """

    def __init__(self, port: int, *, system_id: int = 1, component_id: int = 1, autopilot: int = 12) -> None:
        self.received: list[tuple[Any, bytes]] = []
        self.answers: dict[str, Callable[[Any], None]] = {
            "COMMAND_LONG": lambda m: self.acknowledge(m.command, to=sender_of(m)),
            "TIMESYNC": lambda m: self.send(mavlink.MAVLink_timesync_message(time.monotonic_ns(), m.ts1)),
            "PARAM_REQUEST_READ": lambda m: self.parameter(m.param_id),
        }
        self.parameters = {"FRAME_CLASS": 1.0} if autopilot == mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA else {}
        self.custom_mode, self.base_mode, self.system_status = HOLD, 29, 3
        self.autopilot, self.mav_type, self.vtol_state = autopilot, 2, 0
        self.sends_heartbeats = True
        self._port = port
        self._codec = mavlink.MAVLink(None, system_id, component_id)
        self._task: asyncio.Task[None] | None = None
        self.open()

    def open(self) -> None:
        """Open a new socket, with a new source port."""
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.setblocking(False)

    def send(self, message: Any) -> None:
        self.socket.sendto(message.pack(self._codec), ("127.0.0.1", self._port))
        self._codec.seq = (self._codec.seq + 1) % 256

    def send_bytes(self, data: bytes) -> None:
        self.socket.sendto(data, ("127.0.0.1", self._port))

    def heartbeat(self) -> None:
        self.send(
            mavlink.MAVLink_heartbeat_message(
                self.mav_type, self.autopilot, self.base_mode, self.custom_mode, self.system_status, 3
            )
        )

    def landed(self, landed_state: int = 1) -> None:
        self.send(mavlink.MAVLink_extended_sys_state_message(self.vtol_state, landed_state))

    def acknowledge(self, command: int, result: int = 0, *, to: tuple[int, int] = (1, 191)) -> None:
        self.send(mavlink.MAVLink_command_ack_message(command, result, 0, 0, *to))

    def parameter(self, name: str) -> None:
        """Send one of `parameters`; nothing where there is none, as ArduPilot does."""
        if name in self.parameters:
            value, real32 = self.parameters[name], mavlink.MAV_PARAM_TYPE_REAL32
            self.send(mavlink.MAVLink_param_value_message(name.encode(), value, real32, 1, 0))

    def home(self, altitude_amsl_m: float = 488.0) -> None:
        altitude = round(altitude_amsl_m * 1000)
        self.send(mavlink.MAVLink_home_position_message(0, 0, altitude, 0.0, 0.0, 0.0, [1, 0, 0, 0], 0, 0, 0))

    def drain(self) -> None:
        """Process all received messages now."""
        while True:
            try:
                data, source = self.socket.recvfrom(2048)
            except BlockingIOError:
                return
            self._port = source[1]
            for frame in frames_of(data):
                message = self._codec.decode(bytearray(frame.raw))
                self.received.append((message, frame.raw))
                self.answers.get(message.get_type(), lambda _: None)(message)

    async def _live(self) -> None:
        for turn in range(10**9):
            if self.sends_heartbeats and turn % 10 == 0:
                self.heartbeat()
            self.drain()
            await asyncio.sleep(0.01)

    def start(self) -> None:
        self._task = asyncio.create_task(self._live())

    async def stop(self) -> None:
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)
        self.socket.close()

    def received_named(self, name: str) -> list[Any]:
        return [message for message, _ in self.received if message.get_type() == name]

    async def wait_for(self, name: str, count: int = 1, timeout_s: float = 10.0) -> list[Any]:
        """Wait for `count` messages of a name and return them."""
        await wait_until(
            lambda: len(self.received_named(name)) >= count, timeout_s, lambda: f"{count} {name}"
        )
        return self.received_named(name)

    async def wait_for_command(self, command: int, timeout_s: float = 10.0) -> None:
        """Wait for a COMMAND_LONG of that number."""

        def commands() -> list[int]:
            return [message.command for message in self.received_named("COMMAND_LONG")]

        await wait_until(
            lambda: command in commands(), timeout_s, lambda: f"command {command}, not {commands()}"
        )


def sender_of(message: Any) -> tuple[int, int]:
    """System and component id of a received message."""
    return (message.get_srcSystem(), message.get_srcComponent())


async def wait_until(
    met: Callable[[], bool], timeout_s: float, wanted: Callable[[], object] = lambda: "it"
) -> None:
    deadline = time.monotonic() + timeout_s
    while not met():
        if time.monotonic() > deadline:
            raise TimeoutError(f"waited {timeout_s} s for {wanted()}")
        await asyncio.sleep(0.01)


def gimbal_of(state: VehicleState) -> GimbalState:
    assert state.gimbal is not None
    return state.gimbal


async def wait_for_state(
    driver: Driver, met: Callable[[VehicleState], bool], timeout_s: float = 20.0
) -> VehicleState:
    await wait_until(lambda: met(driver.state), timeout_s, lambda: f"another state than {driver.state}")
    return driver.state


@asynccontextmanager
async def streaming(driver: Driver, velocity_ned_mps: tuple[float, float, float]) -> AsyncIterator[Streamer]:
    """Stream a velocity setpoint, kept fresh until the block ends."""
    streamer = Streamer(driver.send_setpoint, brake_s=0.1)

    async def want() -> None:
        while True:
            streamer.submit(Setpoint.velocity(velocity_ned_mps, time.monotonic_ns(), yaw_rate_radps=0.0))
            await asyncio.sleep(0.05)

    tasks = [asyncio.create_task(want()), asyncio.create_task(streamer.run())]
    try:
        yield streamer
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
