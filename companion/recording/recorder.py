"""The recorder: a client of the bus that writes everything of one vehicle to MCAP files."""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from threading import Event, Lock
from typing import Any

import zenoh
from typing_extensions import TypedDict

from companion.bus.child_client import PAUSED
from companion.bus.client import message_of, open_client, subscribe_kept
from companion.bus.topics import CLOUD, DEPTH_IMAGE, IMAGE, MAVLINK, RECORDER_TOPICS, ROOT, TOPICS, Topic
from companion.host.peer_data import PeerDataError
from companion.host.scheduling import lower_priority
from companion.recording import RECORDED, RECORDING, RecordingError
from companion.recording.convert import RECORDER_CHANNEL, RUN_CHANNEL, Converter, stored_schema
from companion.recording.files import FLUSH_S, Channel, Recorded, RecordingWriter
from companion.settings import ZenohSection

# The service and its perception have priority.
_NICER = 10
MAX_WAITING, MAX_WAITING_BYTES = 10_000, 512 * 1024 * 1024
_POLL_S = 0.05
# The last messages of a service that ends may still arrive.
_LAST_S = 0.3
# Then the next file begins.
MAX_FILE_S = 3600.0
# A disk with space again, or a folder that has come, is used within this time.
RETRY_S = 10.0


class LossesBody(TypedDict):
    """What was lost on the way to the file, since the recorder began."""

    first_step: int | None
    lost_steps: int
    lost_link_pieces: int
    dropped_messages: int
    dropped_images: int
    unread_messages: int


_LOSSES = Channel(RECORDER_CHANNEL, f"companion.{RECORDER_CHANNEL}", stored_schema(LossesBody))


@dataclass(frozen=True, slots=True)
class RecorderOptions:
    """What to record, and where.

    Attributes:
        zenoh: settings of a client. vehicle: its name in the keys.
        images, depth, clouds: record the preview images, the depth images, the point clouds too.
        frames: path of a camera's topic `image` → shared memory with its processed frames, which are recorded
            as PNG, and with their depth, instead of those of the preview; empty: none.
    """

    zenoh: ZenohSection
    vehicle: str
    directory: str
    images: bool
    depth: bool
    clouds: bool
    max_file_mb: int
    max_total_mb: int
    frames: Mapping[str, str] = field(default_factory=dict)


class Recorder:
    """Converts and writes messages. Messages may be added from any thread.

    Attributes:
        dropped_images: PNG images that were not encoded, because encoding or writing was late.
    """

    def __init__(self, options: RecorderOptions) -> None:
        self._writer = RecordingWriter(
            Path(options.directory),
            options.vehicle,
            max_bytes=options.max_file_mb * 1_000_000,
            max_duration_s=MAX_FILE_S,
            max_total_bytes=options.max_total_mb * 1_000_000,
        )
        self._converter = Converter(options.vehicle)
        self._waiting: deque[tuple[str, bytes, bytes | None]] = deque()
        self._added = self._taken = self._unread = self._too_large = 0
        self._lock, self._waiting_bytes = Lock(), 0
        self.dropped_images = 0
        self._noted: LossesBody | None = None
        self._flush_due_s = 0.0

    @property
    def path(self) -> Path:
        """The current file."""
        return self._writer.path

    @property
    def late(self) -> bool:
        """Whether so much waits that images are left out."""
        return len(self._waiting) > MAX_WAITING // 10

    def add(self, path: str, payload: bytes, attachment: bytes | None) -> None:
        """Queue a message; if the writer is late, the oldest are dropped."""
        with self._lock:
            self._added += 1
            self._waiting.append((path, payload, attachment))
            self._waiting_bytes += len(payload)
            while len(self._waiting) > MAX_WAITING or self._waiting_bytes > MAX_WAITING_BYTES:
                self._waiting_bytes -= len(self._waiting.popleft()[1])

    def count_too_large(self) -> None:
        """Count a message that was not copied, as one that could not be read."""
        with self._lock:
            self._too_large += 1

    def write(self) -> None:
        """Write what is queued. Raises RecordingError."""
        for _ in range(len(self._waiting)):
            with self._lock:
                if not self._waiting:
                    break  # dropped meanwhile
                path, payload, attachment = self._waiting.popleft()
                self._waiting_bytes -= len(payload)
                self._taken += 1
            try:
                messages = list(self._converter.convert(path, payload, attachment))
            except (ValueError, KeyError, TypeError):
                self._unread += 1  # of another version, or another program's
                continue
            for message in messages:
                self._write(message)
        if time.monotonic() >= self._flush_due_s:
            self._flush_due_s = time.monotonic() + FLUSH_S
            self._note_losses()
            self._writer.flush()

    def _write(self, message: Recorded) -> None:
        begins = self._writer.begins
        if message.channel.topic != RUN_CHANNEL:
            self._writer.write(*message)
        elif RUN_CHANNEL not in begins or begins[RUN_CHANNEL].data != message.data:
            # Else it is repeated, as each second, for recorders that begin later.
            restarted = RUN_CHANNEL in begins
            begins[RUN_CHANNEL] = message
            if restarted:
                self._writer.begin_next()
            else:
                self._writer.write(*message)

    def close(self) -> None:
        """Write the rest and end the file. Raises RecordingError."""
        self._flush_due_s = 0.0
        self.write()
        self._writer.close()

    def _note_losses(self) -> None:
        """Write what was lost, as it changes: a recording with a gap says so."""
        with self._lock:
            dropped = self._added - self._taken - len(self._waiting)
        note: LossesBody = {
            "first_step": self._converter.first_step,
            "lost_steps": self._converter.lost_steps,
            "lost_link_pieces": self._converter.lost_pieces,
            "dropped_messages": dropped,
            "dropped_images": self.dropped_images,
            "unread_messages": self._unread + self._too_large,
        }
        if note != self._noted:
            self._noted = note
            self._writer.write(_LOSSES, time.time_ns(), json.dumps(note).encode())


