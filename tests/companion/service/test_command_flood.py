"""100,000 bad queries to a service in flight: each is answered, memory and log stay bounded, it flies on."""

from __future__ import annotations

import json
import queue
import threading
import time
from pathlib import Path
from typing import Any

import pytest
import zenoh

from companion.bus.client import listen
from companion.bus.topics import command_key
from mavlink_sim.testing import QUICK_FLIGHT, vehicle
from tests.companion.service_process import ServiceProcess, running_service

pytestmark = [pytest.mark.realtime, pytest.mark.slow]

QUERIES, BATCH, WARM_UP = 100_000, 250, 10_000
BAD = (
    b"\xff\xfe hold",
    b"mission " + b"q" * 300,
    b"mission /" + b"a/" * 3000,
    b"goto 1 nan",
    b"hold\x00\n\x1b[31m",
    b"goto " * 32_000,
    b"dance",
)
# An allocator keeps some pages; 100,000 answers kept would be ten times as much.
GROWTH_MIB = 16.0


def resident_mib(pid: int) -> float:
    status = Path(f"/proc/{pid}/status").read_text()
    return next(int(line.split()[1]) / 1024 for line in status.splitlines() if line.startswith("VmRSS"))


def send_batch(session: zenoh.Session, start: int) -> list[bool]:
    """Send a batch of bad queries of several senders; the success of each answer."""
    answers: list[bool] = []
    done = threading.Semaphore(0)

    def on_reply(reply: zenoh.Reply) -> None:
        assert reply.ok is not None
        answers.append(json.loads(reply.ok.payload.to_string())["success"])

    for number in range(start, start + BATCH):
        callback = zenoh.handlers.Callback(on_reply, drop=done.release)
        attachment = f"sender{number % 7}".encode()
        payload = BAD[number % len(BAD)]
        session.get(command_key("vehicle1"), callback, payload=payload, attachment=attachment, timeout=30.0)
    for _ in range(BATCH):
        assert done.acquire(timeout=60.0)
    return answers


def pilot_of(service: ServiceProcess) -> dict[str, Any]:
    """Of the next status."""
    received: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
    with service.client() as session:
        listen(session, "status", lambda _key, text: received.put(json.loads(text)))
        pilot: dict[str, Any] = received.get(timeout=10)["pilot"]
        return pilot


def flood(service: ServiceProcess) -> tuple[int, float, float]:
    """(number of answers, MiB that the service grew by after the warm-up, seconds)."""
    began_s, answered, warm_mib = time.monotonic(), 0, 0.0
    with service.client() as session:
        for start in range(0, QUERIES, BATCH):
            if start == WARM_UP:
                warm_mib = resident_mib(service.pid)
            answers = send_batch(session, start)
            assert not any(answers)
            answered += len(answers)
    return answered, resident_mib(service.pid) - warm_mib, time.monotonic() - began_s


@pytest.mark.timeout(600)
def test_flight_goes_on_through_100_000_bad_queries(filming: list[str], tmp_path: Path) -> None:
    with (
        vehicle(parameters=QUICK_FLIGHT) as simulator,
        running_service(simulator.onboard_port, filming, cwd=tmp_path) as service,
    ):
        service.take_off(2.5)
        assert service.command("orbit radius=4 speed=1")["success"]
        service.last_lines()
        before = len(service.lines)
        answered, growth_mib, lasting_s = flood(service)
        service.last_lines()
        lines = service.lines[before:]
        assert answered == QUERIES
        assert growth_mib < GROWTH_MIB
        assert len(lines) < lasting_s + 10
        assert not any("lost" in line or "ended" in line for line in lines)
        assert pilot_of(service)["behaviour"].startswith("orbiting")
        assert service.command("land")["success"]
        simulator.wait_for_event("disarmed")
