"""rmw_zenoh and zenoh-bridge-ros2dds: keys, tokens and attachments, and what passes through a router."""

from __future__ import annotations

import json
import queue
import socket
import struct
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from subprocess import PIPE
from typing import Any

import pytest
import zenoh

from companion.bus import topics
from companion.bus.client import client_settings, open_client, subscribe_kept
from companion.bus.topics import DETECTIONS, Topic
from companion.ros2.cdr import decode, encode
from companion.ros2.dialect import NodeName, ZenohNode, attachment
from companion.ros2.gateway import Gateway, NodeTopic
from companion.ros2.messages import OUTPUT_TOPICS, Messages, RosTopic
from companion.settings import ZenohSection
from mavlink_sim.testing import free_port
from tests.companion.zenoh_router import router
from tests.programs import PYZEROS

WAIT_S = 30.0
STRING, TWIST = "std_msgs/msg/String", "geometry_msgs/msg/Twist"
TOPICS = {topic.name: topic for topic in OUTPUT_TOPICS}
NODE = NodeName(7, "drone1", "companion")
# rmw_zenoh's docs/design.md.
STRING_HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
CHATTER = f"std_msgs::msg::dds_::String_/{STRING_HASH}"
Wanted = tuple[str, bool]


def test_keys_and_tokens_are_those_of_the_design_of_rmw_zenoh() -> None:
    listener, zid = NodeName(2, "", "listener"), "aac3178e146ba6f1fc6e6a4085e77f21"
    assert listener.token(zid) == f"@ros2_lv/2/{zid}/0/0/NN/%/%/listener"
    received = NodeTopic("chatter", STRING, lambda *_: None)
    entity = f"@ros2_lv/2/{zid}/0/10/MS/%/%/listener/%chatter"
    assert listener.topic_token(zid, 10, received) == f"{entity}/{CHATTER}/::,10:,:,:,,"
    talker, zid = NodeName(0, "", "talker"), "8b20917502ee955ac4476e0266340d5c"
    entity = f"@ros2_lv/0/{zid}/0/10/MP/%/%/talker/%chatter"
    assert (
        talker.topic_token(zid, 10, NodeTopic("chatter", STRING, depth=7))
        == f"{entity}/{CHATTER}/::,7:,:,:,,"
    )
    assert talker.rmw_key("chatter", STRING) == f"0/chatter/{CHATTER}"


@pytest.mark.parametrize(
    ("name", "key"),
    [
        ("image/compressed", "drone1/image/compressed"),
        ("/tf", "tf"),
        ("~/result", "drone1/companion/result"),
    ],
)
def test_name_of_a_topic_as_key(name: str, key: str) -> None:
    assert NODE.plain_key(name) == key
    assert NODE.absolute(name) == f"/{key}"
    assert NODE.rmw_key(name, STRING) == f"7/{key}/{CHATTER}"


def test_quality_of_service_of_a_token() -> None:
    best_effort = NodeTopic("a", STRING, reliable=False, depth=1)
    latched = NodeTopic("a", STRING, latched=True, depth=1)
    assert NODE.topic_token("z", 1, best_effort).endswith("/2::,1:,:,:,,")
    assert NODE.topic_token("z", 1, latched).endswith("/:1:,1:,:,:,,")


def test_attachment_is_33_bytes_little_endian() -> None:
    data = attachment(1, 0x0102030405060708, bytes(range(16)))
    assert data.hex() == "0100000000000000080706050403020110000102030405060708090a0b0c0d0e0f"


class CountingMessages(Messages):
    converted = 0

    def convert(
        self,
        topic: RosTopic,
        camera: str | None,
        payload: bytes,
        attachment: bytes | None = None,
        source: Topic | None = None,
    ) -> bytes | None:
        self.converted += 1
        return encode(topic.type_name, {})


class Graph:
    """A router, and what one node of ours there wants and says."""

    def __init__(self) -> None:
        self.port = free_port(socket.SOCK_STREAM)
        self.endpoint = f"tcp/127.0.0.1:{self.port}"
        self.wanted: queue.SimpleQueue[Wanted] = queue.SimpleQueue()
        self.said: queue.SimpleQueue[str] = queue.SimpleQueue()

    def session(self) -> Any:
        return open_client(client_settings(ZenohSection(), (self.endpoint,)), timeout_s=WAIT_S)

    def node(self, session: zenoh.Session, *, plain: bool = False) -> ZenohNode:
        return ZenohNode(session, NODE, plain=plain, say=self.said.put)

    def topics(self, *topics: RosTopic) -> list[NodeTopic]:
        now: set[str] = set()

        def on_wanted(name: str, wanted: bool) -> None:
            if (name in now) != wanted:  # as the gateway, which accepts repetitions
                (now.add if wanted else now.discard)(name)
                self.wanted.put((name, wanted))

        return [
            NodeTopic(
                *(topic.name, topic.type_name),
                on_wanted=partial(on_wanted, topic.name),
                latched=topic.latched,
                depth=1 if topic.latched else 10,
            )
            for topic in topics
        ]

    def next_wanted(self) -> Wanted:
        return self.wanted.get(timeout=WAIT_S)


