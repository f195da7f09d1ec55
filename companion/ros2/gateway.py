"""From the bus to ROS: subscribes to a topic of the bus only while a sink wants what is made of it."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from threading import Lock
from typing import Any, Protocol

import zenoh

from companion.bus.client import message_of, subscribe_kept
from companion.bus.topics import RUN, STATUS
from companion.host.peer_data import parse_object
from companion.ros2.messages import Messages, RosTopic, ros_name, topic_name
from companion.settings import Settings, ZenohSection

# A status is younger than this where it is received. Its stamp is of another clock if it is not.
_STATUS_AGE_NS = 2_000_000_000
_THIS_HOST = re.compile(r"/(127\.|localhost|\[::1\])")
_WARN_INTERVAL_S = 10.0
# Of a text or a velocity.
LARGEST_REQUEST_BYTES = 64 * 1024
_STAMPS_KEPT = 512  # of some seconds: images come after their detections


def namespace_of(settings: Settings) -> str:
    """Return the namespace of a vehicle's topics, without an outer `/`; empty: none."""
    given = settings.ros2.namespace
    return ros_name(settings.vehicle.name) if given is None else given


OnSerialized = Callable[[str, str, memoryview, int, int], None]
"""(topic name, type name, CDR, received_ns, ros_now_ns): a message that a node received.

CDR is valid during the call only. `received_ns` is CLOCK_MONOTONIC, `ros_now_ns` ROS time of the same moment.
"""


@dataclass(frozen=True, slots=True)
class NodeTopic:
    """A topic that a node publishes, or, with `on_serialized`, subscribes to.

    Attributes:
        name: relative to the namespace, absolute, or of the node, as `~/result`.
        latched: transient local.
        reliable: else best effort. A subscription that is not reliable accepts all publishers.
        adapts: this subscription becomes reliable where all publishers are: large images need it. A velocity
            must not: after a gap of the network old ones would be sent again.
        largest_bytes: a larger message that is received is left out, before it is copied.
    """

    name: str
    type_name: str
    on_serialized: OnSerialized | None = None
    reliable: bool = True
    latched: bool = False
    depth: int = 10
    adapts: bool = False
    largest_bytes: int = LARGEST_REQUEST_BYTES

    @staticmethod
    def made_of(topic: RosTopic, camera: str | None) -> NodeTopic:
        """Return the topic to publish for one of the bus. `camera`: as of `topic_name`."""
        name, depth = topic_name(topic, camera), 1 if topic.latched else 10
        return NodeTopic(name, topic.type_name, None, topic.reliable, topic.latched, depth)


class ServiceClock:
    """ROS time of the stamps of a service: system time, or simulated time while there is one.

    Its stamps are CLOCK_MONOTONIC of its host. On this host the present difference to the system clock is
    used, which may be set meanwhile; of another host that at the start of its service. A frame of
    a camera of ROS has exactly the stamp of its image.

    Args:
        zenoh: settings of a client; the endpoint says whether the service may be on this host.
    """

    def __init__(self, zenoh: ZenohSection) -> None:
        self._may_be_here = all(map(_THIS_HOST.search, zenoh.connect))
        self._here = self._may_be_here
        self._there_ns: int | None = None  # Unix time minus CLOCK_MONOTONIC of the service
        self._simulated_ns: int | None = None  # simulated time minus CLOCK_MONOTONIC of this host
        self._given: dict[int, int] = {}
        self._of_images: dict[int, int] = {}

    def on_status(self, stamp_ns: int) -> None:
        """Process the stamp of a status, when it is received."""
        here = self._may_be_here and abs(time.monotonic_ns() - stamp_ns) < _STATUS_AGE_NS
        if here != self._here:
            self._here, self._given = here, {}

    def on_run(self, unix_offset_ns: int) -> None:
        """Process the difference of the clocks of the service's host."""
        if unix_offset_ns != self._there_ns:
            self._there_ns, self._given = unix_offset_ns, {}

    def on_ros_time(self, monotonic_ns: int, ros_ns: int, simulated: bool) -> None:
        """Process a reading of this host's CLOCK_MONOTONIC and of the clock of ROS."""
        offset_ns = ros_ns - monotonic_ns if simulated else None
        if (offset_ns is None) != (self._simulated_ns is None):
            self._given = {}
        self._simulated_ns = offset_ns

    def on_frame(self, captured_ns: int, ros_ns: int) -> None:
        """Process the stamp of an image of ROS that became a frame with this `captured_ns`, on this host."""
        _keep(self._of_images, captured_ns, ros_ns)

    def ros_time_ns(self, stamp_ns: int) -> int:
        """Return the ROS time of a stamp of the service, at least 0: always the same of the same stamp.

        So all messages about a frame have equal stamps, by which `message_filters` finds them.
        """
        given = self._of_images.get(stamp_ns, self._given.get(stamp_ns))
        if given is None:
            given = self._computed_ns(stamp_ns)
            _keep(self._given, stamp_ns, given)
        return given

    def _computed_ns(self, stamp_ns: int) -> int:
        offset_ns = _unix_offset_ns()
        if not self._here and self._there_ns is not None:
            stamp_ns += self._there_ns - offset_ns
        if self._simulated_ns is not None:
            offset_ns = self._simulated_ns
        return max(0, stamp_ns + offset_ns)


