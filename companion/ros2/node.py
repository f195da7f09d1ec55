"""The ROS 2 node: publishes the bytes of its parent, and hands it the bytes that it receives.

The Python of ROS runs this file (3.10 or later): `node.py OPTIONS [--ros-args …]`. It imports nothing but the
standard library and rclpy, and knows no message: those are defined once, in the parent.

Standard input is a socket of the parent; its end ends the node. Both send frames: `FRAME`, then the body.

| kind | sent by | channel | body |
|---|---|---|---|
| TOPICS | parent | | JSON: a list of topics, each with its channel |
| MESSAGE | parent | to publish on | CDR |
| MESSAGE | node | received on | `RECEIVED`, then CDR |
| WANTED | node | of a publisher | one byte: whether it has a subscriber |
| READY | node | | JSON: the node's name and namespace |
| CLOCK | node | | `CLOCK_BODY`: five times a second, also a sign of life |
"""

from __future__ import annotations

import importlib
import json
import os
import socket
import struct
import sys
import threading
import time
from typing import Any

FRAME = struct.Struct("<BxHI")  # kind, channel, bytes of the body
# Which of the topic's types; when: CLOCK_MONOTONIC, ROS time; time since it was sent, or 0; nanoseconds.
RECEIVED = struct.Struct("<Bqqq")
CLOCK_BODY = struct.Struct("<qq?")  # CLOCK_MONOTONIC and ROS time of a moment, and whether that is simulated
TOPICS, MESSAGE, WANTED, READY, CLOCK = range(1, 6)
EXIT_REFUSED = 2  # it has printed why it cannot work
_PERIOD_S = 0.2
_REPORT_S = 10.0
_SAME_MOMENT_NS, _MOST_READINGS = 200_000, 5


