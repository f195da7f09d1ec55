"""The RTSP server, by a plain client."""

from __future__ import annotations

import asyncio
import socket
import struct
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest
import pytest_asyncio

from companion.ground_station import GroundStationError, rtsp
from companion.ground_station.rtsp import (
    LONGEST_URI_BYTES,
    MAX_CONNECTIONS,
    MAX_VIEWERS,
    VideoServer,
    announced_host,
    announced_uri,
)
from companion.host.passing import AddressTakenError
from tests.companion.ground_station.rtp_jpeg_receiver import Receiver
from tests.companion.ground_station.rtsp_client import TCP, RtspClient, number_of, numbered_jpeg, push_images

TOKEN = "0123456789abcdef/+"
DOCUMENTS = {"/camera.xml": ("application/xml", b"<mavlinkcamera/>")}


@asynccontextmanager
async def serving(**options: Any) -> AsyncIterator[VideoServer]:
    """A server of the streams `front` and `rear`."""
    server = VideoServer("127.0.0.1:0", ["front", "rear"], documents=DOCUMENTS, **options)
    await server.start()
    try:
        yield server
    finally:
        await server.close()


@asynccontextmanager
async def playing(server: VideoServer, rate_hz: float = 100.0) -> AsyncIterator[list[int]]:
    """Numbered images meanwhile; yields their numbers."""
    sent: list[int] = []
    pushing = asyncio.create_task(push_images(server, "front", rate_hz, sent))
    try:
        yield sent
    finally:
        pushing.cancel()


@pytest_asyncio.fixture
async def server() -> AsyncIterator[VideoServer]:
    async with serving() as server:
        yield server


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(10):
        while not condition():
            await asyncio.sleep(0.005)


def decoded(jpeg: bytes) -> npt.NDArray[np.uint8]:
    return np.asarray(cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR), np.uint8)


def uri(server: VideoServer, stream: str = "front") -> str:
    return f"rtsp://127.0.0.1:{server.port}{server.paths[stream]}"


async def test_tcp_player_gets_the_images(server: VideoServer) -> None:
    client = await RtspClient.connect(server)
    described = await client.request("DESCRIBE", uri(server), Accept="application/sdp")
    assert described.headers["content-type"] == "application/sdp"
    lines = described.body.decode().splitlines()
    assert {"v=0", "m=video 0 RTP/AVP 26", f"a=control:{uri(server)}"} <= set(lines)
    reply = await client.play(uri(server), "RTP/AVP/TCP;unicast;interleaved=0-1")
    assert reply.headers["transport"].startswith("RTP/AVP/TCP;unicast;interleaved=0-1;ssrc=")
    async with playing(server):
        await client.receive(20)
    images = client.receiver.images
    numbers = [number_of(decoded(one.jpeg)) for one in images]
    assert numbers == list(range(numbers[0], numbers[0] + 20))
    assert f"ssrc={images[0].ssrc:08X}" in reply.headers["transport"]
    assert client.receiver.lost == 0
    assert (await client.request("TEARDOWN", uri(server))).status == 200


async def test_udp_goes_to_the_address_of_the_player_alone(server: VideoServer) -> None:
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as own,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as victim,
    ):
        own.bind(("127.0.0.1", 0))
        port = own.getsockname()[1]
        victim.bind(("127.0.0.2", port))
        for one in (own, victim):
            one.setblocking(False)
        client = await RtspClient.connect(server)
        reply = await client.play(
            uri(server), f"RTP/AVP;unicast;destination=127.0.0.2;client_port={port}-{port + 1}"
        )
        fields = dict(part.split("=") for part in reply.headers["transport"].split(";")[2:])
        assert fields["client_port"] == f"{port}-{port + 1}"
        assert "destination" not in fields
        first, second = map(int, fields["server_port"].split("-"))
        assert (first % 2, second) == (0, first + 1)
        receiver, loop = Receiver(), asyncio.get_running_loop()
        async with playing(server), asyncio.timeout(10):
            while len(receiver.images) < 20:
                packet, sender = await loop.sock_recvfrom(own, 2048)
                assert sender == ("127.0.0.1", first)
                receiver.take(packet)
        assert receiver.lost == 0
        with pytest.raises(BlockingIOError):
            victim.recv(1)


