"""`companion demo`, with a camera rendered from the pose of the autopilot at COMPANION_SITL_URL."""

from __future__ import annotations

import json
import signal
from pathlib import Path

import pytest

from mavlink_sim.wire.messages import dialect
from tests.companion.command_line import companion
from tests.sitl.conftest import Services
from tests.sitl.sitl_harness import FIGURES, NAMES, READY_S, AutopilotLink, Flight, bring_down

pytestmark = [pytest.mark.sitl, pytest.mark.timeout(600), pytest.mark.realtime]


def test_the_demonstration_flies_it(link: AutopilotLink, services: Services, tmp_path: Path) -> None:
    services.close()
    bring_down(link)
    link.until(lambda: link.ready, READY_S, "ready to be armed")
    done = companion(
        *("demo", "--output", tmp_path / "demo", "--vehicle-url", f"udpin://127.0.0.1:{link.service_port}"),
        cwd=tmp_path,
        timeout_s=400.0,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert link.grounded
    summary = json.loads((tmp_path / "demo" / "summary.json").read_text())
    assert summary["success"]
    assert summary["truth"] == "autopilot"
    figures = {"time_s": summary["duration_s"], "final_range_m": summary["final_range_m"]}
    FIGURES.setdefault(f"{NAMES[link.autopilot or 0]}, pymavlink", {})["demonstration"] = figures


def test_the_demonstration_is_refused_in_flight(flight: Flight, services: Services, tmp_path: Path) -> None:
    link = flight.link
    flight.take_off(3.0)
    flight.service.signal(signal.SIGTERM)
    assert flight.service.process.wait(20) == 0
    services.close()
    begun = len(link.commands)
    done = companion(
        *("demo", "--output", tmp_path / "demo", "--vehicle-url", f"udpin://127.0.0.1:{link.service_port}"),
        cwd=tmp_path,
    )
    assert done.returncode == 2, done.stdout + done.stderr
    (line,) = done.stderr.splitlines()
    assert "armed" in line
    asks_only = {dialect.MAV_CMD_REQUEST_MESSAGE, dialect.MAV_CMD_SET_MESSAGE_INTERVAL}
    assert {number for _, number in link.commands[begun:]} <= asks_only