class _Bridge:
    """The publishers and subscriptions of the node, and the socket to the parent.

    Args:
        namesake_s: another node of its name is reported after this time, seconds.
    """

    def __init__(self, node: Any, parent: socket.socket, namesake_s: float) -> None:
        self._node, self._parent, self._lock = node, parent, threading.Lock()
        self._publishers: dict[int, Any] = {}
        self._adapted: dict[int, tuple[dict[str, Any], Any]] = {}  # topic and subscription, None: due
        self._large: dict[str, float] = {}  # topic and when its last message that is too large was reported
        self._wanted: set[int] = set()
        self._namesake_checks = int(namesake_s / _PERIOD_S)

    def send(self, kind: int, channel: int, *parts: bytes) -> None:
        """Send a frame, from any thread. If the parent has gone, the node is ending."""
        header = FRAME.pack(kind, channel, sum(map(len, parts)))
        with self._lock:
            try:
                for part in (header, *parts):
                    self._parent.sendall(part)
            except OSError:
                pass

    def receive(self) -> None:
        """Process frames until the parent has gone."""
        with self._parent.makefile("rb") as stream:
            while len(header := stream.read(FRAME.size)) == FRAME.size:
                kind, channel, size = FRAME.unpack(header)
                body = stream.read(size)
                if kind == TOPICS:
                    self._add(json.loads(body))
                elif channel in self._publishers:
                    self._publishers[channel].publish(body)

    def report(self) -> None:
        """Send which topics are wanted, and the time."""
        for channel, publisher in list(self._publishers.items()):
            wanted = publisher.get_subscription_count() > 0
            if wanted != (channel in self._wanted):
                self._wanted ^= {channel}
                self.send(WANTED, channel, bytes([wanted]))
        self.send(CLOCK, 0, CLOCK_BODY.pack(*self._now(), self._node.get_clock().ros_time_is_active))
        self._check_name()
        self._adapt()

    def _now(self) -> tuple[int, int]:
        """CLOCK_MONOTONIC and ROS time of the same moment: a busy computer pauses between two readings."""
        for _ in range(_MOST_READINGS):
            before_ns = time.monotonic_ns()
            ros_ns = self._node.get_clock().now().nanoseconds
            after_ns = time.monotonic_ns()
            if after_ns - before_ns < _SAME_MOMENT_NS:
                break
        return after_ns, ros_ns

    def _adapt(self) -> None:
        """Subscribe as the publishers allow: with their type; reliably if all are, where a topic adapts.

        Of large images most are lost without. A subscription of another type is created at the next call: the
        executor may still hold the one before, and both cannot exist.
        """
        from rclpy.qos import ReliabilityPolicy

        for channel, (topic, subscription) in list(self._adapted.items()):
            if subscription is None:
                self._add([topic])
                continue
            offered = self._node.get_publishers_info_by_topic(topic["name"])
            types = [name for name in topic["types"] if name in {p.topic_type for p in offered}]
            kind = topic["type"] if topic["type"] in types or not types else types[0]
            reliable = topic["reliable"]
            if topic["adapts"] and offered:
                reliable = all(p.qos_profile.reliability == ReliabilityPolicy.RELIABLE for p in offered)
            if (kind, reliable) != (topic["type"], topic["reliable"]):
                self._node.destroy_subscription(subscription)
                self._adapted[channel] = {**topic, "type": kind, "reliable": reliable}, None

    def _check_name(self) -> None:
        name = self._node.get_name(), self._node.get_namespace()
        if self._namesake_checks > 0 and self._node.get_node_names_and_namespaces().count(name) > 1:
            self._namesake_checks -= 1
            if self._namesake_checks == 0:
                full = self._node.get_fully_qualified_name()
                _say(f"another node is {full}, and both answer: change ros2.namespace of one, or end it")

    def _leave_out(self, name: str, size: int, largest: int) -> None:
        now_s = time.monotonic()
        if now_s - self._large.get(name, -_REPORT_S) >= _REPORT_S:
            self._large[name] = now_s
            _say(f"{name}: messages left out: {size} bytes, at most {largest} are received")

    def _add(self, topics: list[dict[str, Any]]) -> None:
        missing: dict[str, list[str]] = {}
        for topic in topics:
            kind = topic.setdefault("type", topic["types"][0])
            package = kind.partition("/")[0]
            try:
                self._create(topic, importlib.import_module(package + ".msg"))
            except ModuleNotFoundError:
                missing.setdefault(package, []).append(topic["name"])
            except Exception as error:
                _say(f"{topic['name']} is left out: {kind}: {_first_line(error)}")
        for package, names in missing.items():
            apt = f"ros-{os.environ.get('ROS_DISTRO', 'DISTRO')}-{package.replace('_', '-')}"
            _say(f"{package} is not installed (sudo apt install {apt}): left out: {', '.join(names)}")

    def _create(self, topic: dict[str, Any], messages: Any) -> None:
        from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

        channel, name = topic["channel"], topic["name"]
        kind = getattr(messages, topic["type"].rpartition("/")[2])
        profile = QoSProfile(
            depth=topic["depth"],
            reliability=ReliabilityPolicy.RELIABLE if topic["reliable"] else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if topic["latched"] else DurabilityPolicy.VOLATILE,
        )

        def receive(payload: bytes, info: dict[str, int]) -> None:
            if len(payload) > topic["largest_bytes"]:
                self._leave_out(name, len(payload), topic["largest_bytes"])
                return
            sent_ns = info.get("source_timestamp", 0)
            age_ns = time.time_ns() - sent_ns if sent_ns > 0 else 0
            number = topic["types"].index(topic["type"])
            self.send(MESSAGE, channel, RECEIVED.pack(number, *self._now(), age_ns), payload)

        if topic["publish"]:
            self._publishers[channel] = self._node.create_publisher(kind, name, profile)
            return
        subscription = self._node.create_subscription(kind, name, receive, profile, raw=True)
        if topic["adapts"] or len(topic["types"]) > 1:
            self._adapted[channel] = topic, subscription


def main(options: dict[str, Any], ros_arguments: list[str]) -> int:
    """Run until the parent has gone; returns the exit code."""
    import rclpy
    from rclpy.clock import Clock, ClockType
    from rclpy.executors import ExternalShutdownException

    try:
        rclpy.init(args=ros_arguments)
        node = rclpy.create_node(options["name"], namespace=options["namespace"])
    except Exception as error:
        _say(f"ROS refuses the node: {_first_line(error)}")
        return EXIT_REFUSED
    bridge = _Bridge(node, socket.socket(fileno=os.dup(0)), options["namesake_s"])
    about = {"name": node.get_fully_qualified_name(), "namespace": node.get_namespace()}
    bridge.send(READY, 0, json.dumps(about).encode())

    def receive() -> None:
        try:
            bridge.receive()
        finally:
            if rclpy.ok():
                rclpy.shutdown()

    # Of the steady clock: with use_sim_time that of the node stands still until there is /clock.
    node.create_timer(_PERIOD_S, bridge.report, clock=Clock(clock_type=ClockType.STEADY_TIME))
    threading.Thread(target=receive, name="parent", daemon=True).start()
    try:
        rclpy.spin(node)
    except (ExternalShutdownException, KeyboardInterrupt):
        pass
    except Exception:
        if rclpy.ok():  # else the shutdown has interrupted it
            raise
    return 0


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]


def _say(text: str) -> None:
    print(text, flush=True)


if __name__ == "__main__":
    # The files beside this one have names of packages, such as `requests`.
    sys.path[:] = [path for path in sys.path if path != os.path.dirname(os.path.abspath(__file__))]
    sys.exit(main(json.loads(sys.argv[1]), sys.argv[2:]))
