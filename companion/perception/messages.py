"""Messages between the service and the perception worker, and their framing on the sockets.

A message is one of the dataclasses below, pickled, after its length (4 bytes, big-endian). Both ends are this
program, and no other process has the sockets.
"""

from __future__ import annotations

import asyncio
import pickle
import socket
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from companion.settings import Settings
from vision.attitude import Quaternion
from vision.camera_model import CameraCalibration
from vision.pipeline import PerceptionResult

_LENGTH = struct.Struct(">I")
# Far above any message: a result is a few kilobytes. A longer one is a protocol error.
LARGEST_BYTES = 1 << 24


# --- service → worker


@dataclass(frozen=True, slots=True)
class Begin:
    """The first message. Tracks are numbered from `first_track_id` on."""

    settings: Settings
    first_track_id: int = 1


@dataclass(frozen=True, slots=True)
class Hud:
    """Lines for the recorded video's next frames, and the class to highlight in them."""

    lines: tuple[str, ...]
    highlight: str | None


@dataclass(frozen=True, slots=True)
class Attitude:
    """The vehicle's attitude (w, x, y, z), body FRD to NED, at a CLOCK_MONOTONIC stamp; height above home."""

    stamp_ns: int
    wxyz: Quaternion
    height_m: float | None = None


@dataclass(frozen=True, slots=True)
class GimbalAttitude:
    """The attitude of the camera's gimbal (w, x, y, z), its FRD to NED, at a CLOCK_MONOTONIC stamp."""

    stamp_ns: int
    wxyz: Quaternion


@dataclass(frozen=True, slots=True)
class Watched:
    """Whether preview images are wanted."""

    watched: bool


@dataclass(frozen=True, slots=True)
class Stop:
    """Finish the video and end."""


# --- worker → service


@dataclass(frozen=True, slots=True)
class Ready:
    """The model is loaded and the source has given its first frame.

    `model` is None without a detector; `precision` and `runtime` of the network are None without a network.
    `reason`: why these were selected, as text. `calibration`: from the camera, if it provides one.
    """

    source: str
    model: str | None
    class_names: tuple[str, ...]
    precision: str | None
    runtime: str | None = None
    reason: str = ""
    calibration: CameraCalibration | None = None


@dataclass(frozen=True, slots=True)
class StartFailed:
    """The worker cannot start with its settings. One line."""

    text: str


@dataclass(frozen=True, slots=True)
class Report:
    """A result with its counters.

    Attributes:
        replaced: results so far that were replaced by a newer one before they were sent.
    """

    result: PerceptionResult
    frames: int
    replaced: int


@dataclass(frozen=True, slots=True)
class Preview:
    """One preview image, JPEG."""

    sequence: int
    captured_ns: int
    jpeg: bytes


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """The loop is alive without a processed frame. `dropped` and `frames_skipped`: as in a result."""

    frames: int
    dropped: int = 0
    frames_skipped: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class LogLine:
    """A record of the worker's log. `level` is `logging`'s number."""

    level: int
    logger: str
    text: str


@dataclass(frozen=True, slots=True)
class Ended:
    """The last message. `finished`: the source has ended, or the service requested it; else an error."""

    finished: bool
    text: str
    frames: int


Message = (
    Begin
    | Hud
    | Attitude
    | GimbalAttitude
    | Watched
    | Stop
    | Ready
    | StartFailed
    | Report
    | Preview
    | Heartbeat
    | LogLine
    | Ended
)


class ProtocolError(ConnectionError):
    """Received data is not a message."""


def packed(message: Message) -> bytes:
    """Encode a message, length first."""
    body = pickle.dumps(message, protocol=pickle.HIGHEST_PROTOCOL)
    return _LENGTH.pack(len(body)) + body


def receive(connection: socket.socket) -> Message | None:
    """Receive the next message of a blocking socket; None when the other end is closed."""
    header = _receive_exactly(connection, _LENGTH.size)
    if header is None:
        return None
    body = _receive_exactly(connection, _length(header))
    return None if body is None else _unpacked(body)


async def read_message(reader: asyncio.StreamReader) -> Message | None:
    """Read the next message of a stream; None when the other end is closed."""
    try:
        header = await reader.readexactly(_LENGTH.size)
        return _unpacked(await reader.readexactly(_length(header)))
    except (asyncio.IncompleteReadError, ConnectionResetError):
        return None


def _receive_exactly(connection: socket.socket, count: int) -> bytes | None:
    data = bytearray()
    while len(data) < count:
        try:
            chunk = connection.recv(count - len(data))
        except ConnectionResetError:
            return None
        if not chunk:
            return None
        data += chunk
    return bytes(data)


def _length(header: bytes) -> int:
    length: int = _LENGTH.unpack(header)[0]
    if length > LARGEST_BYTES:
        raise ProtocolError(f"message length {length} bytes exceeds {LARGEST_BYTES}")
    return length


def _unpacked(body: bytes) -> Message:
    message: Any = pickle.loads(body)
    if not isinstance(message, Message):
        raise ProtocolError(f"{type(message).__name__} is not a message type")
    return message
