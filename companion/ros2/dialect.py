"""ROS 2 over zenoh, for boards without ROS: CDR under the keys of two others.

* `rmw_zenoh_cpp` of Jazzy and later (ros2/rmw_zenoh, `docs/design.md`): a key has the topic's type and its
  hash, each sample an attachment, and liveliness tokens are the graph of `ros2 topic list`.
* `zenoh-bridge-ros2dds`: a key is the topic's name alone; the bridge's configuration says what it passes on.

Both have a zenoh router, such as `ros2 run rmw_zenoh_cpp rmw_zenohd`, of which we are a client: by default
it passes nothing from one peer to another.
"""

from __future__ import annotations

import hashlib
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from threading import Lock
from typing import Any

import zenoh
from zenoh import ext

from companion.bus.config import first_line
from companion.bus.topics import LARGEST_JSON_BYTES
from companion.host.peer_data import copy_payload
from companion.ros2.definitions import type_hash
from companion.ros2.gateway import Losses, NodeTopic

_CDR, _DROP = zenoh.Encoding.APPLICATION_CDR, zenoh.CongestionControl.DROP
_GID_BYTES = 16
_ATTACHMENT = struct.Struct(f"<qqB{_GID_BYTES}s")
_BEST_EFFORT, _TRANSIENT_LOCAL = 2, 1  # of `rmw_qos_profile_t`
# As of rmw_zenoh's latched publishers, except that it is periodic: zenoh sends a sporadic one with BLOCK.
_HEARTBEAT_S = 0.5


@dataclass(frozen=True, slots=True)
class NodeName:
    """A node of ROS 2, and its keys on zenoh.

    Attributes:
        domain_id: `ROS_DOMAIN_ID`. namespace: without an outer `/`; empty: none.
    """

    domain_id: int
    namespace: str
    name: str

    def absolute(self, name: str) -> str:
        """Return the absolute name of a topic, given as `/NAME`, `NAME` of the namespace or `~/NAME`."""
        if name.startswith("/"):
            return name
        own = name.replace("~", self.name)
        return f"/{self.namespace}/{own}" if self.namespace else f"/{own}"

    def plain_key(self, name: str) -> str:
        """Return the key of a topic's samples for zenoh-bridge-ros2dds."""
        return self.absolute(name)[1:]

    def rmw_key(self, name: str, type_name: str) -> str:
        """Return the key of a topic's samples in rmw_zenoh."""
        return f"{self.domain_id}/{self.plain_key(name)}/{_dds_type(type_name)}/{type_hash(type_name)}"

    def token(self, zid: str) -> str:
        """Return the key of the node's liveliness token. `zid`: of its zenoh session; `*`: of any."""
        return self._token(zid, 0, "NN")

    def topic_token(self, zid: str, number: int, topic: NodeTopic) -> str:
        """Return the key of the liveliness token of a publisher or subscription.

        Args:
            number: above 0, unique in the session.
        """
        name, kind = _mangled(self.absolute(topic.name)), _dds_type(topic.type_name)
        entity = self._token(zid, number, "MP" if topic.on_serialized is None else "MS")
        return f"{entity}/{name}/{kind}/{type_hash(topic.type_name)}/{_qos(topic)}"

    def _token(self, zid: str, number: int, kind: str) -> str:
        # The node is number 0 of its session; the enclave is `/`.
        names = f"%/{_mangled('/' + self.namespace)}/{self.name}"
        return f"@ros2_lv/{self.domain_id}/{zid}/0/{number}/{kind}/{names}"


def attachment(sequence: int, source_time_ns: int, gid: bytes) -> bytes:
    """Return what rmw_zenoh needs beside each sample: 33 bytes, little-endian.

    Args:
        sequence: of the publisher, from 1. source_time_ns: Unix time. gid: of the publisher, 16 bytes.
    """
    return _ATTACHMENT.pack(sequence, source_time_ns, _GID_BYTES, gid)


def _dds_type(type_name: str) -> str:
    package, kind, name = type_name.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def _mangled(name: str) -> str:
    return name.replace("/", "%")


def _qos(topic: NodeTopic) -> str:
    """Return reliability, durability, history and depth; the rest, and what is empty, is the default."""
    reliability = "" if topic.reliable else _BEST_EFFORT
    return f"{reliability}:{_TRANSIENT_LOCAL if topic.latched else ''}:,{topic.depth}:,:,:,,"