def _keep(stamps: dict[int, int], stamp_ns: int, ros_ns: int) -> None:
    stamps[stamp_ns] = ros_ns
    if len(stamps) > _STAMPS_KEPT:
        stamps.pop(next(iter(stamps)), None)


def _unix_offset_ns() -> int:
    return time.time_ns() - time.monotonic_ns()


class Losses:
    """Counts messages that cannot be used, and says why, at most every 10 s."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say, self._count, self._said_s = say, 0, -_WARN_INTERVAL_S

    def add(self, text: str) -> None:
        """Count a message: of another version, another program's, or too large."""
        self._count += 1
        if time.monotonic() - self._said_s >= _WARN_INTERVAL_S:
            more = f" ({self._count - 1} more before)" if self._count > 1 else ""
            self._said_s, self._count = time.monotonic(), 0
            self._say(f"message left out: {' '.join(text.split())[:200]}{more}")


class Sink(Protocol):
    """Where CDR goes: the node, or nodes with rmw_zenoh."""

    def publish(self, name: str, topic: RosTopic, payload: bytes) -> None:
        """Publish, from any thread. `name`: of `topic_name`."""
        ...


class Gateway:
    """Converts the messages of one vehicle that sinks want. All methods may be called from any thread.

    Args:
        say: called with a line, at most every 10 s, on messages that cannot be converted.
    """

    def __init__(
        self, session: zenoh.Session, vehicle: str, messages: Messages, say: Callable[[str], None]
    ) -> None:
        self._session, self._vehicle, self._messages = session, vehicle, messages
        # Of each topic of the bus: what is made of it, and the sinks of that.
        self._wanted: dict[tuple[str, str | None], list[tuple[Sink, RosTopic]]] = {}
        self._subscribers: dict[tuple[str, str | None], Any] = {}
        self._lock, self._converting = Lock(), Lock()
        self._losses = Losses(say)

    def want(self, sink: Sink, topic: RosTopic, camera: str | None, wanted: bool) -> None:
        """Begin or end a topic for a sink. `camera`: None for the first, and for topics of no camera."""
        key = topic.source.name, camera
        with self._lock:
            users = self._wanted.setdefault(key, [])
            if ((sink, topic) in users) == wanted:
                return
            if wanted:
                users.append((sink, topic))
            else:
                users.remove((sink, topic))
            ended = None if users else self._subscribers.pop(key, None)
            if users and key not in self._subscribers:
                subscribe = subscribe_kept if topic.source.cached else zenoh.Session.declare_subscriber
                path = topic.source.key(self._vehicle, camera)
                receive = partial(self._on_sample, topic, camera)
                self._subscribers[key] = subscribe(self._session, path, receive)
        if ended is not None:
            ended.undeclare()

    def close(self) -> None:
        """End all subscriptions."""
        with self._lock:
            ended = list(self._subscribers.values())
            self._subscribers.clear()
            self._wanted.clear()
        for subscriber in ended:
            subscriber.undeclare()

    def _on_sample(self, first: RosTopic, camera: str | None, sample: zenoh.Sample) -> None:
        users = tuple(self._wanted.get((first.source.name, camera), ()))
        try:
            payload, attachment = message_of(sample, first.source)
        except (ValueError, KeyError, TypeError) as error:
            self._losses.add(f"{first.source.path(camera)}: {error}")
            return
        made: dict[str, bytes | None] = {}
        with self._converting:
            for _, topic in users:
                if topic.name in made:
                    continue
                try:
                    made[topic.name] = self._messages.convert(topic, camera, payload, attachment)
                except ValueError as error:
                    made[topic.name] = None
                    self._losses.add(f"{first.source.path(camera)}: {error}")
        for sink, topic in users:
            if (cdr := made[topic.name]) is not None:
                sink.publish(topic_name(topic, camera), topic, cdr)


def follow_service(
    session: zenoh.Session, vehicle: str, clock: ServiceClock, on_cameras: Callable[[list[str]], None]
) -> list[Any]:
    """Keep the clock, and call back with the names of the further cameras, as the service is seen.

    Returns:
        Subscribers, to be kept meanwhile.
    """

    def on_status(sample: zenoh.Sample) -> None:
        with suppress(ValueError, KeyError, TypeError):  # of another version
            status = parse_object(message_of(sample, STATUS)[0])
            clock.on_status(status["stamp_ns"])
            on_cameras(list(status["cameras"]))

    def on_run(sample: zenoh.Sample) -> None:
        with suppress(ValueError, KeyError, TypeError):
            clock.on_run(int(parse_object(message_of(sample, RUN)[0])["unix_offset_ns"]))

    return [
        subscribe_kept(session, STATUS.key(vehicle), on_status),
        session.declare_subscriber(RUN.key(vehicle), on_run),
    ]
