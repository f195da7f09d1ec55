"""Video in real players: ffmpeg and GStreamer, over TCP and UDP, beside one that has stopped."""

from __future__ import annotations

import ast
import asyncio
import signal
import sys
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from companion.ground_station import h264_child, rtsp
from companion.ground_station.gstreamer import H264Server
from companion.ground_station.rtsp import VideoServer
from tests.companion.ground_station.rtsp_client import number_of, numbered_jpeg, push_images
from tests.companion.ground_station.video_players import HEIGHT, WIDTH, Player, ffmpeg, gstreamer

pytestmark = pytest.mark.realtime
H264 = "rtph264depay ! h264parse ! openh264dec"
TOKEN = "0123456789abcdef"
RATE_HZ = 15.0
IMAGES = 45
"""That a player shows in three seconds."""


@asynccontextmanager
async def jpeg_stream() -> AsyncIterator[tuple[VideoServer, str]]:
    """A server with images at `RATE_HZ`, and the stream's address."""
    server = VideoServer("127.0.0.1:0", ["front"], token=TOKEN)
    await server.start()
    pushing = asyncio.create_task(push_images(server, "front", RATE_HZ))
    try:
        yield server, f"rtsp://127.0.0.1:{server.port}{server.paths['front']}"
    finally:
        pushing.cancel()
        await server.close()


async def shown(player: Player, count: int, closeness: float) -> list[int]:
    """The numbers of the next images, each compared with the one that was sent."""
    numbers = []
    for _ in range(count):
        pixels = await player.image()
        numbers.append(number_of(pixels))
        sent = cv2.imdecode(np.frombuffer(numbered_jpeg(numbers[-1], WIDTH, HEIGHT), np.uint8), 1)
        assert sent is not None
        assert np.abs(pixels.astype(int) - sent).mean() < closeness
    return numbers


def skipped(numbers: list[int]) -> int:
    """How many images between the first and the last were not shown."""
    return sum((later - one) % 256 - 1 for one, later in pairwise(numbers))


@pytest.mark.parametrize("transport", ["tcp", "udp"])
async def test_ffmpeg_shows_every_image(transport: str) -> None:
    async with jpeg_stream() as (_, uri), ffmpeg(uri, transport) as player:
        assert skipped(await shown(player, IMAGES, 3.0)) == 0


@pytest.mark.needs("GStreamer")
@pytest.mark.parametrize("transport", ["tcp", "udp"])
async def test_gstreamer_shows_every_image(transport: str) -> None:
    async with jpeg_stream() as (_, uri), gstreamer(uri, transport, "rtpjpegdepay ! jpegdec") as player:
        assert skipped(await shown(player, IMAGES, 3.0)) == 0


async def test_five_players_show_every_image_beside_a_stopped_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rtsp, "UNREAD_S", 2.0)
    monkeypatch.setattr(rtsp, "_SEND_BUFFER_BYTES", 4096)
    async with jpeg_stream() as (server, uri), AsyncExitStack() as stack:
        players = [await stack.enter_async_context(ffmpeg(uri, "tcp")) for _ in range(6)]
        await asyncio.gather(*(player.image() for player in players))
        stopped, *healthy = players
        stopped.process.send_signal(signal.SIGSTOP)
        numbers = await asyncio.gather(*(shown(player, IMAGES, 3.0) for player in healthy))
        assert [skipped(one) for one in numbers] == [0] * 5
        async with asyncio.timeout(60):
            while len(server.viewers["front"]) > 5:
                await asyncio.gather(*(player.image() for player in healthy))
        assert [skipped(await shown(player, 5, 3.0)) for player in healthy] == [0] * 5


@asynccontextmanager
async def h264_stream() -> AsyncIterator[tuple[H264Server, str, list[bool]]]:
    """A server with images at `RATE_HZ`, the stream's address, and when it was wanted."""
    said, wanted = list[str](), list[bool]()
    server = H264Server(
        "127.0.0.1",
        0,
        ["front"],
        token=TOKEN,
        on_wanted=lambda _stream, change: wanted.append(change),
        say=said.append,
    )
    await server.start()

    async def push() -> None:
        for count in range(1_000_000):
            server.push("front", numbered_jpeg(count % 256), 0)
            await asyncio.sleep(1 / RATE_HZ)

    pushing = asyncio.create_task(push())
    try:
        async with asyncio.timeout(60):
            while not server.is_ready:
                await asyncio.sleep(0.01)
        yield server, f"rtsp://127.0.0.1:{server.port}{server.paths['front']}", wanted
    finally:
        pushing.cancel()
        await server.close()
    assert said == []


@pytest.mark.needs("GStreamer")
async def test_h264_is_shown_while_wanted() -> None:
    async with h264_stream() as (_, uri, wanted):
        assert wanted == []
        async with ffmpeg(uri, "tcp") as player, gstreamer(uri, "tcp", H264) as other:
            for one in (player, other):
                assert skipped(await shown(one, IMAGES, 6.0)) <= IMAGES // 3
            assert wanted == [True]
        async with asyncio.timeout(30):
            while wanted[-1]:
                await asyncio.sleep(0.05)


@pytest.mark.needs("GStreamer")
async def test_h264_needs_the_token_in_its_path() -> None:
    async with h264_stream() as (server, uri, wanted):
        for path in ("/front", "/front/0123456789abcdee", "/"):
            async with ffmpeg(f"rtsp://127.0.0.1:{server.port}{path}", "tcp") as player:
                assert await player.process.wait() != 0
        assert wanted == []
        async with ffmpeg(uri, "udp") as player:
            await player.image()


def test_child_is_of_python_3_9() -> None:
    ast.parse(Path(h264_child.__file__).read_text(), feature_version=(3, 9))


async def test_without_gstreamer_one_line_says_why() -> None:
    for python in (sys.executable, "/nowhere/python3"):
        said: list[str] = []
        server = H264Server(
            "127.0.0.1",
            0,
            ["front"],
            token=None,
            on_wanted=lambda _stream, _wanted: None,
            say=said.append,
            python=python,
        )
        await server.start()
        async with asyncio.timeout(30):
            while not said:
                await asyncio.sleep(0.01)
        server.push("front", b"", 0)
        await server.close()
        assert len(said) == 1
        assert "no H.264: " in said[0]
