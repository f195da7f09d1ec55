"""ROS 2 for tests: its Python, a domain for each test, other programs' nodes, and `companion ros2 node`."""

from __future__ import annotations

import itertools
import json
import os
import queue
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import zenoh
from zenoh import ext

from companion.bus.config import zenoh_config
from companion.bus.topics import STATUS, Topic, alive_key, command_key
from companion.settings import ZenohSection
from mavlink_sim.testing import free_port
from tests.companion.service_process import ServiceProcess
from tests.programs import ROS_PYTHONS

ROOT = Path(__file__).parents[3]
PEER = Path(__file__).with_name("ros_peer.py")
WAIT_S = 30.0
VEHICLE = "drone1"
EACH_ROS = [
    pytest.param(name, marks=[pytest.mark.ros2, pytest.mark.needs(f"ROS 2 {name}")]) for name in ROS_PYTHONS
]
_numbers = itertools.count()


@pytest.fixture
def domain(monkeypatch: pytest.MonkeyPatch) -> int:
    """A domain of its own: processes that the test starts see those of no other test."""
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    number = 1 + (worker * 12 + next(_numbers) % 12) % 99
    monkeypatch.setenv("ROS_DOMAIN_ID", str(number))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.delenv("PYTHONPATH", raising=False)  # of ours
    return number


