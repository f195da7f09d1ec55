"""Bad messages of other programs to a service in flight: it flies on, counts them and logs some lines."""

from __future__ import annotations

import json
import queue
from pathlib import Path
from typing import Any

import pytest

from companion.bus import topics
from companion.bus.client import listen
from mavlink_sim.testing import QUICK_FLIGHT, vehicle
from tests.companion.service_process import running_service

pytestmark = [pytest.mark.realtime, pytest.mark.slow]

MIB = 1024 * 1024
SMALL = (b"[" * 8000, b'{"a":' * 1500, b'{"vehicle": NaN}', b"9" * 5000, b"\xff", b"", b"{}", b"null")
REPEATED = 100


@pytest.mark.timeout(300)
def test_flight_goes_on_through_bad_messages(filming: list[str], tmp_path: Path) -> None:
    with (
        vehicle(parameters=QUICK_FLIGHT) as simulator,
        running_service(simulator.onboard_port, filming, cwd=tmp_path) as service,
        service.client() as session,
    ):
        service.take_off(2.5)
        assert service.command("orbit radius=4 speed=1")["success"]
        service.last_lines()
        before = len(service.lines)
        keys = (topics.POSE.key("beta"), topics.STATUS.key("beta"), topics.VELOCITY.key("vehicle1"))
        for key in keys:
            for size in (90 * MIB, 10 * MIB, 1 * MIB):
                session.put(key, b" " * size)
            for _ in range(REPEATED):
                for data in SMALL:
                    session.put(key, data)
        received: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        listen(
            session, "status", lambda _, text: received.put(json.loads(text)) if text[:2] == '{"' else None
        )
        ignored: dict[str, int] = {}
        # zenoh itself drops the largest, and what the network cannot take.
        while min(ignored.values(), default=0) < 10:
            status = received.get(timeout=20)
            ignored = status["bus"]["ignored"]
        assert set(ignored) == {"pose", "status", "velocity"}
        assert status["pilot"]["behaviour"].startswith("orbiting")
        service.last_lines()
        lines = service.lines[before:]
        assert len([line for line in lines if "message ignored" in line]) <= 12
        assert not any("lost" in line or "ended" in line or "Traceback" in line for line in lines)
        assert service.command("land")["success"]
        simulator.wait_for_event("disarmed")
