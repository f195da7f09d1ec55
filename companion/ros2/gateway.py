"""From the bus to ROS: subscribes to a topic of the bus only while a node wants what is made of it."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from threading import Lock
from typing import Any, Protocol

import zenoh

from companion.bus.client import message_of, subscribe_kept
from companion.bus.topics import LARGE_TOPICS, Topic
from companion.host.clock import unix_offset_ns
from companion.ros2.messages import OUTPUT_TOPICS, Messages, RosTopic, topic_name

_SAID_INTERVAL_S = 60.0
# Of a text or a velocity.
LARGEST_REQUEST_BYTES = 64 * 1024
_STAMPS_KEPT = 512  # of some seconds: images come after their detections
_SAME_CLOCK_NS = 1_000_000  # two readings of one pair of clocks differ by less

OnSerialized = Callable[[str, str, memoryview, int, int, int], None]
"""(topic name, type name, CDR, received_ns, ros_now_ns, age_ns): a message that a node received.

CDR is valid during the call only. `received_ns` is CLOCK_MONOTONIC, `ros_now_ns` ROS time of the same moment,
`age_ns` the time since it was sent, by the system clocks of both computers; 0: not known.
"""


@dataclass(frozen=True, slots=True)
class NodeTopic:
    """A topic that a node publishes, or, with `on_serialized`, subscribes to.

    Attributes:
        name: relative to the namespace, absolute, or of the node, as `~/result`.
        on_wanted: called, from any thread, with whether a published topic has a subscriber now.
        latched: transient local.
        reliable: else best effort. A subscription that is not reliable accepts all publishers.
        adapts: this subscription becomes reliable where all publishers are: large images need it. A velocity
            must not: after a gap of the network old ones would be sent again.
        largest_bytes: a larger message that is received is left out, before it is copied.
        other_type: is received too. A topic of DDS has one type in a program: that of its publishers is used.
    """

    name: str
    type_name: str
    on_serialized: OnSerialized | None = None
    on_wanted: Callable[[bool], None] | None = None
    reliable: bool = True
    latched: bool = False
    depth: int = 10
    adapts: bool = False
    largest_bytes: int = LARGEST_REQUEST_BYTES
    other_type: str | None = None


class ServiceClock:
    """ROS time of the stamps of a service: system time, or simulated time while there is one.

    Its stamps are CLOCK_MONOTONIC of its host. Where that is this one, a system clock that is set has effect
    at once, else with the next status, which comes once a second. A stamp that has a ROS time keeps it. A
    frame of a camera of ROS has exactly the stamp of its image.
    """

    def __init__(self) -> None:
        self._ahead_ns = 0  # CLOCK_MONOTONIC of this host minus that of the service's
        self._simulated_ns: int | None = None  # simulated time minus CLOCK_MONOTONIC of this host
        self._given: dict[int, int] = {}
        self._of_images: dict[int, int] = {}

    def on_status(self, service_offset_ns: int) -> None:
        """Process `unix_offset_ns` of a status, when it is received."""
        ahead_ns = service_offset_ns - unix_offset_ns()
        self._ahead_ns = 0 if abs(ahead_ns) < _SAME_CLOCK_NS else ahead_ns

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
            offset_ns = unix_offset_ns() if self._simulated_ns is None else self._simulated_ns
            given = max(0, stamp_ns + self._ahead_ns + offset_ns)
            _keep(self._given, stamp_ns, given)
        return given


def _keep(stamps: dict[int, int], stamp_ns: int, ros_ns: int) -> None:
    stamps[stamp_ns] = ros_ns
    if len(stamps) > _STAMPS_KEPT:
        stamps.pop(next(iter(stamps)), None)


class Losses:
    """Counts messages that cannot be used as they are, and says why: the first of a kind, then once a minute.

    Attributes:
        counts: by kind.
    """

    def __init__(self, say: Callable[[str], None]) -> None:
        self.counts: Counter[str] = Counter()
        self._say = say
        self._said: dict[str, tuple[float, int]] = {}  # when, and of how many

    def add(self, kind: str, text: str) -> None:
        """Count a message: of another version, another program's, too large, too old."""
        self.counts[kind] += 1
        said_s, said = self._said.get(kind, (-_SAID_INTERVAL_S, 0))
        if time.monotonic() - said_s >= _SAID_INTERVAL_S:
            before = self.counts[kind] - said - 1
            self._said[kind] = time.monotonic(), self.counts[kind]
            more = f" ({before} more before)" if before else ""
            self._say(f"{' '.join(text.split())[:300]}{more}")