async def test_first_transport_that_can_be_had_is_taken(server: VideoServer) -> None:
    client = await RtspClient.connect(server)
    offers = f"RTP/AVP;multicast,RTP/AVP;unicast;client_port=22-23,{TCP.replace('0-1', '4-5')},{TCP}"
    reply = await client.request("SETUP", uri(server), Transport=offers)
    assert "interleaved=4-5" in reply.headers["transport"]


async def test_images_are_wanted_while_somebody_plays() -> None:
    wanted: list[tuple[str, bool]] = []
    async with serving(on_wanted=lambda *change: wanted.append(change)) as server:
        one, other = [await RtspClient.connect(server) for _ in range(2)]
        await one.request("DESCRIBE", uri(server))
        await one.request("SETUP", uri(server), Transport=TCP)
        assert wanted == []
        await one.request("PLAY", uri(server))
        await other.play(uri(server))
        assert wanted == [("front", True)]
        await one.request("PAUSE", uri(server))
        assert wanted == [("front", True)]
        other.writer.transport.abort()
        await until(lambda: wanted == [("front", True), ("front", False)])
        await one.request("PLAY", uri(server))
        await one.request("TEARDOWN", uri(server))
        assert wanted == [("front", True), ("front", False)] * 2


async def test_report_maps_the_time_of_images(server: VideoServer) -> None:
    client = await RtspClient.connect(server)
    await client.play(uri(server))
    async with playing(server):
        await client.receive(1)
    kind, ssrc, seconds, fraction, rtp_time = struct.unpack_from(">xBxxIIII", client.reports[0])
    (one,) = client.receiver.images[:1]
    assert (kind, ssrc) == (200, one.ssrc)
    assert abs(seconds - 2_208_988_800 + fraction / (1 << 32) - time.time()) < 5
    assert (rtp_time - one.time) % (1 << 32) < 90_000, "the image was captured just before"


@pytest.mark.parametrize(
    ("method", "path", "headers", "status"),
    [
        ("DESCRIBE", "/none", {}, 404),
        ("DESCRIBE", "/", {}, 404),
        ("DESCRIBE", "/../../etc/passwd", {}, 404),
        ("DESCRIBE", "/front/%00", {}, 404),
        ("SETUP", "/none", {"Transport": TCP}, 404),
        ("SETUP", "/front", {}, 461),
        ("SETUP", "/front", {"Transport": "RTP/AVP;multicast;port=5000-5001"}, 461),
        ("SETUP", "/front", {"Transport": "RTP/AVP;unicast"}, 461),
        ("SETUP", "/front", {"Transport": "RTP/AVP;unicast;client_port=22-23"}, 461),
        ("SETUP", "/front", {"Transport": "RTP/AVP;unicast;client_port=65535"}, 461),
        ("SETUP", "/front", {"Transport": "RTP/AVP;unicast;client_port=-5--4"}, 461),
        ("SETUP", "/front", {"Transport": "RTP/AVP/TCP;interleaved=255"}, 461),
        ("SETUP", "/front", {"Transport": "RTP/SAVP;unicast;client_port=5000-5001"}, 461),
        ("PLAY", "/front", {}, 455),
        ("PAUSE", "/front", {}, 455),
        ("TEARDOWN", "/front", {}, 455),
        ("PLAY", "/front", {"Session": "0123456789abcdef"}, 454),
        ("GET_PARAMETER", "/front", {"Session": "0123456789abcdef"}, 454),
        ("GET_PARAMETER", "/front", {}, 200),
        ("OPTIONS", "*", {}, 200),
        ("RECORD", "/front", {}, 501),
        ("ANNOUNCE", "/front", {}, 501),
    ],
)
async def test_status_of_a_request(
    server: VideoServer, method: str, path: str, headers: dict[str, str], status: int
) -> None:
    client = await RtspClient.connect(server)
    reply = await client.request(method, f"rtsp://127.0.0.1{path}" if path != "*" else path, **headers)
    assert reply.status == status
    assert reply.headers["cseq"] == "1"
    assert (await client.request("OPTIONS", "*")).status == 200, "the connection goes on"


