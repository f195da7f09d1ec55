"""Messages between the service and the perception worker, their framing, and the worker's sender.

A message is one of the dataclasses below, pickled, after its length (4 bytes, big-endian). Both ends are this
program, and no other process has the sockets.
"""

from __future__ import annotations

import asyncio
import logging
import pickle
import socket
import struct
import sys
import threading
import traceback
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from companion.settings import Settings
from companion.vehicle.state import Vector3
from vision.attitude import Quaternion
from vision.camera_model import CameraCalibration
from vision.path_planner import PathRequest, PlannedPath
from vision.pipeline import PerceptionResult
from vision.redaction import redacted
from vision.tracking import Selected, SelectRequest, TrackEventKind

_LENGTH = struct.Struct(">I")
# Far above any message: a result is a few kilobytes. A longer one is a protocol error.
LARGEST_BYTES = 1 << 24


# --- service → worker


@dataclass(frozen=True, slots=True)
class Begin:
    """The first message.

    Attributes:
        first_track_id: of its first track; further ones follow.
        record_as: name of the shared memory for processed frames, for a recorder; None: none.
        detecting: instead of the settings' own, with which the detector is loaded; None: unchanged.
    """

    settings: Settings
    first_track_id: int = 1
    record_as: str | None = None
    detecting: Detecting | None = None


@dataclass(frozen=True, slots=True)
class Hud:
    """Lines for the recorded video's next frames, and the class to highlight in them."""

    lines: tuple[str, ...]
    highlight: str | None


@dataclass(frozen=True, slots=True)
class Attitude:
    """The vehicle's attitude and position.

    Attributes:
        stamp_ns: of the attitude, CLOCK_MONOTONIC. wxyz: (w, x, y, z), body FRD to NED.
        height_m: above home.
        position: its own stamp, and local NED metres.
        in_flight: whether it flies.
    """

    stamp_ns: int
    wxyz: Quaternion
    height_m: float | None = None
    position: tuple[int, Vector3] | None = None
    in_flight: bool = False


@dataclass(frozen=True, slots=True)
class GimbalAttitude:
    """The attitude of the camera's gimbal (w, x, y, z), its FRD to NED, at a CLOCK_MONOTONIC stamp."""

    stamp_ns: int
    wxyz: Quaternion


@dataclass(frozen=True, slots=True)
class Watched:
    """Whether preview images, point clouds and depth images are wanted."""

    watched: bool
    clouds: bool = False
    depth: bool = False


@dataclass(frozen=True, slots=True)
class Detecting:
    """`detector.confidence` and `detector.classes` from the next frame on. The service has checked them."""

    confidence: float
    classes: tuple[str | int, ...]


@dataclass(frozen=True, slots=True)
class Stop:
    """Finish the video and end."""


# --- worker → service


@dataclass(frozen=True, slots=True)
class Ready:
    """The model is loaded and the source has given its first frame.

    `model` is None without a detector; `precision` and `runtime` of the network are None without a network.
    `reason`: why these were selected, as text. `calibration`: from the camera, if it provides one.
    `model_sha256`: of the model's file; None without one. `rendered_only`, `min_confidence` and
    `reportable_ids`: as of `ObjectDetector`.
    """

    source: str
    model: str | None
    class_names: tuple[str, ...]
    precision: str | None
    runtime: str | None = None
    reason: str = ""
    calibration: CameraCalibration | None = None
    model_sha256: str | None = None
    rendered_only: bool = False
    min_confidence: float = 0.0
    reportable_ids: tuple[int, ...] | None = None


@dataclass(frozen=True, slots=True)
class StartFailed:
    """The worker cannot start. `wrong_settings`: however often it is tried. One line."""

    text: str
    wrong_settings: bool


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
class DepthPreview:
    """The depth image of one frame; `data` is the payload of `companion.bus.topics.DEPTH_IMAGE`."""

    sequence: int
    captured_ns: int
    width: int
    height: int
    data: bytes


@dataclass(frozen=True, slots=True)
class CloudPreview:
    """The point cloud of one frame, in the camera's optical frame; `data` is of `PointCloud.packed`."""

    sequence: int
    captured_ns: int
    points: int
    data: bytes


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


AnyPreview = Preview | DepthPreview | CloudPreview
"""What previews are made of a frame."""

