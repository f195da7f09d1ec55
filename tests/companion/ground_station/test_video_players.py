"""Video in real players: ffmpeg and GStreamer, over TCP and UDP, beside one that has stopped."""

from __future__ import annotations

import ast
import asyncio
import os
import signal
import socket
import subprocess
import sys
import time
from asyncio.subprocess import Process
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import cv2
import numpy as np
import pytest

from companion.ground_station import h264_child, rtsp
from companion.ground_station.gstreamer import UNTAKEN_S, H264Server
from companion.ground_station.rtsp import VideoServer
from mavlink_sim.testing import free_port
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


class H264Stream:
    """An H.264 server with images at `RATE_HZ`.

    Attributes:
        said: its lines. wanted: when its stream was wanted. pushes: images so far, and the longest time that
            one kept the loop, seconds.
    """

    def __init__(self, image: Callable[[int], bytes] = numbered_jpeg) -> None:
        self._image = image
        self.said, self.wanted = list[str](), list[bool]()
        self.pushes, self.longest_push_s = 0, 0.0
        self.server = H264Server(
            "127.0.0.1",
            free_port(socket.SOCK_STREAM),
            ["front"],
            token=TOKEN,
            on_wanted=lambda _stream, change: self.wanted.append(change),
            say=self.said.append,
        )

    @property
    def uri(self) -> str:
        return f"rtsp://127.0.0.1:{self.server.port}{self.server.paths['front']}"

    @property
    def child(self) -> int:
        process = self.server._process
        assert process is not None
        return process.pid

    async def push(self) -> None:
        for count in range(1_000_000):
            begun_s = time.monotonic()
            self.server.push("front", self._image(count % 256), 0)
            self.longest_push_s = max(self.longest_push_s, time.monotonic() - begun_s)
            self.pushes += 1
            await asyncio.sleep(1 / RATE_HZ)


async def until(condition: Callable[[], object], timeout_s: float = 60.0) -> None:
    async with asyncio.timeout(timeout_s):
        while not condition():
            await asyncio.sleep(0.01)


@asynccontextmanager
async def h264_stream(
    image: Callable[[int], bytes] = numbered_jpeg, *, lines: int = 0
) -> AsyncIterator[H264Stream]:
    """`lines`: how many it says in the end."""
    stream = H264Stream(image)
    await stream.server.start()
    pushing = asyncio.create_task(stream.push())
    try:
        await until(lambda: stream.server.is_ready)
        yield stream
    finally:
        pushing.cancel()
        await stream.server.close()
    assert len(stream.said) == lines, stream.said


@pytest.mark.needs("GStreamer")
async def test_h264_is_shown_while_wanted() -> None:
    async with h264_stream() as stream:
        assert stream.wanted == []
        async with ffmpeg(stream.uri, "tcp") as player, gstreamer(stream.uri, "tcp", H264) as other:
            for one in (player, other):
                assert skipped(await shown(one, IMAGES, 6.0)) <= IMAGES // 3
            assert stream.wanted == [True]
        await until(lambda: not stream.wanted[-1], 30.0)


@pytest.mark.needs("GStreamer")
async def test_h264_needs_the_token_in_its_path() -> None:
    async with h264_stream() as stream:
        for path in ("/front", "/front/0123456789abcdee", "/"):
            async with ffmpeg(f"rtsp://127.0.0.1:{stream.server.port}{path}", "tcp") as player:
                assert await player.process.wait() != 0
        assert stream.wanted == []
        async with ffmpeg(stream.uri, "udp") as player:
            await player.image()


@pytest.mark.needs("GStreamer")
async def test_h264_plays_beside_a_viewer_that_stopped_reading() -> None:
    async with h264_stream() as stream:
        async with ffmpeg(stream.uri, "tcp") as stopped, ffmpeg(stream.uri, "tcp") as player:
            await asyncio.gather(stopped.image(), player.image())
            stopped.process.send_signal(signal.SIGSTOP)
            assert skipped(await shown(player, IMAGES, 6.0)) <= IMAGES // 3
            assert stream.wanted == [True]
        await until(lambda: not stream.wanted[-1], 30.0)


