"""The link: who is answered, ids that are taken, signing, floods."""

from __future__ import annotations

import asyncio
import socket
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from companion.ground_station import link as link_module
from companion.ground_station.camera import Camera
from companion.ground_station.component import Message
from companion.ground_station.link import StationLink
from companion.host import clock
from companion.host.passing import PassingError
from companion.vehicle.framing import frames_of
from companion.vehicle.link_url import parse_link_url
from companion.vehicle.signing import FrameSigner
from mavlink_sim.testing import free_port
from tests.companion.ground_station.station_harness import CAMERA_ID, STATION, SYSTEM, CameraHarness

KEY = bytes(range(32))
HEARTBEAT = mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_CAMERA, 8, 0, 0, 4, 3)


class Peer:
    """Another program on the link, with a socket of its own. `received`: messages so far."""

    def __init__(self, port: int) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", port))
        self.socket.setblocking(False)
        self.signer: FrameSigner | None = None
        self.received: list[Message] = []
        self.frames: list[bytes] = []
        self.address: Any = None
        self._codec = mavlink.MAVLink(None, *STATION)

    def poll(self) -> None:
        with suppress(BlockingIOError):
            while True:
                data, self.address = self.socket.recvfrom(65535)
                for frame in frames_of(data):
                    self.frames.append(frame.raw)
                    self.received.append(mavlink.MAVLink(None).decode(bytearray(frame.raw)))

    def send(self, message: Message, sender: tuple[int, int] = STATION) -> None:
        self._codec.srcSystem, self._codec.srcComponent = sender
        frame = bytes(message.pack(self._codec))
        self._codec.seq = (self._codec.seq + 1) % 256
        self.socket.sendto(frame if self.signer is None else self.signer.signed(frame), self.address)

    def ask(self, number: int, *parameters: float, target: tuple[int, int] = (SYSTEM, CAMERA_ID)) -> None:
        values = [*parameters, *[0.0] * (7 - len(parameters))]
        self.send(mavlink.MAVLink_command_long_message(*target, number, 0, *values))

    async def until(self, condition: Callable[[], object], timeout_s: float = 10.0) -> None:
        async with asyncio.timeout(timeout_s):
            while not condition():
                self.poll()
                await asyncio.sleep(0.01)

    async def next(self, kind: str) -> Message:
        start = len(self.received)

        def found() -> list[Message]:
            return [each for each in self.received[start:] if each.get_type() == kind]

        await self.until(found)
        return found()[0]

    def heartbeats_of(self, component: int) -> list[Message]:
        return [
            each
            for each in self.received
            if each.get_type() == "HEARTBEAT" and each.get_srcComponent() == component
        ]


@pytest.fixture(autouse=True)
def short_listening(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(link_module, "LISTEN_S", 0.3)
    monkeypatch.setattr(link_module, "LISTEN_JITTER_S", 0.0)


def cameras_of(directory: Path, count: int = 1) -> list[Camera]:
    cameras = [CameraHarness(directory).camera for _ in range(count)]
    for number, camera in enumerate(cameras):
        camera.component_id += number
    return cameras


@asynccontextmanager
async def running(
    cameras: list[Camera], *, signer: FrameSigner | None = None
) -> AsyncIterator[tuple[StationLink, Peer, list[str]]]:
    """A link with its peer, which it has introduced itself to."""
    port = free_port()
    peer, lines = Peer(port), list[str]()
    url = parse_link_url(f"udpout://127.0.0.1:{port}")
    link = StationLink(url, SYSTEM, cameras, signer=signer, say=lines.append)
    task = asyncio.create_task(link.run(lambda: None))
    try:
        await peer.until(lambda: peer.address)
        yield link, peer, lines
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        peer.socket.close()


async def test_request_is_answered_in_order(tmp_path: Path) -> None:
    async with running(cameras_of(tmp_path)) as (_, peer, _):
        await peer.next("HEARTBEAT")
        peer.ask(512, mavlink.MAVLINK_MSG_ID_CAMERA_INFORMATION)
        await peer.next("CAMERA_INFORMATION")
        assert "COMMAND_ACK" in [each.get_type() for each in peer.received[:-1]]


async def test_each_camera_has_its_own_heartbeats_and_sequence(tmp_path: Path) -> None:
    async with running(cameras_of(tmp_path, 3)) as (_, peer, _):
        await peer.until(lambda: all(len(peer.heartbeats_of(100 + number)) > 1 for number in range(3)))
        for number in range(3):
            sequences = [
                message.get_seq() for message in peer.received if message.get_srcComponent() == 100 + number
            ]
            assert sequences == list(range(len(sequences)))
        peer.received.clear()
        peer.ask(512, mavlink.MAVLINK_MSG_ID_CAMERA_SETTINGS, target=(SYSTEM, 0))
        await peer.until(lambda: [each.get_type() for each in peer.received].count("CAMERA_SETTINGS") == 3)


async def test_request_for_another_system_has_no_answer(tmp_path: Path) -> None:
    async with running(cameras_of(tmp_path)) as (_, peer, _):
        await peer.next("HEARTBEAT")
        peer.ask(521, 1, target=(2, CAMERA_ID))
        peer.ask(522, 1)
        await peer.next("CAMERA_SETTINGS")
        assert "CAMERA_INFORMATION" not in [each.get_type() for each in peer.received]


async def test_id_of_another_camera_is_not_used(tmp_path: Path) -> None:
    async with running(cameras_of(tmp_path)) as (_, peer, lines):
        peer.send(HEARTBEAT, (SYSTEM, CAMERA_ID))
        peer.send(HEARTBEAT, (2, CAMERA_ID + 1))  # of another vehicle
        assert (await peer.next("HEARTBEAT")).get_srcComponent() == CAMERA_ID + 1
        assert not peer.heartbeats_of(CAMERA_ID)
        assert any("1/100" in line and "1/101" in line for line in lines)


async def test_id_is_changed_when_another_camera_comes_later(tmp_path: Path) -> None:
    async with running(cameras_of(tmp_path, 2)) as (_, peer, _):
        await peer.until(lambda: peer.heartbeats_of(CAMERA_ID + 1))
        peer.send(HEARTBEAT, (SYSTEM, CAMERA_ID))
        await peer.until(lambda: any(peer.heartbeats_of(number) for number in range(102, 106)))


async def test_own_heartbeat_that_comes_back_changes_nothing(tmp_path: Path) -> None:
    async with running(cameras_of(tmp_path)) as (_, peer, lines):
        await peer.next("HEARTBEAT")
        for frame in tuple(peer.frames):
            peer.socket.sendto(frame, peer.address)
        await peer.until(lambda: len(peer.heartbeats_of(CAMERA_ID)) > 2)
        assert lines == []


async def test_camera_without_a_free_id_is_not_announced(tmp_path: Path) -> None:
    async with running(cameras_of(tmp_path)) as (link, peer, lines):
        for number in range(100, 106):
            peer.send(HEARTBEAT, (SYSTEM, number))
        await peer.until(lambda: lines)
        assert "not announced" in lines[0]
        assert link.components == []


async def test_autopilot_of_another_system_is_named_once(tmp_path: Path) -> None:
    autopilot = mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_PX4, 0, 0, 4, 3)
    async with running(cameras_of(tmp_path)) as (_, peer, lines):
        for _ in range(3):
            peer.send(autopilot, (7, 1))
        await peer.next("HEARTBEAT")
        assert len(lines) == 1
        assert "system 7" in lines[0]


