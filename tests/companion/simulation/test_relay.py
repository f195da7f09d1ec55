"""The relay between an autopilot and the programs that share its UDP link, on loopback."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import ExitStack, asynccontextmanager, contextmanager

import pytest
from pymavlink.dialects.v20 import common as mavlink

from companion.simulation import relay as relay_module
from companion.simulation.relay import Relay
from companion.vehicle.driver import LinkError, LinkUnavailableError
from mavlink_sim.testing import free_udp_ports

pytestmark = pytest.mark.realtime


@pytest.fixture(autouse=True)
def short_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(relay_module, "_FIRST_HEARTBEAT_S", 0.5)
    monkeypatch.setattr(relay_module, "_LISTEN_S", 0.05)


def heartbeat(
    *,
    vehicle_type: int = mavlink.MAV_TYPE_QUADROTOR,
    autopilot: int = mavlink.MAV_AUTOPILOT_PX4,
    armed: bool = False,
    system: int = 1,
) -> bytes:
    sender = mavlink.MAVLink(None, srcSystem=system, srcComponent=mavlink.MAV_COMP_ID_AUTOPILOT1)
    mode = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
    mode |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0
    message = mavlink.MAVLink_heartbeat_message(
        vehicle_type, autopilot, mode, 0, mavlink.MAV_STATE_STANDBY, 3
    )
    packed: bytes = message.pack(sender)
    return packed


class Ends:
    """The sockets around a relay: two programs, and autopilots by number."""

    def __init__(self, relay: Relay, programs: list[socket.socket], autopilots: list[socket.socket]) -> None:
        self.relay, self.programs, self.autopilots = relay, programs, autopilots

    def send(self, data: bytes, number: int = 0) -> None:
        self.autopilots[number].sendto(data, self.relay.url.address)


@contextmanager
def loopback_sockets(count: int) -> Iterator[list[socket.socket]]:
    with ExitStack() as stack:
        sockets = [
            stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(count)
        ]
        for one in sockets:
            one.bind(("127.0.0.1", 0))
            one.setblocking(False)
        yield sockets


@asynccontextmanager
async def opened() -> AsyncIterator[Ends]:
    (port,) = free_udp_ports(1)
    with loopback_sockets(2) as programs, loopback_sockets(2) as autopilots:
        relay = await Relay.open(f"udpin://127.0.0.1:{port}", [one.getsockname()[1] for one in programs])
        try:
            yield Ends(relay, programs, autopilots)
        finally:
            await relay.close()


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(10.0):
        while not condition():
            await asyncio.sleep(0.002)


def received(end: socket.socket) -> Callable[[], bool]:
    """Whether a datagram waits at a socket."""

    def waits() -> bool:
        try:
            return bool(end.recv(2048, socket.MSG_PEEK))
        except BlockingIOError:
            return False

    return waits


async def test_messages_reach_both_programs_and_come_back() -> None:
    async with opened() as ends:
        ends.send(heartbeat())
        for program in ends.programs:
            await until(received(program))
            data, source = program.recvfrom(2048)
            assert data == heartbeat()
            program.sendto(b"from a program", source)
            await until(received(ends.autopilots[0]))
            assert ends.autopilots[0].recvfrom(2048) == (b"from a program", ends.relay.url.address)


async def test_an_autopilot_that_splits_its_frames_is_found() -> None:
    async with opened() as ends:
        for start in range(0, len(heartbeat()), 12):
            ends.send(heartbeat()[start : start + 12])
        assert (await ends.relay.check_autopilot()).system_id == 1


async def test_nothing_is_sent_before_an_autopilot_heartbeat() -> None:
    async with opened() as ends:
        ends.send(b"no heartbeat")
        ends.send(heartbeat())
        await until(received(ends.programs[0]))
        assert ends.programs[0].recv(2048) == heartbeat()


async def test_disarmed_multirotor_is_accepted() -> None:
    async with opened() as ends:
        ends.send(heartbeat(system=7))
        found = await ends.relay.check_autopilot()
        assert (found.system_id, found.vehicle_type) == (7, mavlink.MAV_TYPE_QUADROTOR)


async def test_second_autopilot_on_the_port_is_refused() -> None:
    async with opened() as ends:
        ends.send(heartbeat())
        ends.send(heartbeat(), number=1)
        with pytest.raises(ValueError, match="two autopilots") as refused:
            await ends.relay.check_autopilot()
        for autopilot in ends.autopilots:
            assert str(autopilot.getsockname()[1]) in str(refused.value)


async def test_messages_of_a_second_autopilot_are_dropped() -> None:
    async with opened() as ends:
        ends.send(heartbeat())
        ends.send(heartbeat(armed=True), number=1)
        ends.send(b"last")
        program = ends.programs[0]
        got: list[bytes] = []
        while got[-1:] != [b"last"]:
            await until(received(program))
            got.append(program.recv(2048))
        assert got == [heartbeat(), b"last"]


async def test_autopilot_back_on_another_port_is_answered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(relay_module, "HEARTBEAT_MAX_AGE_S", 0.0)
    async with opened() as ends:
        ends.send(heartbeat())
        await until(received(ends.programs[0]))
        _, source = ends.programs[0].recvfrom(2048)
        ends.send(heartbeat(), number=1)
        await until(received(ends.programs[0]))
        ends.programs[0].sendto(b"to the new port", source)
        await until(received(ends.autopilots[1]))
        assert ends.autopilots[1].recv(2048) == b"to the new port"


@pytest.mark.parametrize(
    ("sent", "named"),
    [
        (heartbeat(vehicle_type=mavlink.MAV_TYPE_FIXED_WING), r"a fixed wing \(MAV_TYPE 1\)"),
        (heartbeat(vehicle_type=mavlink.MAV_TYPE_GROUND_ROVER), r"a rover \(MAV_TYPE 10\)"),
        (heartbeat(autopilot=mavlink.MAV_AUTOPILOT_GENERIC), "MAV_AUTOPILOT 0"),
        (heartbeat(armed=True), "armed"),
    ],
)
async def test_unfit_vehicle_is_refused_with_the_reason(sent: bytes, named: str) -> None:
    async with opened() as ends:
        ends.send(sent)
        with pytest.raises(ValueError, match=named):
            await ends.relay.check_autopilot()


async def test_missing_autopilot_may_come_later() -> None:
    async with opened() as ends:
        ends.send(b"")
        with pytest.raises(LinkUnavailableError, match="no autopilot heartbeat"):
            await ends.relay.check_autopilot()


@pytest.mark.parametrize("url", ["tcp://127.0.0.1:5760", "serial:///dev/ttyACM0:57600"])
async def test_only_a_udp_port_to_listen_on_is_accepted(url: str) -> None:
    with pytest.raises(LinkError, match="udpin"):
        await Relay.open(url, ())