@pytest.mark.parametrize(
    ("request_bytes", "status"),
    [
        (b"\x16\x03\x01\x02\x00\x01\r\n\r\n", 400),
        (b"NONSENSE\r\n\r\n", 400),
        (b"DESCRIBE rtsp://127.0.0.1/front RTSP/1.0\r\n\r\n", 400),
        (b"DESCRIBE rtsp://127.0.0.1/front RTSP/1.0\r\nCSeq: x\r\n\r\n", 400),
        (b"DESCRIBE rtsp://127.0.0.1/front RTSP/1.0\r\nCSeq\r\n\r\n", 400),
        (b"DESCRIBE rtsp://[::1/front RTSP/1.0\r\nCSeq: 1\r\n\r\n", 400),
        (b"DESCRIBE rtsp://127.0.0.1/fr\xc3\xb6nt RTSP/1.0\r\nCSeq: 1\r\n\r\n", 400),
        (b"DESCRIBE rtsp://127.0.0.1/front RTSP/1.0\r\nCSeq: 1\r\nX: " + b"a" * 9000 + b"\r\n\r\n", 400),
        (b"A" * 20000, 400),
        (b"OPTIONS * RTSP/1.0\r\nCSeq: 1\r\nContent-Length: many\r\n\r\n", 400),
        (b"OPTIONS * RTSP/1.0\r\nCSeq: 1\r\nContent-Length: -1\r\n\r\n", 413),
        (b"OPTIONS * RTSP/1.0\r\nCSeq: 1\r\nContent-Length: 9999999\r\n\r\n", 413),
        (b"OPTIONS * RTSP/2.0\r\nCSeq: 1\r\n\r\n", 505),
        (b"POST /camera.xml HTTP/1.1\r\nCSeq: 1\r\n\r\n", 400),
        (b"GET /none.xml HTTP/1.1\r\n\r\n", 404),
    ],
)
async def test_malformed_request_ends_its_connection_alone(
    server: VideoServer, request_bytes: bytes, status: int
) -> None:
    other, client = [await RtspClient.connect(server) for _ in range(2)]
    assert (await client.raw(request_bytes)).status == status
    assert await client.ended()
    assert (await other.request("DESCRIBE", uri(server))).status == 200


async def test_packets_and_empty_lines_between_requests_are_skipped(server: VideoServer) -> None:
    client = await RtspClient.connect(server)
    client.writer.write(b"\r\n$\x01\x00\x04abcd$\x01\x00\x00\r\n")
    assert (await client.request("OPTIONS", "*")).status == 200


async def test_document_is_served_by_http() -> None:
    async with serving(token=TOKEN) as server:
        for query, status in (("", 401), ("?token=wrong", 403), (server.with_token("")[0:], 200)):
            client = await RtspClient.connect(server)
            reply = await client.raw(f"GET /camera.xml{query} HTTP/1.1\r\nHost: x\r\n\r\n".encode())
            assert reply.status == status
            assert await client.ended()
        assert (reply.headers["content-type"], reply.body) == DOCUMENTS["/camera.xml"]


@pytest.mark.parametrize("method", ["DESCRIBE", "SETUP", "PLAY", "GET_PARAMETER"])
async def test_wrong_token_is_refused(method: str) -> None:
    async with serving(token=TOKEN) as server:
        client = await RtspClient.connect(server)
        at = f"rtsp://127.0.0.1:{server.port}"
        for path, status in (("/front", 401), ("/none", 401), ("/front?token=0123456789abcdef", 403)):
            assert (await client.request(method, at + path, Transport=TCP)).status == status
        assert (await client.request("OPTIONS", at)).status == 200
        assert (await client.request("DESCRIBE", at + server.paths["rear"])).status == 200


def test_server_that_others_can_reach_needs_a_token() -> None:
    with pytest.raises(GroundStationError, match="video_token_file"):
        VideoServer("0.0.0.0:8554", ["front"])
    VideoServer("0.0.0.0:8554", ["front"], token=TOKEN)


async def test_port_in_use_is_named(server: VideoServer) -> None:
    with pytest.raises(AddressTakenError, match=str(server.port)):
        await VideoServer(f"127.0.0.1:{server.port}", ["front"]).start()


async def test_connections_and_viewers_are_limited(server: VideoServer) -> None:
    clients = [await RtspClient.connect(server) for _ in range(MAX_CONNECTIONS)]
    for client in clients[:MAX_VIEWERS]:
        await client.play(uri(server))
    assert (await clients[-1].request("SETUP", uri(server), Transport=TCP)).status == 453
    await clients[-1].play(uri(server, "rear"))
    refused = await RtspClient.connect(server)
    assert (await refused.raw(b"")).status == 503
    assert await refused.ended()
    clients[0].writer.close()
    assert await clients[0].ended()
    await until(lambda: len(server.viewers["front"]) < MAX_VIEWERS)
    await (await RtspClient.connect(server)).play(uri(server))