async def test_signed_link_answers_signed_requests_alone(
    tmp_path: Path,
) -> None:
    async with running(cameras_of(tmp_path), signer=FrameSigner(KEY)) as (link, peer, _):
        await peer.next("HEARTBEAT")
        assert all(frame[2] & 1 for frame in peer.frames)
        peer.ask(521, 1)
        peer.signer = FrameSigner(bytes(32))
        peer.ask(521, 1)
        peer.signer = FrameSigner(KEY)
        peer.ask(522, 1)
        await peer.next("CAMERA_SETTINGS")
        assert "CAMERA_INFORMATION" not in [each.get_type() for each in peer.received]
        assert link.refused == 2


async def test_flood_is_bounded_and_counted(tmp_path: Path) -> None:
    async with running(cameras_of(tmp_path)) as (link, peer, _):
        await peer.next("HEARTBEAT")
        peer.received.clear()
        for _ in range(1500):
            peer.ask(521, 1)
            if _ % 50 == 0:
                await asyncio.sleep(0)
        await peer.until(lambda: link.dropped > 500)
        await peer.until(lambda: len(peer.heartbeats_of(CAMERA_ID)) > 2)
        peer.ask(522, 1)
        await peer.next("CAMERA_SETTINGS")


async def test_noise_and_unknown_messages_are_ignored(tmp_path: Path) -> None:
    async with running(cameras_of(tmp_path)) as (_, peer, _):
        await peer.next("HEARTBEAT")
        for data in (b"", b"\xfd", bytes(range(256)) * 5, b"\xfd\xff\x00\x00\x00\x01\x64\x4c\x00\x00" * 30):
            peer.socket.sendto(data, peer.address)
        peer.ask(522, 1)
        await peer.next("CAMERA_SETTINGS")


async def test_requests_of_before_a_standstill_are_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(clock, "PAUSED_S", 0.3)
    async with running(cameras_of(tmp_path)) as (_, peer, lines):
        await peer.next("HEARTBEAT")
        for _ in range(100):
            peer.ask(521, 1)
        time.sleep(0.5)  # noqa: ASYNC251 - the process stands still
        await peer.until(lambda: lines)
        peer.ask(522, 1)
        await peer.next("CAMERA_SETTINGS")
        assert "CAMERA_INFORMATION" not in [each.get_type() for each in peer.received]
        assert len(lines) == 1


async def test_fault_in_one_answer_leaves_the_others(tmp_path: Path) -> None:
    (camera,) = cameras_of(tmp_path)
    camera.requests.replies[260] = lambda _: [mavlink.MAVLink_camera_settings_message(-1, 0)]
    async with running([camera]) as (_, peer, lines):
        await peer.next("HEARTBEAT")
        peer.ask(522, 1)
        peer.ask(521, 1)
        await peer.next("CAMERA_INFORMATION")
        assert len(lines) == 1


async def test_port_in_use_is_a_passing_error_that_names_it(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        url = f"udpin://127.0.0.1:{taken.getsockname()[1]}"
        link = StationLink(parse_link_url(url), SYSTEM, [], signer=None, say=print)
        with pytest.raises(PassingError, match=url):
            await link.run(lambda: None)


async def test_listening_link_answers_who_speaks(tmp_path: Path) -> None:
    port = free_port()
    url = parse_link_url(f"udpin://127.0.0.1:{port}")
    link = StationLink(url, SYSTEM, cameras_of(tmp_path), signer=None, say=print)
    task = asyncio.create_task(link.run(lambda: None))
    peer = Peer(0)
    peer.address = ("127.0.0.1", port)
    try:

        def ask_again() -> bool:
            peer.ask(521, 1)
            return any(each.get_type() == "CAMERA_INFORMATION" for each in peer.received)

        await peer.until(ask_again)
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        peer.socket.close()
