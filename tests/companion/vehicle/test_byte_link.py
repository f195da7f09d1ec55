"""Links on real endpoints: UDP and TCP sockets, a pseudo-terminal for the serial line."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
import os
import pty
import socket
from typing import Any

import pytest

from companion.vehicle.byte_link import Source, _StreamLink, open_link
from companion.vehicle.driver import LinkError
from companion.vehicle.link_url import parse_link_url
from mavlink_sim.testing import free_port
from tests.companion.vehicle.fake_autopilot import wait_until

pytestmark = pytest.mark.realtime


class Receiver:
    """Records the received data and its source."""

    def __init__(self) -> None:
        self.data = b""
        self.source = None

    def __call__(self, data: bytes, source: Source) -> None:
        self.data += data
        self.source = source


def udp_peer() -> socket.socket:
    peer = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    peer.bind(("127.0.0.1", 0))
    peer.setblocking(False)
    return peer


async def test_udp_listener_sends_to_the_set_peer(port: int) -> None:
    receiver = Receiver()
    link = await open_link(parse_link_url(f"udpin://127.0.0.1:{port}"), receiver)
    with udp_peer() as first, udp_peer() as second:
        link.send(b"to nobody")
        assert link.dropped_count == 1
        for peer, text in ((first, b"one"), (second, b"two")):
            peer.sendto(text, ("127.0.0.1", port))
            await wait_until(lambda text=text: receiver.data.endswith(text), 5.0)  # type: ignore[misc]  # a lambda with a default
            link.answer_to(receiver.source)
            link.send(b"answer to " + text)
            assert await asyncio.get_running_loop().sock_recv(peer, 100) == b"answer to " + text
    await link.close()
    await link.close()
    link.send(b"after the end")
    assert link.dropped_count == 2


async def test_udp_out_link_keeps_its_peer_without_a_listener(port: int) -> None:
    receiver = Receiver()
    link = await open_link(parse_link_url(f"udpout://localhost:{port}"), receiver)
    for _ in range(3):
        link.send(b"anybody?")
        await asyncio.sleep(0)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        peer.bind(("127.0.0.1", port))
        peer.setblocking(False)
        link.answer_to(("127.0.0.1", 9))
        link.send(b"hello")
        data, source = await asyncio.get_running_loop().sock_recvfrom(peer, 100)
        assert data == b"hello"
        peer.sendto(b"hello yourself", source)
        await wait_until(lambda: receiver.data == b"hello yourself", 5.0)
    await link.close()


async def test_tcp_link_is_reopened_after_a_loss(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    receiver, arrived, writers = Receiver(), bytearray(), []
    served: list[asyncio.Task[Any]] = []

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writers.append(writer)
        writer.write(b"welcome %d" % len(writers))
        task = asyncio.current_task()
        assert task is not None
        served.append(task)
        with contextlib.suppress(ConnectionError):
            while data := await reader.read(100):
                arrived.extend(data)
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    link = await open_link(parse_link_url(f"tcp://127.0.0.1:{port}"), receiver)
    await wait_until(lambda: receiver.data == b"welcome 1", 5.0)
    assert receiver.source is None
    link.send(b"first")
    await wait_until(lambda: bytes(arrived) == b"first", 5.0)
    writers[0].transport.abort()
    await wait_until(lambda: receiver.data == b"welcome 1welcome 2", 10.0)
    link.send(b" second")
    await wait_until(lambda: bytes(arrived) == b"first second", 5.0)
    await wait_until(lambda: "reopened" in caplog.text, 5.0)
    await link.close()
    await link.close()
    await asyncio.gather(*served)
    server.close()
    await server.wait_closed()


async def test_delayed_rest_of_a_frame_is_dropped(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """As after a suspend or SIGSTOP in the middle of a setpoint, on a full line."""
    seconds = itertools.count()
    monkeypatch.setattr("companion.vehicle.byte_link.boottime_ns", lambda: next(seconds) * 10**9)
    listener = socket.socket()
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    listener.bind(("127.0.0.1", 0))
    listener.listen()
    link = await open_link(parse_link_url(f"tcp://127.0.0.1:{listener.getsockname()[1]}"), Receiver())
    peer, _ = listener.accept()
    peer.setblocking(False)
    size = 1_000_003
    assert isinstance(link, _StreamLink)
    while not link._unsent:
        link.send(bytes(size))
    arrived = 0
    while "partial frame dropped" not in caplog.text:
        with contextlib.suppress(BlockingIOError):
            arrived += len(peer.recv(1 << 20))
        await asyncio.sleep(0)
    assert link.dropped_count == 1
    link.send(b"next")
    await link.close()
    peer.setblocking(True)
    while data := peer.recv(1 << 20):
        arrived += len(data)
        last = data
    assert last.endswith(b"next")
    assert (arrived - 4) % size != 0, "the partial frame was completed"
    peer.close()
    listener.close()


async def test_full_tcp_link_drops_only_whole_messages(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("companion.vehicle.byte_link._PARTIAL_FRAME_S", 60.0)
    listener = socket.socket()
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    listener.bind(("127.0.0.1", 0))
    listener.listen()
    link = await open_link(parse_link_url(f"tcp://127.0.0.1:{listener.getsockname()[1]}"), Receiver())
    peer, _ = listener.accept()
    sent = 0
    while link.dropped_count < 10:
        link.send(sent.to_bytes(4, "big") * 250)
        sent += 1
    peer.setblocking(False)
    received = b""
    while True:
        try:
            received += peer.recv(1 << 20)
        except BlockingIOError:
            if len(received) == (sent - link.dropped_count) * 1000:
                break
            await asyncio.sleep(0.01)
    messages = [received[at : at + 1000] for at in range(0, len(received), 1000)]
    assert all(message == message[:4] * 250 for message in messages)
    await link.close()
    peer.close()
    listener.close()


async def test_close_stops_reopening() -> None:
    server = await asyncio.start_server(lambda _r, w: w.close(), "127.0.0.1", 0)
    link = await open_link(
        parse_link_url(f"tcp://127.0.0.1:{server.sockets[0].getsockname()[1]}"), Receiver()
    )
    server.close()
    await server.wait_closed()
    await link.close()
    await link.close()


async def test_serial_line_is_raw_in_both_directions() -> None:
    receiver = Receiver()
    master, slave = pty.openpty()
    name = os.ttyname(slave)
    os.close(slave)
    link = await open_link(parse_link_url(f"serial://{name}:57600"), receiver)
    everything = bytes(range(256))
    os.write(master, everything)
    await wait_until(lambda: receiver.data == everything, 5.0)
    link.send(everything)
    os.set_blocking(master, False)
    echoed = b""
    while len(echoed) < 256:
        try:
            echoed += os.read(master, 1000)
        except BlockingIOError:
            await asyncio.sleep(0.01)
    assert echoed == everything
    await link.close()
    await link.close()
    os.close(master)


async def test_serial_hangup_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    master, slave = pty.openpty()
    name = os.ttyname(slave)
    os.close(slave)
    link = await open_link(parse_link_url(f"serial://{name}:57600"), Receiver())
    os.close(master)
    await wait_until(lambda: f"serial://{name}:57600: link lost" in caplog.text, 5.0)
    link.send(b"into nothing")
    assert link.dropped_count == 1
    await link.close()


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("serial:///dev/no-such-device:57600", " device /dev/no-such-device"),
        ("serial:///dev/null:57600", "not a serial device"),
        ("udpin://192.0.2.1:14540", r"no interface .*192\.0\.2\.1"),
        ("udpin://host.invalid:14540", "resolved"),
    ],
)
async def test_open_failure_is_one_line_with_the_url(url: str, message: str) -> None:
    with pytest.raises(LinkError, match=message) as caught:
        await open_link(parse_link_url(url), Receiver())
    assert str(caught.value).startswith(url)
    assert "\n" not in str(caught.value)


async def test_refused_tcp_connection_is_reported() -> None:
    with pytest.raises(LinkError, match="Connection refused"):
        await open_link(parse_link_url(f"tcp://127.0.0.1:{free_port(socket.SOCK_STREAM)}"), Receiver())


async def test_busy_serial_device_is_reported() -> None:
    master, slave = pty.openpty()
    url = parse_link_url(f"serial://{os.ttyname(slave)}:57600")
    link = await open_link(url, Receiver())
    with pytest.raises(LinkError, match=rf" program .*{os.ttyname(slave)} open"):
        await open_link(url, Receiver())
    await link.close()
    os.close(master)
    os.close(slave)