Message = (
    Begin
    | Hud
    | Attitude
    | GimbalAttitude
    | Watched
    | SelectRequest
    | PathRequest
    | Detecting
    | Stop
    | Ready
    | StartFailed
    | Report
    | Selected
    | PlannedPath
    | AnyPreview
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


# --- the worker's sender

_QUEUED_LINES = 1000
_LONGEST_LINE = 2000
# Limit of merged track events, which bounds the memory if the service does not read.
_WAITING_EVENTS = 1000


class ResultSender:
    """Sends messages over `connection`, without blocking the worker's loop on a slow service.

    A result is sent at once from the thread that produced it: waking another thread takes longer than sending
    it. What the socket does not accept at once, and everything else, is sent by a separate thread.

    Of results and heartbeats only the newest waits; an older one is replaced and counted, but its track
    events (new, lost, end) are merged into the newer one. Everything else waits in a bounded queue. Only
    `close` blocks.

    Args:
        connection: its timeout is removed.
        on_lost: called once, in the sender's thread, when the other end is gone.
    """

    def __init__(self, connection: socket.socket, on_lost: Callable[[], None]) -> None:
        connection.settimeout(None)  # with a timeout, Python ignores MSG_DONTWAIT and waits
        self._connection = connection
        self._on_lost = on_lost
        self._changed = threading.Condition()
        self._queue: deque[Message] = deque(maxlen=_QUEUED_LINES)
        self._newest: Report | Heartbeat | None = None
        self._previews: dict[type, AnyPreview] = {}
        self._replaced = 0
        self._last: Message | None = None
        self._busy = False
        self._rest = b""
        self._thread = threading.Thread(target=self._run, name="perception sender", daemon=True)
        self._thread.start()

    def put(self, message: Message) -> None:
        """Send a message, in order with the others of its kind."""
        with self._changed:
            self._queue.append(message)
            self._changed.notify()

    def put_newest(self, message: Report | Heartbeat) -> None:
        """Send a message now, or as soon as possible unless a newer one replaces it.

        A heartbeat never replaces a result.
        """
        with self._changed:
            if isinstance(self._newest, Report):
                if isinstance(message, Heartbeat):
                    return
                self._replaced += 1
                message = _with_events_of(self._newest, message)
            self._newest = message
            if not self._send_newest():
                self._changed.notify()

    def put_preview(self, preview: AnyPreview) -> None:
        """Send a preview when nothing else waits, unless a newer one of its kind replaces it."""
        with self._changed:
            self._previews[type(preview)] = preview
            self._changed.notify()

    def close(self, last: Ended | StartFailed, timeout_s: float) -> None:
        """Send the queued messages and then `last`, for at most `timeout_s`."""
        with self._changed:
            self._last = last
            self._changed.notify()
        self._thread.join(timeout_s)

    def _send_newest(self) -> bool:
        """Send from the calling thread if nothing else is in progress; False if the sender's thread must."""
        if self._busy or self._rest or self._queue or self._last:
            return False
        message = self._take_newest()
        data = packed(message)
        try:
            sent = self._connection.send(data, socket.MSG_DONTWAIT)
        except OSError:  # full, or the other end is gone: left to the sender's thread
            self._newest = message
            return False
        self._rest = data[sent:]
        return not self._rest

    def _take_newest(self) -> Report | Heartbeat:
        newest, self._newest = self._newest, None
        assert newest is not None
        return replace(newest, replaced=self._replaced) if isinstance(newest, Report) else newest

    def _next(self) -> Message | bytes:
        """Wait for what to send next: a message, or the rest of one."""
        with self._changed:
            self._busy = False
            self._changed.wait_for(
                lambda: self._rest or self._queue or self._newest or self._previews or self._last
            )
            self._busy = True
            if self._rest:
                rest, self._rest = self._rest, b""
                return rest
            if self._queue:
                return self._queue.popleft()
            if self._newest is not None:
                return self._take_newest()
            if self._last is not None:
                return self._last
            return self._previews.pop(next(iter(self._previews)))

    def _run(self) -> None:
        try:
            message: Message | bytes = b""
            while not isinstance(message, Ended | StartFailed):
                message = self._next()
                self._connection.sendall(message if isinstance(message, bytes) else packed(message))
        except OSError:
            self._on_lost()


def _with_events_of(older: Report, newer: Report) -> Report:
    """Return the newer report with the older one's events, except updates."""
    once = tuple(event for event in older.result.track_events if event.kind is not TrackEventKind.UPDATE)
    if not once:
        return newer
    events = (once + newer.result.track_events)[-_WAITING_EVENTS:]
    return replace(newer, result=replace(newer.result, track_events=events))


class ResultLogHandler(logging.Handler):
    """Sends log records to the service; a traceback goes only to the worker's standard error."""

    def __init__(self, sender: ResultSender) -> None:
        super().__init__()
        self._sender = sender

    def emit(self, record: logging.LogRecord) -> None:
        try:
            text = redacted(" ".join(record.getMessage().split()))[:_LONGEST_LINE]
            self._sender.put(LogLine(record.levelno, record.name, text))
            if record.exc_info:
                lines = traceback.format_exception(record.exc_info[1])
                print(redacted("".join(lines)), end="", file=sys.stderr, flush=True)
        except Exception:  # a bad log call must not end perception; logging prints it to standard error
            self.handleError(record)