def topics_of(options: RecorderOptions) -> list[Topic]:
    """Return the topics to subscribe to; the one that says that a recorder listens is the last."""
    wanted = {
        IMAGE.name: options.images and not options.frames,
        DEPTH_IMAGE.name: options.depth and not options.frames,
        CLOUD.name: options.clouds,
    }
    topics = [topic for topic in TOPICS if wanted.get(topic.name, True)]
    return [*topics, *(topic for topic in RECORDER_TOPICS if topic is not MAVLINK), MAVLINK]


def subscribe_all(
    session: zenoh.Session,
    vehicle: str,
    topics: Sequence[Topic],
    receive: Callable[[Topic, zenoh.Sample], None],
) -> list[Any]:
    """Subscribe to topics of all cameras; those with kept messages begin with them."""
    subscribers: list[Any] = []
    for topic in topics:
        for view in (None, "*") if topic.of_camera else (None,):
            key = topic.key(vehicle, view)
            subscribe = subscribe_kept if topic.cached else zenoh.Session.declare_subscriber
            subscribers.append(subscribe(session, key, partial(receive, topic)))
    return subscribers


def record(
    options: RecorderOptions, ending: Event, say: Callable[[str], None], *, patient: bool = False
) -> None:
    """Record until `ending` is set. While nothing can be written it pauses; then it begins a new file.

    Args:
        say: called with each file's path at its begin and at its end, and with why it pauses.
        patient: it also waits for the first file.

    Raises:
        RecordingError: the first file cannot be written. NoAnswerError: no service at the endpoint.
    """
    lower_priority(_NICER)
    said: str | None = None
    with open_client(options.zenoh, timeout_s=10.0) as session:
        while not ending.is_set():
            try:
                recorder = Recorder(options)
                said, patient = None, True
                _write_until(ending, recorder, session, options, say)
            except RecordingError as error:
                if not patient:
                    raise
                if str(error) != said:
                    say(f"{PAUSED}{error}; tried again every {RETRY_S:g} s")
                said = str(error)
                ending.wait(RETRY_S)


def _write_until(
    ending: Event,
    recorder: Recorder,
    session: zenoh.Session,
    options: RecorderOptions,
    say: Callable[[str], None],
) -> None:
    """Write what arrives until `ending` is set. Raises RecordingError."""
    prefix = f"{ROOT}/{options.vehicle}/"

    def receive(topic: Topic, sample: zenoh.Sample) -> None:
        try:
            payload, attachment = message_of(sample, topic)
        except PeerDataError:
            recorder.count_too_large()
            return
        recorder.add(str(sample.key_expr).removeprefix(prefix), payload, attachment)

    with ExitStack() as stack:
        for subscriber in subscribe_all(session, options.vehicle, topics_of(options), receive):
            stack.callback(subscriber.undeclare)
        with ExitStack() as encoding:
            if options.frames:
                from companion.recording.lossless import FrameEncoder  # OpenCV is not loaded without

                encoding.callback(FrameEncoder(options.frames, recorder).close)
            say(f"{RECORDING}{recorder.path}")
            while not ending.wait(_POLL_S):
                recorder.write()
        time.sleep(_LAST_S)
    recorder.close()
    say(f"{RECORDED}{recorder.path}")
