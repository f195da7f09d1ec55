"""Foxglove live: a viewer gets the channels of a recording, images while it shows them, and kept messages."""

from __future__ import annotations

import asyncio
import base64
import json
import os
import socket
import struct
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from companion.bus.client import settings_for_child
from companion.bus.session import Bus
from companion.bus.topics import COMMAND_STATE, EVENTS, STATUS, TRACKS
from companion.host.child_process import child_process
from companion.recording import RecordingError
from companion.recording.files import Channel, Recorded
from companion.settings import ZenohSection
from mavlink_sim.testing import free_port, running_simulator
from tests.companion.service_process import TWICE, heartbeats, running_service

pytestmark = pytest.mark.realtime
live = pytest.importorskip("companion.recording.live", reason="foxglove-sdk is an optional extra")

TEXT, BINARY = 1, 2
MESSAGE_DATA = 1
_MASK = b"\1\2\3\4"


class Viewer:
    """A client of Foxglove's WebSocket protocol (foxglove.sdk.v1), which is enough of RFC 6455 for it."""

    def __init__(self, port: int) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port), timeout=20)
        key = base64.b64encode(os.urandom(16)).decode()
        self._socket.sendall(
            f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n"
            "Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n".encode()
        )
        self._file = self._socket.makefile("rb")
        assert b" 101 " in self._file.readline()
        while self._file.readline().strip():
            pass
        self.channels: dict[str, dict[str, Any]] = {}

    def close(self) -> None:
        self._file.close()
        self._socket.close()

    def send(self, message: dict[str, Any]) -> None:
        data = json.dumps(message).encode()
        masked = bytes(byte ^ _MASK[index % 4] for index, byte in enumerate(data))
        self._socket.sendall(struct.pack(">BBH", 0x80 | TEXT, 0x80 | 126, len(data)) + _MASK + masked)

    def frames(self) -> Iterator[tuple[int, bytes]]:
        while True:
            opcode, length = self._file.read(2)
            if length >= 126:
                (length,) = struct.unpack(
                    *((">H", self._file.read(2)) if length == 126 else (">Q", self._file.read(8)))
                )
            yield opcode & 0xF, self._file.read(length)

    def wait_for_channel(self, topic: str) -> dict[str, Any]:
        while topic not in self.channels:
            opcode, data = next(self.frames())
            if opcode == TEXT and (message := json.loads(data)).get("op") == "advertise":
                self.channels |= {channel["topic"]: channel for channel in message["channels"]}
        return self.channels[topic]

    def wait_for_message(self, subscription: int) -> tuple[int, dict[str, Any]]:
        """Unix time and body of the next message."""
        for opcode, data in self.frames():
            if opcode == BINARY and data[0] == MESSAGE_DATA:
                identifier, log_time_ns = struct.unpack_from("<IQ", data, 1)
                if identifier == subscription:
                    return log_time_ns, json.loads(data[13:])
        raise AssertionError("the connection was closed")


def test_viewer_gets_messages_and_images(filming: list[str], tmp_path: Path) -> None:
    port = free_port(socket.SOCK_STREAM)
    flags = [*filming, "--foxglove-listen", f"127.0.0.1:{port}"]
    with (
        running_simulator(**TWICE) as simulator,
        running_service(simulator.onboard_port, flags, cwd=tmp_path) as service,
    ):
        service.wait_for_line("foxglove: open ws://")
        viewer = Viewer(port)
        try:
            image, transforms = viewer.wait_for_channel("/image"), viewer.wait_for_channel("/tf")
            assert image["schemaName"] == "foxglove.CompressedImage"
            assert viewer.wait_for_channel("/cloud")["schemaName"] == "foxglove.PointCloud"
            assert viewer.wait_for_channel("/depth_image")["schemaName"] == "foxglove.RawImage"
            assert json.loads(transforms["schema"])["title"] == "foxglove.FrameTransforms"
            chosen = [{"id": 1, "channelId": transforms["id"]}, {"id": 2, "channelId": image["id"]}]
            viewer.send({"op": "subscribe", "subscriptions": chosen})
            parents: set[str] = set()
            while not {"local_enu", "vehicle1/ned"} <= parents:
                _, body = viewer.wait_for_message(1)
                parents |= {transform["parent_frame_id"] for transform in body["transforms"]}
            log_time_ns, body = viewer.wait_for_message(2)
            assert base64.b64decode(body["data"])[:2] == b"\xff\xd8"
            assert body["timestamp"]["sec"] == log_time_ns // 10**9
        finally:
            viewer.close()


STAMPS = [1_000_000 * number for number in range(200)]


def event(number: int) -> dict[str, Any]:
    return {"stamp_ns": STAMPS[number], "level": "info", "text": f"event {number}"}


