"""The zenoh side: keeps the newest message of each topic and the newest picture of each camera.

zenoh calls back on its own threads. Each message replaces the one before, so nothing grows, however slow the
readers are. Only what a browser shows is subscribed: the state while a stream is open, a camera's pictures
for two seconds after each request.
"""

from __future__ import annotations

import asyncio
import json
import logging
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import zenoh

from companion.bus.client import NoAnswerError, send_command, subscribe_kept
from companion.bus.session import zenoh_config
from companion.bus.topics import DETECTIONS, EVENTS, IMAGE, ROOT, SETPOINT, STATUS, VEHICLE, alive_key
from companion.settings import ZenohSection

logger = logging.getLogger(__name__)

LARGEST_JSON_BYTES, LARGEST_PICTURE_BYTES = 1 << 18, 1 << 23
MAX_RATE_HZ = 15.0
"""Of pictures; those in between are dropped."""
MAX_CAMERAS, MAX_BOXES = 16, 200
MAX_COMMANDS = 32
"""Commands that wait for their outcome; `stop` has a separate allowance of the same size."""
_LEASE_S = 2.0
_RETRY_S = 1.0
_DISCOVERY_S = 2.0
_KEPT_EVENTS, _KEPT_REPLIES, _KEPT_FRAMES = 200, 50, 32
_COMMAND_TIMEOUT_S = 3600.0


@dataclass(frozen=True, slots=True)
class _Message:
    """The newest message of a topic: JSON text, its number in the order of arrival, and when it arrived."""

    text: str
    number: int
    received_s: float


@dataclass(frozen=True, slots=True)
class News:
    """What came after a number.

    Attributes:
        number: the newest. topics: path → JSON text of the newest message, if it is new.
        ages_s: path → seconds since the newest message arrived, of all topics.
        events, replies: in the order of arrival.
    """

    number: int
    topics: dict[str, str]
    ages_s: dict[str, float]
    events: list[dict[str, Any]]
    replies: list[dict[str, Any]]


@dataclass(frozen=True, slots=True)
class Picture:
    """A JPEG and the boxes of the same frame.

    `about` is JSON-able: `sequence`, `captured_ns`, `annotated` (the boxes are also drawn in the picture),
    `boxes` and `boxes_sequence` (that of another frame if this one was not processed). A box is left, top,
    right, bottom as fractions of the picture, class name, confidence, track id, track state.
    """

    jpeg: bytes
    about: dict[str, Any]


@dataclass(slots=True)
class _Camera:
    """What is kept of one camera. `frames`: the newest detection messages."""

    frames: deque[dict[str, Any]] = field(default_factory=lambda: deque(maxlen=_KEPT_FRAMES))
    picture: Picture | None = None
    received_s: float = 0.0
    lease_s: float = 0.0
    subscriber: Any = None
    arrived: asyncio.Event = field(default_factory=asyncio.Event)


