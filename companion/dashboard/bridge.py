"""One vehicle's messages: keeps the newest of each topic and the newest image of each camera.

zenoh calls back on its own threads. Each message replaces the one before, so nothing grows, however slow the
readers are. Only what a browser shows is subscribed: the state while a stream is open, a camera's images
for two seconds after each request.
"""

from __future__ import annotations

import asyncio
import json
import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import zenoh

from companion.bus.client import image_of, subscribe_kept
from companion.bus.topics import (
    COMMAND_STATE,
    DETECTIONS,
    EVENTS,
    IMAGE,
    LARGEST_JSON_BYTES,
    ROOT,
    SETPOINT,
    STATUS,
    VEHICLE,
)
from companion.dashboard.merge import Sighting
from companion.host.peer_data import PeerDataError, copy_payload, parse_object

logger = logging.getLogger(__name__)

MAX_RATE_HZ = 15.0
"""Of images; those in between are dropped."""
MAX_CAMERAS, MAX_BOXES = 16, 200
MAX_TRACKS = 30
"""Of a vehicle, on the map."""
TRACK_SHOWN_S, MAX_SIGMA_M = 10.0, 1000.0
_LEASE_S = 2.0
_DISCOVERY_S = 2.0
_KEPT_EVENTS, _KEPT_FRAMES = 200, 32


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
        events: in the order of arrival. command_states: of all commands, likewise.
    """

    number: int
    topics: dict[str, str]
    ages_s: dict[str, float]
    events: list[dict[str, Any]]
    command_states: list[dict[str, Any]]


@dataclass(frozen=True, slots=True)
class CameraImage:
    """A JPEG and the boxes of the same frame.

    `about` is JSON-able: `sequence`, `captured_ns`, `annotated` (the boxes are also drawn in the image),
    `boxes` and `boxes_sequence` (that of another frame if this one was not processed). A box is left, top,
    right, bottom as fractions of the image, class name, confidence, track id, track state.
    """

    jpeg: bytes
    about: dict[str, Any]


@dataclass(slots=True)
class _Camera:
    """What is kept of one camera. `frames`: the newest detection messages."""

    frames: deque[dict[str, Any]] = field(default_factory=lambda: deque(maxlen=_KEPT_FRAMES))
    image: CameraImage | None = None
    due_s: float = 0.0
    lease_s: float = 0.0
    subscriber: Any = None
    arrived: asyncio.Event = field(default_factory=asyncio.Event)


@dataclass(slots=True)
class Link:
    """The connection to zenoh. `session` is None while there is none, and `problem` then says why.

    `on_command`: called in the loop with the vehicle of a command that was seen in its events.
    """

    session: zenoh.Session | None = None
    loop: asyncio.AbstractEventLoop | None = None
    problem: str = "connecting"
    on_command: Callable[[str], None] = lambda _vehicle: None


class Bridge:
    """One vehicle's state for the page."""

    def __init__(self, link: Link, vehicle: str) -> None:
        self.vehicle = vehicle
        self._link = link
        self._topics: dict[str, _Message] = {}
        # With their numbers in the order of arrival.
        self._events: deque[tuple[int, dict[str, Any]]] = deque(maxlen=_KEPT_EVENTS)
        self._command_states: deque[tuple[int, dict[str, Any]]] = deque(maxlen=_KEPT_EVENTS)
        self._lock = threading.Lock()
        self._number = 0
        self._cameras: dict[str, _Camera] = {}
        self._sightings: list[Sighting] = []
        self._sightings_s = 0.0
        self._state: dict[str, Any] = {}
        self._alive: bool | None = None
        self._subscribed_s = 0.0
        self._subscribers: list[Any] = []

    @property
    def alive(self) -> bool | None:
        """Whether the service's liveliness token is there; None while unknown."""
        if self._alive is None and self._subscribers and time.monotonic() > self._subscribed_s + _DISCOVERY_S:
            return False
        return self._alive

    def set_alive(self, alive: bool) -> None:
        """Note that the service's liveliness token has come or gone."""
        self._alive = alive

    def subscribe(self) -> None:
        """Subscribe to the state, if that is not done and there is a session."""
        session = self._link.session
        if session is None or self._subscribers:
            return
        keys = [topic.key(self.vehicle) for topic in (DETECTIONS, VEHICLE, SETPOINT)]
        for key in (*keys, DETECTIONS.key(self.vehicle, "*")):
            self._subscribers.append(session.declare_subscriber(key, self._on_state))
        for topic, receive in (
            (STATUS, self._on_state),
            (EVENTS, self._on_event),
            (COMMAND_STATE, self._on_command_state),
        ):
            self._subscribers.append(subscribe_kept(session, topic.key(self.vehicle), receive))
        self._subscribed_s = time.monotonic()

    def unsubscribe(self) -> None:
        """End what `subscribe` began."""
        undeclare(self._subscribers)

    def close(self) -> None:
        """End all subscriptions, those of images too."""
        self.unsubscribe()
        for camera in self._cameras.values():
            camera.lease_s = 0.0
        self.end_leases()

    @property
    def state(self) -> dict[str, Any]:
        """The newest message of the topic `vehicle`; empty without one."""
        return self._state

    def state_age_s(self) -> float | None:
        """Seconds since the newest message of the topic `vehicle`."""
        with self._lock:
            kept = self._topics.get(VEHICLE.name)
        return None if kept is None else time.monotonic() - kept.received_s

    def sightings(self) -> list[Sighting]:
        """Return the confirmed objects with a track and a position of the steering camera's newest frame."""
        with self._lock:
            return [] if time.monotonic() - self._sightings_s > TRACK_SHOWN_S else self._sightings

    async def image(self, camera: str, after: int, timeout_s: float) -> CameraImage | None:
        """Wait for an image of another frame than `after`; None if none comes. `camera`: "" is the first."""
        kept = self._camera(camera)
        session = self._link.session
        if kept is None or session is None:
            await asyncio.sleep(timeout_s)
            return None
        kept.lease_s = time.monotonic() + _LEASE_S + timeout_s
        if kept.subscriber is None:
            kept.image = None
            kept.subscriber = session.declare_subscriber(
                IMAGE.key(self.vehicle, camera or None), lambda sample: self._on_image(kept, sample)
            )
        try:
            async with asyncio.timeout(timeout_s):
                while kept.image is None or kept.image.about["sequence"] == after:
                    kept.arrived.clear()
                    await kept.arrived.wait()
        except TimeoutError:
            return None
        kept.lease_s = time.monotonic() + _LEASE_S
        return kept.image

    def news(self, after: int) -> News:
        """Return what came after a number."""
        now_s = time.monotonic()
        with self._lock:
            return News(
                number=self._number,
                topics={path: kept.text for path, kept in self._topics.items() if kept.number > after},
                ages_s={path: round(now_s - kept.received_s, 2) for path, kept in self._topics.items()},
                events=[event for number, event in self._events if number > after],
                command_states=[state for number, state in self._command_states if number > after],
            )

    def end_leases(self) -> None:
        """End the subscriptions of images that nobody has asked for."""
        for camera in self._cameras.values():
            if camera.subscriber is not None and time.monotonic() > camera.lease_s:
                undeclare([camera.subscriber])
                camera.subscriber = camera.image = None

    # --- on zenoh's threads

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
            if value.get("localization_error") is not None:  # the steering camera's
                found = _sightings(self.vehicle, value)
                with self._lock:
                    self._sightings, self._sightings_s = found, time.monotonic()
        elif path == VEHICLE.name:
            self._state = value
        text = json.dumps(value)
        with self._lock:
            self._number += 1
            self._topics[path] = _Message(text, self._number, time.monotonic())

    def _keep(self, kept: deque[tuple[int, dict[str, Any]]], value: dict[str, Any]) -> bool:
        """Append a message; False: it is one of those that the service keeps, and was received before."""
        with self._lock:
            if any(each == value for _, each in kept):
                return False
            self._number += 1
            kept.append((self._number, value))
            return True

    def _on_command_state(self, sample: zenoh.Sample) -> None:
        if (value := _json(sample)) is not None:
            self._keep(self._command_states, value)

    def _on_event(self, sample: zenoh.Sample) -> None:
        value = _json(sample)
        if value is None or not self._keep(self._events, value):
            return
        loop = self._link.loop
        if str(value.get("text")).startswith("command: ") and loop is not None and not loop.is_closed():
            loop.call_soon_threadsafe(self._link.on_command, self.vehicle)

    def _on_image(self, camera: _Camera, sample: zenoh.Sample) -> None:
        now_s = time.monotonic()
        # A camera's interval varies by some milliseconds.
        too_soon = now_s < camera.due_s - 0.2 / MAX_RATE_HZ
        if too_soon:
            return
        try:
            data, attachment = image_of(sample)
            about = {key: attachment.get(key) for key in ("sequence", "captured_ns", "annotated")}
            about |= _boxes(list(camera.frames), int(attachment["sequence"]))
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
            logger.debug("an image without usable attachment", exc_info=True)
            return
        camera.image = CameraImage(data, about)
        camera.due_s = max(camera.due_s + 1 / MAX_RATE_HZ, now_s)
        loop = self._link.loop
        if loop is not None and not loop.is_closed():
            loop.call_soon_threadsafe(camera.arrived.set)

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