@pytest.fixture
def graph() -> Iterator[Graph]:
    graph = Graph()
    with router(graph.port):
        yield graph


def until(condition: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < deadline_s
        time.sleep(0.02)


@pytest.mark.parametrize("plain", [False, True])
def test_topic_is_wanted_while_there_is_a_subscriber(graph: Graph, plain: bool) -> None:
    with graph.session() as ours, graph.session() as others:
        node, labels = graph.node(ours, plain=plain), TOPICS["labels"]
        node.declare(*graph.topics(labels, TOPICS["fix"]))
        assert graph.wanted.empty()
        key = NODE.plain_key("labels") if plain else NODE.rmw_key("labels", STRING)
        received: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
        subscriber = others.declare_subscriber(key, received.put)
        assert graph.next_wanted() == ("labels", True)
        node.send("labels", encode(STRING, {"data": "car"}))
        sample = received.get(timeout=WAIT_S)
        assert decode(STRING, sample.payload.to_bytes())["data"] == "car"
        assert sample.encoding == zenoh.Encoding.APPLICATION_CDR
        assert (sample.attachment is None) == plain
        subscriber.undeclare()
        assert graph.next_wanted() == ("labels", False)


def test_cameras_share_the_publisher_of_an_absolute_topic(graph: Graph) -> None:
    tf, transforms = TOPICS["/tf"], topics.TRANSFORMS
    with (
        graph.session() as service,
        graph.session() as bus,
        graph.session() as ours,
        graph.session() as others,
    ):
        gateway = Gateway(bus, "drone1", CountingMessages("", int), [graph.node(ours)], graph.said.put)
        gateway.offer(None)
        subscriber = others.declare_subscriber(NODE.rmw_key("/tf", tf.type_name), lambda _: None)
        first, second = (service.declare_publisher(transforms.key("drone1", name)) for name in (None, "down"))
        until(lambda: bool(first.matching_status.matching))
        assert not second.matching_status.matching
        gateway.offer("down")  # while it is wanted
        until(lambda: bool(second.matching_status.matching))
        assert len(list(others.liveliness().get("@ros2_lv/7/*/*/*/MP/*/*/*/%tf/**"))) == 1
        subscriber.undeclare()
        until(lambda: not first.matching_status.matching and not second.matching_status.matching)
        gateway.close()


@pytest.mark.parametrize("plain", [False, True])
def test_late_subscriber_gets_what_is_latched(graph: Graph, plain: bool) -> None:
    with graph.session() as ours, graph.session() as others:
        node, lens = graph.node(ours, plain=plain), TOPICS["camera_info"]
        node.declare(*graph.topics(lens))
        node.send("camera_info", encode(lens.type_name, {"width": 640}))
        key = NODE.plain_key("camera_info") if plain else NODE.rmw_key("camera_info", lens.type_name)
        received: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
        subscriber = subscribe_kept(others, key, received.put)
        sample = received.get(timeout=WAIT_S)
        assert decode(lens.type_name, sample.payload.to_bytes())["width"] == 640
        subscriber.undeclare()  # type: ignore[no-untyped-call]


def test_second_node_of_one_name_is_reported_by_both(graph: Graph) -> None:
    with graph.session() as first, graph.session() as second:
        nodes = [graph.node(first)]
        assert graph.said.empty()
        nodes.append(graph.node(second))
        for _ in nodes:
            assert "/drone1/companion" in graph.said.get(timeout=WAIT_S)


def test_received_message_that_cannot_be_used_is_reported(graph: Graph) -> None:
    with graph.session() as ours, graph.session() as others:
        received: queue.SimpleQueue[Any] = queue.SimpleQueue()

        def on_twist(name: str, type_name: str, payload: memoryview, received_ns: int, *_: int) -> None:
            received.put(decode(type_name, payload)["linear"]["x"])
            assert 0 <= time.monotonic_ns() - received_ns < 1e9

        node = graph.node(ours)
        node.declare(NodeTopic("cmd_vel", TWIST, on_twist))
        with others.declare_publisher(NODE.rmw_key("cmd_vel", TWIST)) as publisher:
            until(lambda: bool(publisher.matching_status.matching))
            publisher.put(b"\0\1\0\0 too short")
            assert "cmd_vel" in graph.said.get(timeout=WAIT_S)
            publisher.put(encode(TWIST, {"linear": {"x": 1.5}}))
            assert received.get(timeout=WAIT_S) == 1.5


def test_nothing_is_encoded_while_nobody_listens(graph: Graph) -> None:
    topic = TOPICS["detections"]
    with (
        graph.session() as service,
        graph.session() as bus,
        graph.session() as ours,
        graph.session() as others,
    ):
        messages = CountingMessages("", lambda stamp_ns: stamp_ns)
        gateway = Gateway(bus, "drone1", messages, [graph.node(ours)], graph.said.put)
        gateway.offer(None)
        with service.declare_publisher(DETECTIONS.key("drone1")) as publisher:
            received: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
            subscriber = others.declare_subscriber(NODE.rmw_key("detections", topic.type_name), received.put)
            # `Bus` encodes nothing without a subscriber either.
            until(lambda: bool(publisher.matching_status.matching))
            publisher.put(b"{}")
            assert received.get(timeout=WAIT_S)
            subscriber.undeclare()
            until(lambda: not publisher.matching_status.matching)
            publisher.put(b"{}")
            assert messages.converted == 1
        gateway.close()


class Receiver:
    """A node of pyzeros that subscribes to topics, with what it prints."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self._process = process
        self.tokens: dict[str, bool] = {}  # key: whether it is alive
        self.expected: dict[str, str] = {}  # key: the one that pyzeros would have
        # Of each topic that was decoded, the newest attachment: sequence, Unix time, 16, gid.
        self.samples: dict[str, tuple[Any, ...]] = {}

    def read_until(self, condition: Callable[[Receiver], bool]) -> None:
        assert self._process.stdout is not None
        while not condition(self):
            line = self._process.stdout.readline()
            assert line, "the node of pyzeros has ended"
            item = json.loads(line)
            if "token" in item:
                self.tokens[item["token"]] = item["alive"]
                self.expected |= {item["token"]: item["expected"]} if item["expected"] else {}
            elif "name" in item:
                self.samples[item["name"]] = struct.unpack("<qqB16s", bytes.fromhex(item["attachment"]))

    def ours(self) -> set[str]:
        """Tokens of our node that are alive."""
        return {key for key, alive in self.tokens.items() if alive and "/companion" in key}


@contextmanager
def receiving(endpoint: str, domain_id: int, topics: list[tuple[str, str]]) -> Iterator[Receiver]:
    script = Path(__file__).with_name("pyzeros_receiver.py")
    command = [str(PYZEROS), str(script), endpoint, str(domain_id), json.dumps(topics)]
    with subprocess.Popen(command, stdin=PIPE, stdout=PIPE) as process:
        try:
            yield Receiver(process)
        finally:
            process.kill()


def test_both_types_of_a_topic_are_received_with_their_age(graph: Graph) -> None:
    stamped = "geometry_msgs/msg/TwistStamped"
    with graph.session() as ours, graph.session() as others:
        received: queue.SimpleQueue[tuple[str, int]] = queue.SimpleQueue()

        def on_twist(_: str, type_name: str, __: memoryview, ___: int, ____: int, age_ns: int) -> None:
            received.put((type_name, age_ns))

        graph.node(ours).declare(NodeTopic("cmd_vel", TWIST, on_twist, other_type=stamped))
        for kind, age_ns in ((TWIST, 5 * 10**9), (stamped, 0)):
            with others.declare_publisher(NODE.rmw_key("cmd_vel", kind)) as publisher:
                until(lambda: bool(publisher.matching_status.matching))
                about = attachment(1, time.time_ns() - age_ns, bytes(16)) if age_ns else None
                publisher.put(encode(kind, {}), attachment=about)
                found = received.get(timeout=WAIT_S)
                assert found[0] == kind
                assert found[1] >= age_ns if age_ns else found[1] == 0


@pytest.mark.realtime
@pytest.mark.needs("pyzeros")
def test_pyzeros_gets_every_topic_through_a_router_that_is_restarted() -> None:
    graph = Graph()
    names = {NODE.absolute(topic.name): topic for topic in OUTPUT_TOPICS}

    def publish(node: ZenohNode) -> None:
        until(lambda: graph.wanted.qsize() >= len(OUTPUT_TOPICS))
        assert {graph.next_wanted()[1] for _ in OUTPUT_TOPICS} == {True}
        for topic in OUTPUT_TOPICS:
            node.send(topic.name, encode(topic.type_name, {}))

    with router(graph.port) as process, graph.session() as ours:
        node = graph.node(ours)
        node.declare(*graph.topics(*OUTPUT_TOPICS))
        listed = [(topic.type_name, name) for name, topic in names.items()]
        with receiving(graph.endpoint, NODE.domain_id, listed) as receiver:
            publish(node)
            receiver.read_until(lambda seen: len(seen.samples) == len(names))
            receiver.read_until(lambda seen: len(seen.ours()) == len(names) + 1)
            assert {sequence for sequence, *_ in receiver.samples.values()} == {1}
            assert len({gid for *_, gid in receiver.samples.values()}) == len(names)
            assert abs(receiver.samples["/tf"][1] - time.time_ns()) < WAIT_S * 1e9
            assert len(receiver.expected) == len(names)
            for token, expected in receiver.expected.items():
                assert token == expected
            process.kill()
            receiver.read_until(lambda seen: not seen.ours())
            assert {graph.next_wanted()[1] for _ in names} == {False}
            with router(graph.port):
                publish(node)
                receiver.read_until(lambda seen: all(sequence == 2 for sequence, *_ in seen.samples.values()))
                receiver.read_until(lambda seen: len(seen.ours()) == len(names) + 1)