class Bridge:
    """One vehicle's state for the page, and its commands.

    Args:
        settings: of a zenoh client.

    Attributes:
        problem: why there is no connection to zenoh; empty if there is one.
    """

    def __init__(self, settings: ZenohSection, vehicle: str) -> None:
        self.vehicle = vehicle
        self.problem = "connecting"
        self._settings = settings
        self._topics: dict[str, _Message] = {}
        # With their numbers in the order of arrival.
        self._events: deque[tuple[int, dict[str, Any]]] = deque(maxlen=_KEPT_EVENTS)
        self._replies: deque[tuple[int, dict[str, Any]]] = deque(maxlen=_KEPT_REPLIES)
        self._session: zenoh.Session | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._lock = threading.Lock()
        self._number = 0
        self._cameras: dict[str, _Camera] = {}
        self._alive: bool | None = None
        self._watchers, self._subscribed_s = 0, 0.0
        self._subscribers: list[Any] = []
        self._waiting = {True: 0, False: 0}

    async def run(self) -> None:
        """Connect, and end what nobody watches any more; until cancelled."""
        self._loop = asyncio.get_running_loop()
        try:
            while True:
                if self._session is None:
                    await self._connect()
                else:
                    self._watch_link(self._session)
                    self._end_leases()
                await asyncio.sleep(_RETRY_S)
        finally:
            session, self._session = self._session, None
            if session is not None:
                await asyncio.to_thread(session.close)

    @property
    def alive(self) -> bool | None:
        """Whether the service's liveliness token is there; None while unknown."""
        if self._alive is None and self._subscribers and time.monotonic() > self._subscribed_s + _DISCOVERY_S:
            return False
        return self._alive

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Subscribe to the state meanwhile."""
        self._watchers += 1
        self._subscribe()
        try:
            yield
        finally:
            self._watchers -= 1
            if not self._watchers:
                _undeclare(self._subscribers)
                self._alive = None

    async def picture(self, camera: str, after: int, timeout_s: float) -> Picture | None:
        """Wait for a picture of another frame than `after`; None if none comes. `camera`: "" is the first."""
        kept = self._camera(camera)
        if kept is None or self._session is None:
            await asyncio.sleep(timeout_s)
            return None
        kept.lease_s = time.monotonic() + _LEASE_S + timeout_s
        if kept.subscriber is None:
            kept.picture = None
            kept.subscriber = self._session.declare_subscriber(
                IMAGE.key(self.vehicle, camera or None), lambda sample: self._on_image(kept, sample)
            )
        try:
            async with asyncio.timeout(timeout_s):
                while kept.picture is None or kept.picture.about["sequence"] == after:
                    kept.arrived.clear()
                    await kept.arrived.wait()
        except TimeoutError:
            return None
        kept.lease_s = time.monotonic() + _LEASE_S
        return kept.picture

    def news(self, after: int) -> News:
        """Return what came after a number."""
        now_s = time.monotonic()
        with self._lock:
            return News(
                number=self._number,
                topics={path: kept.text for path, kept in self._topics.items() if kept.number > after},
                ages_s={path: round(now_s - kept.received_s, 2) for path, kept in self._topics.items()},
                events=[event for number, event in self._events if number > after],
                replies=[reply for number, reply in self._replies if number > after],
            )

    def command(self, text: str, identifier: str) -> asyncio.Future[dict[str, Any]] | None:
        """Send a command; the outcome is also added to `replies`. None: too many are waiting."""
        assert self._loop is not None
        stop = text.strip().lower() == "stop"
        if self._waiting[stop] >= MAX_COMMANDS:
            return None
        self._waiting[stop] += 1
        outcome: asyncio.Future[dict[str, Any]] = self._loop.create_future()
        # A thread each: a pool would let endless commands delay a stop.
        threading.Thread(
            target=self._send, args=(self._loop, text, identifier, stop, outcome), daemon=True
        ).start()
        return outcome

    def _send(
        self,
        loop: asyncio.AbstractEventLoop,
        text: str,
        identifier: str,
        stop: bool,
        outcome: asyncio.Future[dict[str, Any]],
    ) -> None:
        session = self._session
        try:
            if session is None:
                raise NoAnswerError(self.problem)
            reply = send_command(session, self.vehicle, text, timeout_s=_COMMAND_TIMEOUT_S)
        except (NoAnswerError, ValueError, zenoh.ZError) as error:
            reply = {"success": False, "reason": str(error).partition("\n")[0]}

        def finish() -> None:
            self._waiting[stop] -= 1
            answer = {**reply, "id": identifier, "command": text[:200]}
            with self._lock:
                self._number += 1
                self._replies.append((self._number, answer))
            outcome.set_result(answer)

        if not loop.is_closed():
            loop.call_soon_threadsafe(finish)

    async def _connect(self) -> None:
        try:
            self._session = await asyncio.to_thread(zenoh.open, zenoh_config(self._settings))
        except zenoh.ZError:
            self.problem = (
                f"no zenoh node at {', '.join(self._settings.connect)}: is `companion run` running?"
            )
            return
        self.problem = ""
        self._subscribe()

    def _watch_link(self, session: zenoh.Session) -> None:
        """Note a lost connection; zenoh itself connects again."""
        linked = bool(list(session.info.routers_zid()) or list(session.info.peers_zid()))
        self.problem = "" if linked else f"connection to {', '.join(self._settings.connect)} lost, retrying"

    def _subscribe(self) -> None:
        session = self._session
        if session is None or not self._watchers or self._subscribers:
            return
        keys = [topic.key(self.vehicle) for topic in (DETECTIONS, VEHICLE, SETPOINT)]
        for key in (*keys, DETECTIONS.key(self.vehicle, "*")):
            self._subscribers.append(session.declare_subscriber(key, self._on_state))
        for topic, receive in ((STATUS, self._on_state), (EVENTS, self._on_event)):
            self._subscribers.append(subscribe_kept(session, topic.key(self.vehicle), receive))
        self._subscribed_s = time.monotonic()
        alive = session.liveliness().declare_subscriber(alive_key(self.vehicle), self._on_alive, history=True)
        self._subscribers.append(alive)

    def _end_leases(self) -> None:
        for camera in self._cameras.values():
            if camera.subscriber is not None and time.monotonic() > camera.lease_s:
                _undeclare([camera.subscriber])
                camera.subscriber = camera.picture = None

    # --- on zenoh's threads

    def _on_alive(self, sample: zenoh.Sample) -> None:
        self._alive = sample.kind == zenoh.SampleKind.PUT

    def _on_state(self, sample: zenoh.Sample) -> None:
        value = _json(sample)
        if value is None:
            return
        path = str(sample.key_expr).removeprefix(f"{ROOT}/{self.vehicle}/")
        if path.endswith(DETECTIONS.name):
            camera = self._camera(path.removesuffix(DETECTIONS.name).removeprefix("cameras").strip("/"))
            if camera is None or not isinstance(value.get("sequence"), int):
                return
            camera.frames.append(value)
        text = json.dumps(value)
        with self._lock:
            self._number += 1
            self._topics[path] = _Message(text, self._number, time.monotonic())

    def _on_event(self, sample: zenoh.Sample) -> None:
        value = _json(sample)
        if value is None:
            return
        with self._lock:
            if any(event == value for _, event in self._events):
                return  # kept by the service, and received before
            self._number += 1
            self._events.append((self._number, value))

    def _on_image(self, camera: _Camera, sample: zenoh.Sample) -> None:
        now_s = time.monotonic()
        # A camera's interval varies by some milliseconds.
        too_soon = now_s - camera.received_s < 0.8 / MAX_RATE_HZ
        if too_soon or len(sample.payload) > LARGEST_PICTURE_BYTES:
            return
        try:
            attachment = json.loads(sample.attachment.to_string()) if sample.attachment else {}
            about = {key: attachment.get(key) for key in ("sequence", "captured_ns", "annotated")}
            about |= _boxes(list(camera.frames), int(attachment["sequence"]))
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
            logger.debug("an image without usable attachment", exc_info=True)
            return
        camera.picture, camera.received_s = Picture(sample.payload.to_bytes(), about), now_s
        if self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(camera.arrived.set)

    def _camera(self, name: str) -> _Camera | None:
        """Return what is kept of a camera; None for one more than `MAX_CAMERAS`."""
        with self._lock:
            if name not in self._cameras and len(self._cameras) < MAX_CAMERAS:
                self._cameras[name] = _Camera()
            return self._cameras.get(name)


def _boxes(frames: list[dict[str, Any]], sequence: int) -> dict[str, Any]:
    """Return the boxes of a frame; if it was not processed, those of the one before it."""
    earlier = [frame for frame in frames if frame["sequence"] <= sequence]
    if not earlier:
        return {"boxes": [], "boxes_sequence": None}
    frame = max(earlier, key=lambda one: int(one["sequence"]))
    scale = (frame["width"], frame["height"]) * 2
    boxes = [
        [
            *(round(value / size, 4) for value, size in zip(found["xyxy"], scale, strict=True)),
            *(found.get(key) for key in ("class_name", "confidence", "track_id", "track_state")),
        ]
        for found in frame["detections"][:MAX_BOXES]
    ]
    return {"boxes": boxes, "boxes_sequence": frame["sequence"]}


def _json(sample: zenoh.Sample) -> dict[str, Any] | None:
    """Return a message's object; None if it is none, too large, or not strict JSON."""
    if len(sample.payload) > LARGEST_JSON_BYTES:
        return None

    def refuse(constant: str) -> None:
        raise ValueError(constant)  # NaN and Infinity, which browsers do not read

    try:
        value = json.loads(sample.payload.to_bytes(), parse_constant=refuse)
    except (ValueError, RecursionError):
        return None
    return value if isinstance(value, dict) else None


def _undeclare(subscribers: list[Any]) -> None:
    for subscriber in subscribers:
        subscriber.undeclare()
    subscribers.clear()