async def test_silent_player_is_disconnected(server: VideoServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rtsp, "SESSION_TIMEOUT_S", 0.3)
    client = await RtspClient.connect(server)
    await client.play(uri(server), "RTP/AVP;unicast;client_port=5000-5001")
    assert await client.ended()
    await until(lambda: not server.viewers["front"])


async def test_player_that_does_not_read_costs_the_others_nothing(
    server: VideoServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rtsp, "UNREAD_S", 1.0)
    stopped, healthy = [await RtspClient.connect(server) for _ in range(2)]
    for client in (stopped, healthy):
        await client.play(uri(server))
    noise = np.random.default_rng(1).integers(0, 255, (480, 640, 3), dtype=np.uint8)
    jpeg = cv2.imencode(".jpg", noise)[1].tobytes()
    for count in range(1, 1000):
        server.push("front", jpeg, time.monotonic_ns())
        await healthy.receive(count)
        if len(server.viewers["front"]) == 1:
            break
        await asyncio.sleep(0.01)
    assert len(server.viewers["front"]) == 1
    assert healthy.receiver.lost == 0
    assert await stopped.ended()
    assert len(stopped.receiver.images) < count - 20, "images were dropped, not queued"


async def test_flood_of_requests_leaves_the_images_to_others(server: VideoServer) -> None:
    flooding, healthy = [await RtspClient.connect(server) for _ in range(2)]
    await healthy.play(uri(server))
    flooding.writer.write(b"OPTIONS * RTSP/1.0\r\nCSeq: 1\r\n\r\n" * 20_000)
    async with playing(server, 50.0) as sent:
        await healthy.receive(50)
        assert len(sent) <= 60
    assert healthy.receiver.lost == 0


async def test_image_that_cannot_be_sent_is_reported_once() -> None:
    said: list[str] = []
    async with serving(say=said.append) as server:
        grey = cv2.imencode(".jpg", np.zeros((48, 64), np.uint8))[1].tobytes()
        server.push("front", grey, 1)
        assert said == []  # nobody plays it
        client = await RtspClient.connect(server)
        await client.play(uri(server))
        for stamp_ns in range(3):
            server.push("front", grey, stamp_ns)
        server.push("front", numbered_jpeg(7), 4)
        await client.receive(1)
    assert len(said) == 1
    assert "components" in said[0]


@pytest.mark.parametrize(
    ("listen", "video_host", "station", "host"),
    [
        ("0.0.0.0", "drone.local", "192.168.1.5", "drone.local"),
        ("0.0.0.0", "fd00::1", "192.168.1.5", "[fd00::1]"),
        ("0.0.0.0", "[fd00::1]", "192.168.1.5", "[fd00::1]"),
        ("192.168.1.2", None, "10.0.0.1", "192.168.1.2"),
        ("127.0.0.1", "", "10.0.0.1", "127.0.0.1"),
    ],
)
def test_announced_host(listen: str, video_host: str | None, station: str, host: str) -> None:
    assert announced_host(listen, video_host, station) == host


def test_announced_host_is_that_of_the_way_to_the_station(monkeypatch: pytest.MonkeyPatch) -> None:
    ways = {"192.168.1.5": "192.168.1.2", "fd00::5": "fd00::2", "192.0.2.1": "10.0.0.2"}
    monkeypatch.setattr(rtsp, "_address_towards", lambda host: ways.get(host, ""))
    assert announced_host("0.0.0.0", None, "192.168.1.5") == "192.168.1.2"
    assert announced_host("0.0.0.0", None, "fd00::5") == "[fd00::2]"
    assert announced_host("0.0.0.0", None, "") == "10.0.0.2"
    assert announced_host("0.0.0.0", None, "127.0.0.1") == "10.0.0.2"  # a router here
    assert announced_host("0.0.0.0", None, "172.16.0.1") == "127.0.0.1"  # no way


def test_address_towards_this_computer_is_its_own() -> None:
    assert rtsp._address_towards("127.0.0.1") == "127.0.0.1"
    assert rtsp._address_towards("not an address") == ""


def test_announced_address_that_mavlink_cannot_carry_is_refused() -> None:
    path = "/" + "a" * (LONGEST_URI_BYTES - len("rtsp://h:1/"))
    assert len(announced_uri("h", 1, path)) == LONGEST_URI_BYTES
    with pytest.raises(GroundStationError, match="160 bytes"):
        announced_uri("h", 1, path + "a")