class ZenohNode:
    """A node on a session of zenoh, for the gateway.

    zenoh itself declares everything again when a router that was lost is back.

    Args:
        session: of a client of the router.
        plain: with plain keys; else as rmw_zenoh.
        say: called with a line.
    """

    def __init__(
        self, session: zenoh.Session, name: NodeName, *, plain: bool, say: Callable[[str], None]
    ) -> None:
        self._session, self._name, self._plain, self._say = session, name, plain, say
        self._losses, self._zid = Losses(say), str(session.zid())
        self._publishers: dict[str, _Publisher] = {}
        self._kept: list[object] = []  # tokens, subscribers and listeners
        self._matching = Lock()
        if not plain:
            self._kept = [
                session.liveliness().declare_token(name.token(self._zid)),
                session.liveliness().declare_subscriber(name.token("*"), self._on_node, history=True),
            ]

    def declare(self, *topics: NodeTopic) -> None:
        """Publish topics, or subscribe to them. One that is declared already stays as it is."""
        for topic in topics:
            if topic.name in self._publishers:
                continue
            if topic.other_type is not None and not self._plain:  # a plain key has no type
                self.declare(replace(topic, type_name=topic.other_type, other_type=None))
            key, gid = self._name.plain_key(topic.name), None
            if not self._plain:
                key = self._name.rmw_key(topic.name, topic.type_name)
                token = self._name.topic_token(self._zid, len(self._kept), topic)
                self._kept.append(self._session.liveliness().declare_token(token))
                # rmw_zenoh has another hash of the token: all that counts is that no publisher shares it.
                gid = hashlib.blake2b(token.encode(), digest_size=_GID_BYTES).digest()
            if topic.on_serialized is not None:
                self._kept.append(self._session.declare_subscriber(key, partial(self._on_sample, topic)))
                continue
            publisher = self._publishers[topic.name] = _Publisher(self._session, key, topic, gid)
            if topic.on_wanted is not None:
                on_matching = partial(self._on_matching, publisher.plain, topic.on_wanted)
                self._kept.append(publisher.plain.declare_matching_listener(on_matching))
                on_matching()

    def send(self, name: str, payload: bytes) -> None:
        """Publish CDR on a declared topic, from any thread. Never raises for the network."""
        try:
            self._publishers[name].put(payload)
        except zenoh.ZError as error:
            self._losses.add(name, f"{name}: message left out: {first_line(error)}")

    def _on_matching(
        self, publisher: zenoh.Publisher, on_wanted: Callable[[bool], None], _: object = None
    ) -> None:
        with self._matching:  # zenoh's threads may overtake each other: what holds now is read again
            on_wanted(bool(publisher.matching_status.matching))  # type: ignore[attr-defined]

    def _on_sample(self, topic: NodeTopic, sample: zenoh.Sample) -> None:
        assert topic.on_serialized is not None
        try:
            payload = memoryview(copy_payload(sample.payload, LARGEST_JSON_BYTES))
            now_ns, age_ns, about = time.time_ns(), 0, sample.attachment
            if about is not None and len(about) == _ATTACHMENT.size:
                age_ns = now_ns - _ATTACHMENT.unpack(copy_payload(about, _ATTACHMENT.size))[1]
            received_ns = time.monotonic_ns()
            topic.on_serialized(topic.name, topic.type_name, payload, received_ns, now_ns, age_ns)
        except Exception as error:  # no message may end the thread
            self._losses.add(topic.name, f"{topic.name}: message left out: {error}")

    def _on_node(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.PUT and str(sample.key_expr) != self._name.token(self._zid):
            name = self._name.absolute(self._name.name)
            self._say(f"another node of domain {self._name.domain_id} is {name} too: set ros2.namespace")


class _Publisher:
    """Publishes one topic. `gid`: of its attachments; None: without.

    Attributes:
        plain: says whether there is a subscriber, which an advanced publisher does not.
    """

    def __init__(self, session: zenoh.Session, key: str, topic: NodeTopic, gid: bytes | None) -> None:
        self._gid, self._sequence = gid, count(1)
        reliability = zenoh.Reliability.RELIABLE if topic.reliable else zenoh.Reliability.BEST_EFFORT
        # rmw_zenoh has DROP too where it keeps the last samples: one frozen reader would stop the others.
        quality: dict[str, Any] = {"encoding": _CDR, "congestion_control": _DROP, "reliability": reliability}
        self.plain = session.declare_publisher(key, **quality)
        self._publisher: zenoh.Publisher | ext.AdvancedPublisher = self.plain
        if topic.latched:
            replies = ext.RepliesConfig(congestion_control=_DROP)
            heartbeats = ext.MissDetectionConfig(heartbeat=_HEARTBEAT_S, sporadic_heartbeat=None)
            self._publisher = ext.declare_advanced_publisher(
                session,
                key,
                cache=ext.CacheConfig(topic.depth, replies_config=replies),
                sample_miss_detection=heartbeats,
                publisher_detection=True,
                **quality,
            )

    def put(self, payload: bytes) -> None:
        """Publish a sample, from any thread. Raises zenoh.ZError."""
        if self._gid is None:
            self._publisher.put(payload)
        else:
            about = attachment(next(self._sequence), time.time_ns(), self._gid)
            self._publisher.put(payload, attachment=about)