def busy_jpeg(number: int) -> bytes:
    """An image that costs many bits: what waits for a viewer is soon much."""
    blocks = np.random.default_rng(number).integers(0, 255, (HEIGHT // 4, WIDTH // 4, 3), np.uint8)
    return cv2.imencode(".jpg", cv2.resize(blocks, (WIDTH, HEIGHT)))[1].tobytes()


@pytest.mark.slow
@pytest.mark.needs("GStreamer")
async def test_h264_viewer_that_stopped_reading_is_disconnected() -> None:
    async with (
        h264_stream(busy_jpeg) as stream,
        ffmpeg(stream.uri, "tcp") as stopped,
        ffmpeg(stream.uri, "tcp") as player,
    ):
        await asyncio.gather(stopped.image(), player.image())
        assert connections(stream.server.port) == 2
        stopped.process.send_signal(signal.SIGSTOP)
        async with asyncio.timeout(60.0):
            while connections(stream.server.port) == 2:
                await player.image()
        assert stream.wanted == [True]


def connections(port: int) -> int:
    """How many connections of TCP a server on this computer has."""
    rows = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()]
    return sum(row[1].endswith(f":{port:04X}") and row[3] == "01" for row in rows)  # TCP_ESTABLISHED


@pytest.mark.needs("GStreamer")
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP])
async def test_h264_child_that_dies_or_hangs_is_replaced(
    how: signal.Signals, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("companion.ground_station.gstreamer.UNTAKEN_S", 2.0)
    lines = {signal.SIGKILL: 1, signal.SIGSTOP: 2}[how]  # one more says why it was killed
    async with h264_stream(lines=lines) as stream:
        async with ffmpeg(stream.uri, "tcp") as player:
            await player.image()
            first, pushes = stream.child, stream.pushes
            os.kill(first, how)
            await until(lambda: stream.wanted == [True, False])
            await until(lambda: not stream.server.is_ready)  # it is not announced now
            with suppress(asyncio.IncompleteReadError):  # the stream ends
                async with asyncio.timeout(30.0):
                    while True:
                        await player.image()
        await until(lambda: stream.server.is_ready)
        assert stream.child != first
        assert how is signal.SIGKILL or stream.pushes - pushes > RATE_HZ
        assert stream.longest_push_s < 0.5
        assert "-9" in stream.said[-1]
        async with ffmpeg(stream.uri, "tcp") as player:
            await shown(player, 5, 6.0)


class UntakingProcess:
    """A process that takes nothing. `kills`: how often it was killed."""

    def __init__(self) -> None:
        self.kills = 0
        self.stdin = SimpleNamespace(transport=SimpleNamespace(get_write_buffer_size=lambda: 1))

    def kill(self) -> None:
        self.kills += 1


@pytest.mark.parametrize(("gap_s", "kills"), [(0.0, 0), (3600.0, 0), (None, 1)])
def test_h264_child_is_killed_once_and_not_for_a_pause(
    monkeypatch: pytest.MonkeyPatch, gap_s: float | None, kills: int
) -> None:
    now_s, said, process = 1000.0, list[str](), UntakingProcess()
    monkeypatch.setattr("companion.ground_station.gstreamer.time.monotonic", lambda: now_s)
    server = H264Server(
        "127.0.0.1", 0, ["front", "rear"], token=None, on_wanted=lambda *_: None, say=said.append
    )
    server._process = cast(Process, process)
    for stream in server.paths:
        server._on_line(f"H.264: wanted {stream} 1")
    for _ in range(int(20 * UNTAKEN_S) if gap_s is None else 2):
        now_s += 0.1 if gap_s is None else gap_s
        for stream in server.paths:
            server.push(stream, b"", 0)
    assert (process.kills, len(said)) == (kills, kills)


@pytest.mark.needs("GStreamer")
async def test_h264_child_that_hangs_does_not_delay_the_end() -> None:
    async with h264_stream(lines=1) as stream, ffmpeg(stream.uri, "tcp") as player:
        await player.image()
        child = stream.child
        os.kill(child, signal.SIGSTOP)
        await until(lambda: state_of(child) == "T")
        begun_s = time.monotonic()
        await stream.server.close()
        assert time.monotonic() - begun_s < 4.0  # the process has 5 s, and videos to finish
        assert state_of(child) == "X"


PARENT = """
import asyncio
from companion.ground_station.gstreamer import H264Server

async def main():
    server = H264Server("127.0.0.1", 0, ["front"], token=None, on_wanted=lambda *_: None, say=print)
    await server.start()
    while not server.is_ready:
        await asyncio.sleep(0.01)
    print(server._process.pid, flush=True)
    await asyncio.sleep(600)

asyncio.run(main())
"""


@pytest.mark.needs("GStreamer")
@pytest.mark.parametrize("hangs", [False, True])
async def test_killed_process_leaves_no_h264_child(*, hangs: bool) -> None:
    parent = await asyncio.create_subprocess_exec(sys.executable, "-c", PARENT, stdout=subprocess.PIPE)
    try:
        assert parent.stdout is not None
        child = int(await parent.stdout.readline())
        if hangs:
            os.kill(child, signal.SIGSTOP)
            await until(lambda: state_of(child) == "T")
    finally:
        parent.kill()
        await parent.wait()
    await until(lambda: state_of(child) in "ZX", 10.0)


def state_of(pid: int) -> str:
    """The state of a process as in /proc: T stopped, Z ended and its parent does not know, X: gone."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(") ")[2][0]
    except FileNotFoundError:
        return "X"


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


@pytest.fixture
def no_encoder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """GStreamer without the plug-ins that have encoders of H.264."""
    (installed,) = {file.parent for file in Path("/usr").glob("lib/*/gstreamer-1.0/libgstopenh264.so")}
    for file in installed.glob("*.so"):
        if not any(part in file.name for part in ("264", "v4l2", "video4linux2", "nv")):
            (tmp_path / file.name).symlink_to(file)
    monkeypatch.setenv("GST_PLUGIN_SYSTEM_PATH_1_0", str(tmp_path))
    monkeypatch.setenv("GST_REGISTRY_1_0", str(tmp_path / "registry"))


@pytest.mark.needs("GStreamer")
@pytest.mark.usefixtures("no_encoder")
async def test_without_an_encoder_one_line_names_those_tried() -> None:
    stream = H264Stream()
    await stream.server.start()
    await until(lambda: stream.said)
    stream.server.push("front", numbered_jpeg(0), 0)
    await stream.server.close()
    assert not stream.server.is_ready
    (line,) = stream.said
    assert all(name in line for name in h264_child.ENCODERS)