def show(port: int, *topics: str) -> Viewer:
    """A new viewer of these topics, whose subscriptions are numbered from 1."""
    viewer = Viewer(port)
    wanted = [
        {"id": number, "channelId": viewer.wait_for_channel(topic)["id"]}
        for number, topic in enumerate(topics, 1)
    ]
    viewer.send({"op": "subscribe", "subscriptions": wanted})
    return viewer


def kept(port: int, topic: str, count: int) -> list[tuple[int, dict[str, Any]]]:
    """The first messages that a new viewer of a topic gets."""
    viewer = show(port, topic)
    try:
        return [viewer.wait_for_message(1) for _ in range(count)]
    finally:
        viewer.close()


async def no_command(_text: str) -> dict[str, Any]:
    raise AssertionError


async def test_late_viewer_begins_with_the_kept_messages() -> None:
    endpoint, port = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}", free_port(socket.SOCK_STREAM)
    settings = ZenohSection(listen=(endpoint,))
    bus = Bus(settings, "alpha", on_event=lambda *_: None, on_command=no_command, views=["down"])
    options = {"listen": f"127.0.0.1:{port}", "vehicle": "alpha", "zenoh": settings_for_child(settings)}
    lines: asyncio.Queue[str] = asyncio.Queue()
    await bus.start()
    try:
        for number in range(5):  # before the process is there: the service keeps them
            bus.publish(EVENTS, event(number))
        async with (
            child_process("foxglove", "companion.recording", json.dumps(options), lines.put_nowait),
            asyncio.timeout(60),
        ):
            assert "open ws://" in await lines.get()
            messages = await asyncio.to_thread(kept, port, "/log", 5)
            assert [body["message"] for _, body in messages] == [f"event {number}" for number in range(5)]
            early = await asyncio.to_thread(show, port, "events")
            assert [early.wait_for_message(1)[1]["stamp_ns"] for _ in range(5)] == STAMPS[:5]

            for number in range(5, 140):
                bus.publish(EVENTS, event(number))
            for number in range(3):
                bus.publish(STATUS, {"now_ns": number})
                bus.publish(TRACKS, {"stamp_ns": number}, view="down")
                bus.publish(COMMAND_STATE, {"stamp_ns": number})
            while (await asyncio.to_thread(early.wait_for_message, 1))[1]["stamp_ns"] != STAMPS[139]:
                pass
            messages = await asyncio.to_thread(kept, port, "events", EVENTS.cached)
            assert [body["stamp_ns"] for _, body in messages] == STAMPS[40:140]
            log_times = [log_time_ns for log_time_ns, _ in messages]
            assert [time - log_times[0] for time in log_times] == [
                stamp - STAMPS[40] for stamp in STAMPS[40:140]
            ]
            for topic in ("cameras/down/tracks", "command_state"):
                messages = await asyncio.to_thread(kept, port, topic, 3)
                assert [body["stamp_ns"] for _, body in messages] == [0, 1, 2]
            ((_, status),) = await asyncio.to_thread(kept, port, "status", STATUS.cached)
            assert status["now_ns"] == 2

            bus.publish(EVENTS, event(140))  # the others' kept messages are not sent to this one again
            assert (await asyncio.to_thread(early.wait_for_message, 1))[1]["stamp_ns"] == STAMPS[140]
            early.close()
    finally:
        await bus.close()


def test_bytes_of_kept_messages_are_bounded() -> None:
    kept = live.Kept(100)
    for number in range(20):
        kept.add(
            Recorded(Channel("tracks", "companion.tracks", b"{}"), number, bytes(live.MAX_KEPT_BYTES // 10))
        )
    assert [message.log_time_ns for message in kept] == list(range(10, 20))


@pytest.mark.parametrize("host", ["0.0.0.0", "[::]", "drone.local"])
def test_host_that_others_can_reach_is_refused(host: str) -> None:
    options = live.LiveOptions(ZenohSection(), "vehicle1", f"{host}:8765")
    with pytest.raises(RecordingError, match=r"foxglove\.listen"):
        live.serve(options, threading.Event(), lambda _: None)


def test_service_reports_busy_port_and_bad_folder_and_runs(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with socket.create_server(("127.0.0.1", 0)) as taken, heartbeats() as port:
        address, folder = f"127.0.0.1:{taken.getsockname()[1]}", tmp_path / "file" / "folder"
        flags = ["--source", "none", "--foxglove-listen", address, "--recording-directory", str(folder)]
        with running_service(port, flags, cwd=tmp_path) as service:
            assert "foxglove: " in service.wait_for_line(f"{address} cannot ")
            assert "recorder: " in service.wait_for_line(f"{folder}: the folder ")
            assert service.command("stop")["success"]