def _sightings(vehicle: str, message: dict[str, Any]) -> list[Sighting]:
    """Return the objects of a message of detections, the newest seen; none if it is malformed."""
    try:
        known = [
            one
            for one in message["objects"][:MAX_BOXES]
            if one["confirmed"] and one["track_ids"] and one["latitude_deg"] is not None
        ]
        known.sort(key=lambda one: -int(one["last_ns"]))
        found = [
            Sighting(
                vehicle,
                int(one["track_ids"][-1]),
                str(one["class_name"]),
                float(one["latitude_deg"]),
                float(one["longitude_deg"]),
                (float(one["covariance"][0]), float(one["covariance"][1]), float(one["covariance"][5])),
            )
            for one in known[:MAX_TRACKS]
        ]
        return [one for one in found if _is_plausible(one)]
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, IndexError):
        logger.debug("a message with unusable detections", exc_info=True)
        return []


def _is_plausible(one: Sighting) -> bool:
    place = abs(one.latitude_deg) < 90.0 and abs(one.longitude_deg) <= 180.0
    north_m2, both_m2, east_m2 = one.covariance_m2
    error = 0.0 < north_m2 < MAX_SIGMA_M**2 and 0.0 < east_m2 < MAX_SIGMA_M**2
    return place and error and both_m2**2 < north_m2 * east_m2


def _json(sample: zenoh.Sample) -> dict[str, Any] | None:
    """Return a message's object; None if it is none, too large, or not strict JSON, which browsers need."""
    try:
        return parse_object(copy_payload(sample.payload, LARGEST_JSON_BYTES))
    except PeerDataError:
        return None


def undeclare(subscribers: list[Any]) -> None:
    """End subscriptions and forget them."""
    for subscriber in subscribers:
        subscriber.undeclare()
    subscribers.clear()