class Node(Protocol):
    """Where CDR goes: the node of rclpy, or one on zenoh."""

    def declare(self, *topics: NodeTopic) -> None:
        """Publish topics, or subscribe to them. One that is declared already stays as it is."""
        ...

    def send(self, name: str, payload: bytes) -> None:
        """Publish on a declared topic, from any thread. `name`: of its `NodeTopic`."""
        ...


class Gateway:
    """Converts the messages of one vehicle that nodes want. All methods may be called from any thread.

    Args:
        say: called with a line on messages that cannot be converted, as by `Losses`.
    """

    def __init__(
        self,
        session: zenoh.Session,
        vehicle: str,
        messages: Messages,
        nodes: Sequence[Node],
        say: Callable[[str], None],
    ) -> None:
        self._session, self._vehicle, self._messages, self._nodes = session, vehicle, messages, nodes
        # Both are replaced, never changed: zenoh's threads read them without the lock.
        self._offered: tuple[tuple[str, RosTopic, Topic, str | None], ...] = ()  # name in a node, …, camera
        self._wanted: frozenset[tuple[Node, str]] = frozenset()
        self._subscribers: dict[str, Any] = {}  # by the path of the bus's topic
        self._lock, self._converting = Lock(), Lock()
        self._losses = Losses(say)

    def offer(self, camera: str | None) -> None:
        """Publish, while a node wants it, what is made of a further camera; None: everything else."""
        topics = [topic for topic in OUTPUT_TOPICS if camera is None or topic.source.of_camera]
        names = [topic_name(topic, camera) for topic in topics]
        with self._lock:
            self._offered += tuple(
                (name, topic, source, camera)
                for name, topic in zip(names, topics, strict=True)
                for source in topic.sources(camera)
            )
        for node in self._nodes:
            node.declare(
                *(
                    NodeTopic(
                        name,
                        topic.type_name,
                        on_wanted=partial(self._on_wanted, node, name),
                        reliable=topic.reliable,
                        latched=topic.latched,
                        depth=1 if topic.latched else 10,
                    )
                    for name, topic in zip(names, topics, strict=True)
                )
            )
        self._follow()  # a topic of all cameras may be wanted already

    def close(self) -> None:
        """End all subscriptions."""
        with self._lock:
            self._offered = ()
        self._follow()

    def _on_wanted(self, node: Node, name: str, wanted: bool) -> None:
        with self._lock:
            change = {(node, name)}
            self._wanted = self._wanted | change if wanted else self._wanted - change
        self._follow()

    def _follow(self) -> None:
        """Subscribe to what wanted topics are made of, and to nothing else."""
        with self._lock:
            names = {name for _, name in self._wanted}
            wanted = {
                source.path(camera): (source, camera)
                for name, topic, source, camera in self._offered
                if name in names and not (source is topic.also and source in LARGE_TOPICS)
            }
            ended = [self._subscribers.pop(path) for path in self._subscribers.keys() - wanted.keys()]
            for path in wanted.keys() - self._subscribers.keys():
                source, camera = wanted[path]
                subscribe = subscribe_kept if source.cached else zenoh.Session.declare_subscriber
                receive = partial(self._on_sample, source, camera)
                self._subscribers[path] = subscribe(self._session, source.key(self._vehicle, camera), receive)
        for subscriber in ended:
            subscriber.undeclare()

    def _on_sample(self, source: Topic, camera: str | None, sample: zenoh.Sample) -> None:
        wanted, path = self._wanted, source.path(camera)
        try:
            payload, attachment = message_of(sample, source)
        except (ValueError, KeyError, TypeError) as error:
            self._losses.add(path, f"{path}: message left out: {error}")
            return
        made = []
        with self._converting:
            for name, topic, made_of, of_camera in self._offered:
                nodes = [node for node in self._nodes if (node, name) in wanted]
                if not nodes or made_of is not source or of_camera != camera:
                    continue
                try:
                    cdr = self._messages.convert(topic, camera, payload, attachment, source)
                except ValueError as error:
                    self._losses.add(name, f"{path}: message left out: {error}")
                else:
                    made += [(node, name, cdr) for node in nodes if cdr is not None]
        for node, name, cdr in made:
            node.send(name, cdr)
