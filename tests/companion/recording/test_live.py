"""Foxglove live: a viewer gets the channels of a recording; images only while it shows them."""

from __future__ import annotations

import base64
import json
import os
import socket
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from mavlink_sim.testing import free_port, running_simulator
from tests.companion.service_process import TWICE, heartbeats, running_service

pytestmark = pytest.mark.realtime
pytest.importorskip("foxglove", reason="foxglove-sdk is an optional extra")

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


def test_service_reports_busy_port_and_bad_folder_and_runs(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with socket.create_server(("127.0.0.1", 0)) as taken, heartbeats() as port:
        address, folder = f"127.0.0.1:{taken.getsockname()[1]}", tmp_path / "file" / "folder"
        flags = ["--source", "none", "--foxglove-listen", address, "--recording-directory", str(folder)]
        with running_service(port, flags, cwd=tmp_path) as service:
            assert "foxglove: " in service.wait_for_line(f"{address} cannot ")
            assert "recorder: " in service.wait_for_line(f"{folder}: the folder ")
            assert service.command("stop")["success"]
