"""Faults of a running simulator: on its sockets, from its command line, its console and over zenoh."""

from __future__ import annotations

import json
import socket
import time
from typing import Any

import pytest
import zenoh

from mavlink_sim.faults.injector import ControlError, FaultControl
from mavlink_sim.testing import free_port, running_simulator
from mavlink_sim.vehicles.vehicle import Vehicle
from mavlink_sim.wire.faulty_socket import FaultySocket
from mavlink_sim.wire.link_faults import Delay, LinkStage, Loss
from mavlink_sim.wire.messages import dialect, parser

pytestmark = pytest.mark.realtime


def bound() -> socket.socket:
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    made.bind(("127.0.0.1", 0))
    made.settimeout(5.0)
    return made


def drain(endpoint: socket.socket) -> None:
    """Read until nothing arrives within its timeout."""
    while True:
        endpoint.recv(2048)


def test_socket_uses_stage_only_while_engaged() -> None:
    now_s = 0.0
    stage = LinkStage()
    with bound() as near, bound() as far:
        near.setblocking(False)
        link = FaultySocket(near, stage, lambda: now_s)
        link.sendto(b"one", far.getsockname())
        assert far.recv(100) == b"one"

        delay = Delay(0.5)
        stage.outbound.impair(delay)
        link.sendto(b"two", far.getsockname())
        link.pump()
        far.setblocking(False)
        with pytest.raises(BlockingIOError):
            far.recv(100)
        now_s = 0.5
        link.pump()
        far.settimeout(5.0)
        assert far.recv(100) == b"two"
        stage.outbound.clear(delay)
        assert not stage.outbound.engaged

        late = Delay(0.5)
        stage.inbound.impair(late)
        far.sendto(b"three", near.getsockname())
        with pytest.raises(BlockingIOError):
            link.recvfrom(100)
        assert not link.has_arrivals
        now_s = 1.0
        assert link.has_arrivals
        assert link.recvfrom(100) == (b"three", far.getsockname())
        stage.inbound.clear(late)
        lost = Loss(1.0, 1)
        stage.inbound.impair(lost)
        far.sendto(b"four", near.getsockname())
        with pytest.raises(BlockingIOError):
            link.recvfrom(100)
        stage.inbound.clear(lost)
        far.sendto(b"five", near.getsockname())
        assert link.recvfrom(100)[0] == b"five"


def test_faults_from_command_line_and_console() -> None:
    with bound() as client:
        port = client.getsockname()[1]
        with running_simulator(onboard_port=port, faults=["corrupt 0.5 way=out", "at=1 wind 3"]) as simulator:
            codec = parser()
            bad = good = 0
            while good < 200 or bad < 20:
                for message in codec.parse_buffer(client.recv(2048)) or []:
                    bad, good = (bad + 1, good) if message.get_type() == "BAD_DATA" else (bad, good + 1)
            simulator.wait_for_event("fault 2 wind 3 begins")
            simulator.fault("end all")
            simulator.fault("link_delay 0.5")
            simulator.wait_for_event("fault 3 link_delay 0.5 begins")
            asked_s = time.monotonic()
            question = dialect.MAVLink_timesync_message(0, 4711).pack(parser(1, 191))
            client.sendto(question, ("127.0.0.1", simulator.onboard_bind))
            while True:
                found = parser().parse_buffer(client.recv(2048)) or []
                if any(m.get_type() == "TIMESYNC" and m.tc1 and m.ts1 == 4711 for m in found):
                    break
            assert time.monotonic() - asked_s > 0.95  # late both ways
            simulator.fault("link_loss")
            simulator.wait_for_event("link_loss begins")
            client.settimeout(0.6)
            with pytest.raises(TimeoutError):
                drain(client)


def client(port: int) -> zenoh.Session:
    config = zenoh.Config()
    for key, value in {
        "mode": "client",
        "connect/endpoints": [f"tcp/127.0.0.1:{port}"],
        "scouting/multicast/enabled": False,
    }.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def test_faults_over_zenoh_are_answered() -> None:
    port = free_port(socket.SOCK_STREAM)
    with (
        running_simulator(control=f"tcp/127.0.0.1:{port}", system_id=3) as simulator,
        client(port) as session,
    ):

        def ask(selector: str, payload: str | None = None) -> dict[str, Any]:
            (reply,) = session.get(f"mavlink_sim/3/fault{selector}", payload=payload)
            assert reply.ok is not None
            answer: dict[str, Any] = json.loads(reply.ok.payload.to_string())
            return answer

        first = ask("", "link_delay 0.2 for=60")
        assert first["ok"]
        assert first["text"].endswith(" 1 link_delay 0.2 for=60")
        second = ask("?fault=gust 4 for=30")
        assert second["ok"]
        assert len(second["active"]) == 2
        refused = ask("", "wind")
        assert not refused["ok"]
        assert refused["text"].startswith("wind ")
        assert "needs speed" in refused["text"]
        assert ask("", "end all")["text"] == "ended 2"
        assert ask("")["text"] == "no faults"
        simulator.wait_for_event("fault 1 link_delay 0.2 for=60 ends")


def test_a_busy_control_endpoint_is_named() -> None:
    vehicle = Vehicle()
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as busy:
        busy.bind(("127.0.0.1", 0))
        busy.listen()
        port = busy.getsockname()[1]
        with pytest.raises(ControlError, match=f"--control tcp/127.0.0.1:{port}: .*listen"):
            FaultControl(f"tcp/127.0.0.1:{port}", 1, vehicle.faults)