class RosPeer:
    """A node of another program (`ros_peer.py`)."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process
        self._lines: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self._kept: list[dict[str, Any]] = []
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if line.startswith("{"):
                self._lines.put(json.loads(line))

    def request(self, **request: Any) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()

    def subscribe(self, name: str, type_name: str, **options: Any) -> None:
        self.request(subscribe=name, type=type_name, **options)
        self.wait_for(lambda line: line.get("subscribed") == name)

    def publish(self, name: str, type_name: str, message: dict[str, Any], **options: Any) -> None:
        """Publish as soon as there is a subscriber; returns at once."""
        self.request(publish=name, type=type_name, message=message, **options)

    def wait_for(self, fits: Callable[[dict[str, Any]], object], timeout_s: float = WAIT_S) -> dict[str, Any]:
        """The first line that fits; earlier ones are kept for the next call."""
        for index, line in enumerate(self._kept):
            if fits(line):
                return self._kept.pop(index)
        deadline_s = time.monotonic() + timeout_s
        while True:
            try:
                line = self._lines.get(timeout=max(0.0, deadline_s - time.monotonic()))
            except queue.Empty:
                raise TimeoutError(f"not received: {str(self._kept)[:2000]}") from None
            if fits(line):
                return line
            self._kept.append(line)

    def message(self, name: str, timeout_s: float = WAIT_S) -> dict[str, Any]:
        """The next message of a topic."""
        found: dict[str, Any] = self.wait_for(lambda line: line.get("topic") == name, timeout_s)["message"]
        return found

    def message_of(self, name: str, send: Callable[[], object]) -> dict[str, Any]:
        """The first message of a topic. It is sent until then: a subscriber may match after its publisher."""
        deadline_s = time.monotonic() + WAIT_S
        while True:
            send()
            try:
                return self.message(name, 0.3)
            except TimeoutError:
                assert time.monotonic() < deadline_s, name

    def graph_until(self, fits: Callable[[dict[str, Any]], object]) -> dict[str, Any]:
        """Nodes, and topics with their types, once they fit."""
        deadline_s = time.monotonic() + WAIT_S
        while True:
            self.request(graph=True)
            graph = self.wait_for(lambda line: "nodes" in line)
            if fits(graph):
                return graph
            assert time.monotonic() < deadline_s, graph
            time.sleep(0.1)

    def close(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait(20)


@contextmanager
def ros_peer(ros: str, *arguments: str, name: str = "peer") -> Iterator[RosPeer]:
    process = subprocess.Popen(
        [ROS_PYTHONS[ros], PEER, name, *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    peer = RosPeer(process)
    try:
        peer.wait_for(lambda line: "ready" in line)
        yield peer
        peer.close()
    finally:
        process.kill()
        process.wait()


class BusSide:
    """What a service is on the bus: its topics, its queryable for commands, its liveliness token.

    Attributes:
        commands: those received. reply: of the next ones. before_reply: called before it, in a thread.
        received: number of commands.
    """

    def __init__(self, vehicle: str = VEHICLE, endpoint: str = "") -> None:
        self.vehicle = vehicle
        self.endpoint = endpoint or f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
        self.session = zenoh.open(zenoh_config(ZenohSection(listen=(self.endpoint,))))
        self.commands: queue.SimpleQueue[str] = queue.SimpleQueue()
        self.reply: dict[str, Any] = {"success": True, "reason": "done"}
        self.before_reply: Callable[[], object] = lambda: None
        self.received = 0
        self._publishers: dict[str, Any] = {}
        self._kept = (
            self.session.liveliness().declare_token(alive_key(vehicle)),
            self.session.declare_queryable(command_key(vehicle), self._execute),
        )
        self.put_status()

    def _execute(self, query: zenoh.Query) -> None:
        assert query.payload is not None
        self.commands.put(query.payload.to_string())
        self.received += 1

        def reply() -> None:
            self.before_reply()
            query.reply(query.key_expr, json.dumps(self.reply))

        threading.Thread(target=reply, daemon=True).start()

    def publisher(self, topic: Topic, camera: str | None = None) -> Any:
        key = topic.key(self.vehicle, camera)
        if key not in self._publishers:
            if topic.cached:
                self._publishers[key] = ext.declare_advanced_publisher(
                    self.session,
                    key,
                    cache=ext.CacheConfig(max_samples=topic.cached),
                    publisher_detection=True,
                )
            else:
                self._publishers[key] = self.session.declare_publisher(key)
        return self._publishers[key]

    def put(self, topic: Topic, body: Any, attachment: Any = None, camera: str | None = None) -> None:
        payload = body if isinstance(body, bytes | str) else json.dumps(body)
        about = None if attachment is None else json.dumps(attachment)
        self.publisher(topic, camera).put(payload, attachment=about)

    def put_status(self, *cameras: str, unix_offset_ns: int | None = None) -> None:
        offset_ns = time.time_ns() - time.monotonic_ns() if unix_offset_ns is None else unix_offset_ns
        self.put(STATUS, {"unix_offset_ns": offset_ns, "cameras": {camera: {} for camera in cameras}})

    def wait_for_reader(self, topic: Topic, wanted: bool = True) -> None:
        """Wait until somebody, or nobody, subscribes to a topic without kept messages."""
        publisher, deadline_s = self.publisher(topic), time.monotonic() + WAIT_S
        while publisher.matching_status.matching != wanted:
            assert time.monotonic() < deadline_s, topic.name
            time.sleep(0.02)

    def close(self) -> None:
        self.session.close()  # type: ignore[no-untyped-call]


@pytest.fixture
def bus() -> Iterator[BusSide]:
    side = BusSide()
    try:
        yield side
    finally:
        side.close()


@contextmanager
def running_node(
    ros: str, endpoint: str, *flags: str, vehicle: str = VEHICLE, ready: str = "node: up: "
) -> Iterator[ServiceProcess]:
    """Run `companion ros2 node` with that ROS, until a signal ends it."""
    command = [sys.executable, "-m", "companion.cli", "ros2", "node", "--python", str(ROS_PYTHONS[ros])]
    command += ["--connect", endpoint, "--vehicle-name", vehicle, *flags]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env={**os.environ, "PYTHONPATH": str(ROOT)}
    )
    node = ServiceProcess(process, endpoint)
    try:
        node.wait_for_line(ready)
        yield node
        assert node.stop() == 0, node.last_lines()
    except BaseException as error:
        error.add_note("\n".join(["last lines of the node:", *node.last_lines()]))
        raise
    finally:
        node.stop()
        assert process.stdout is not None
        process.stdout.close()


def process_of_node(node: ServiceProcess) -> int:
    """The process id of the node's Python."""
    (child,) = Path(f"/proc/{node.pid}/task/{node.pid}/children").read_text().split()
    return int(child)
