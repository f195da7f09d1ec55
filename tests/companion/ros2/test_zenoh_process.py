"""The service with `ros2.rmw_zenoh`: that process is killed, and so is the router; the service stays."""

from __future__ import annotations

import json
import os
import queue
import signal
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh

from companion.bus.client import client_settings, open_client
from companion.bus.topics import STATUS
from companion.ros2.cdr import decode, encode
from companion.ros2.dialect import NodeName
from companion.settings import ZenohSection
from mavlink_sim.testing import free_port
from tests.companion.service_process import ServiceProcess, heartbeats, running_service
from tests.companion.zenoh_router import router

pytestmark = pytest.mark.realtime

WAIT_S = 30.0
DETECTIONS, STRING = "vision_msgs/msg/Detection2DArray", "std_msgs/msg/String"
NODE = NodeName(5, "vehicle1", "companion")


def client(endpoint: str) -> Any:
    return open_client(client_settings(ZenohSection(), (endpoint,)), timeout_s=WAIT_S)


class Tokens:
    """The liveliness tokens of the domain on a router, as they come and go."""

    def __init__(self, session: zenoh.Session) -> None:
        self._samples: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
        self._subscriber = session.liveliness().declare_subscriber(
            "@ros2_lv/5/**", self._samples.put, history=True
        )
        self.alive: set[str] = set()

    def wait(self, present: bool, within_s: float = WAIT_S) -> None:
        """Wait until the node with its publishers is there, or until nothing of it is."""
        deadline_s = time.monotonic() + within_s
        kinds: set[str] = set()
        while not ({"NN", "MP", "MS"} <= kinds if present else not self.alive):
            sample = self._samples.get(timeout=max(deadline_s - time.monotonic(), 0.0))
            change = self.alive.add if sample.kind == zenoh.SampleKind.PUT else self.alive.discard
            change(str(sample.key_expr))
            kinds = {token.split("/")[5] for token in self.alive}


def pid_of_ros(service: ServiceProcess) -> int:
    children = Path(f"/proc/{service.pid}/task/{service.pid}/children").read_text().split()
    (found,) = (
        int(pid) for pid in children if b"companion.ros2" in Path(f"/proc/{pid}/cmdline").read_bytes()
    )
    return found


def wait_for_part(service: ServiceProcess, state: str) -> dict[str, Any]:
    with service.client() as session, session.declare_subscriber(STATUS.key("vehicle1")) as status:
        deadline_s = time.monotonic() + WAIT_S
        while time.monotonic() < deadline_s:
            parts = json.loads(status.recv().payload.to_string())["parts"]
            (part,) = (part for part in parts if part["name"] == "ros2")
            if part["state"] == state:
                return dict(part)
    raise AssertionError(part)


@pytest.fixture
def port() -> int:
    return free_port(socket.SOCK_STREAM)


@pytest.fixture
def service(port: int, filming: list[str], tmp_path: Path) -> Iterator[ServiceProcess]:
    flags = [*filming, "--ros2-rmw-zenoh", "true", "--ros2-domain-id", "5", "--ros2-commands", "true"]
    flags += ["--ros2-router", f"tcp/127.0.0.1:{port}"]
    with heartbeats() as autopilot, running_service(autopilot, flags, cwd=tmp_path) as service:
        yield service


def test_service_is_a_node_whatever_its_process_and_its_router_do(service: ServiceProcess, port: int) -> None:
    endpoint = f"tcp/127.0.0.1:{port}"
    assert endpoint in service.wait_for_line("ros2: paused: ")
    assert endpoint in wait_for_part(service, "retrying")["reason"]
    with router(port) as process:
        service.wait_for_line("ros2: open ")
        wait_for_part(service, "ready")
        with client(endpoint) as session:
            tokens = Tokens(session)
            tokens.wait(True)
            samples: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
            subscriber = session.declare_subscriber(NODE.rmw_key("detections", DETECTIONS), samples.put)
            message = decode(DETECTIONS, samples.get(timeout=WAIT_S).payload.to_bytes())
            stamp = message["header"]["stamp"]
            assert abs(stamp["sec"] + stamp["nanosec"] * 1e-9 - time.time()) < WAIT_S
            os.kill(pid_of_ros(service), signal.SIGKILL)
            tokens.wait(False, within_s=2.0)
            assert "code -9" in service.wait_for_line("ros2: its process ended")
            tokens.wait(True)
            while not samples.empty():
                samples.get()
            samples.get(timeout=WAIT_S)
            subscriber.undeclare()
        process.kill()
        assert endpoint in service.wait_for_line("ros2: paused: ", after=len(service.lines))
    with router(port), client(endpoint) as session:
        service.wait_for_line("ros2: open ", after=len(service.lines))
        Tokens(session).wait(True)
        results: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
        result = session.declare_subscriber(NODE.rmw_key("~/result", STRING), results.put)
        with session.declare_publisher(NODE.rmw_key("~/command", STRING)) as publisher:
            publisher.put(encode(STRING, {"data": "dance"}))
            answer = json.loads(decode(STRING, results.get(timeout=WAIT_S).payload.to_bytes())["data"])
        assert answer["command"] == "dance"
        assert not answer["success"]
        result.undeclare()
    assert service.process.poll() is None
    assert service.command("stop")["success"]


def test_endpoint_of_the_service_itself_is_no_router(filming: list[str], tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    flags = [*filming, "--ros2-plain-keys", "true", "--ros2-router", endpoint, "--zenoh-listen", endpoint]
    with (
        heartbeats() as autopilot,
        running_service(autopilot, flags, cwd=tmp_path, endpoint=endpoint) as service,
    ):
        assert endpoint in service.wait_for_line("ros2: paused: ")
        assert "zenoh.listen" in wait_for_part(service, "retrying")["reason"]
