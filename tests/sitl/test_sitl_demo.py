"""A camera rendered from the pose of the autopilot at COMPANION_SITL_URL: alone, `play` and `demo`."""

from __future__ import annotations

import json
import math
import secrets
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from mavlink_sim.wire.messages import dialect
from tests.companion.command_line import companion
from tests.companion.simulation.test_play import playing
from tests.sitl.conftest import Services
from tests.sitl.sitl_harness import FIGURES, NAMES, OFFBOARD, PX4, READY_S, AutopilotLink, Flight, bring_down

pytestmark = [pytest.mark.sitl, pytest.mark.timeout(600), pytest.mark.realtime]

SMALL = """
[ground]
kinds = ["concrete"]
tile_texels = 256
texel_m = 0.05
[camera]
width = 160
height = 120
"""
STOPPED = "stopped 3 s ago"
# Of the lens before the vehicle's centre, in every scene that sets none; the least height of the lens.
AHEAD_M, LOWEST_M = 0.12, 0.05
PX4_TAKEOFF, TAKEOFF_M = 4 << 16 | 2 << 24, 3.0


@pytest.fixture
def scene(tmp_path: Path) -> str:
    """One that is made and rendered quickly."""
    path = tmp_path / "small.toml"
    path.write_text(SMALL)
    return str(path)


def make_ready(link: AutopilotLink, services: Services) -> None:
    """On the ground, ready to be armed, and without a service."""
    bring_down(link)
    services.flight(None)  # ArduPilot says that it is ready only where it was asked to
    link.until(lambda: link.ready, READY_S, "ready to be armed")
    services.close()


def take_off_by_a_pilot(link: AutopilotLink) -> None:
    """Without a service."""
    arm = dialect.MAV_CMD_COMPONENT_ARM_DISARM
    if link.autopilot == PX4:
        link.set_mode(PX4_TAKEOFF)
        link.command(arm, 1)
    else:
        link.set_mode(OFFBOARD[link.autopilot or 0])
        link.until(lambda: link.offboard, 5.0, "in GUIDED")
        link.command(arm, 1)
        link.until(lambda: link.armed, 5.0, "armed")
        link.command(dialect.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, TAKEOFF_M)


def test_a_camera_moves_with_the_vehicle_and_ends_with_its_pose(
    link: AutopilotLink, services: Services, scene: str, tmp_path: Path
) -> None:
    make_ready(link, services)
    seen = tmp_path / "seen.jsonl"
    command = [sys.executable, "-m", "mavlink_sim", "camera", "--camera", f"sitl-{secrets.token_hex(6)}"]
    command += ["--vehicle-url", f"udpin://127.0.0.1:{link.service_port}", "--origin", "0,0,0"]
    command += ["--scene", scene, "--camera-rate", "10", "--camera-truth", str(seen)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        next(line for line in iter(process.stdout.readline, "") if line.startswith("ready: "))
        take_off_by_a_pilot(link)
        link.until(lambda: link.height_m > 1.5, 30.0, "in the air")
        cut_s, link.cut = time.monotonic(), True
        _, errors = process.communicate(timeout=30.0)
        ended_s = time.monotonic() - cut_s
    finally:
        process.kill()
        bring_down(link)
    assert process.returncode == 1
    assert STOPPED in errors.splitlines()[-1]
    frames = [json.loads(line) for line in seen.read_text().splitlines()]
    assert frames[-1]["stamp_ns"] / 1e9 < cut_s + 0.1
    distances, heights = [], []
    for frame in frames:
        (pose, *_) = link.trajectory(frame["stamp_ns"] / 1e9)
        north, east, down = pose.position_ned_m
        ahead = (north + AHEAD_M * math.cos(pose.yaw_rad), east + AHEAD_M * math.sin(pose.yaw_rad))
        distances.append(math.dist(frame["camera_ned_m"], (*ahead, min(down, -LOWEST_M))))
        heights.append(-frame["camera_ned_m"][2])
    p95_m = float(np.percentile(distances, 95))
    assert p95_m < 0.15
    assert max(heights) - min(heights) > 1.0
    figures = {"pose_error_p95_m": round(p95_m, 3), "climbed_m": round(max(heights) - min(heights), 2)}
    figures["ended_after_s"] = round(ended_s, 2)
    FIGURES.setdefault(f"{NAMES[link.autopilot or 0]}, no driver", {})["camera"] = figures


def test_play_flies_it_and_ends_with_its_pose(
    link: AutopilotLink, services: Services, scene: str, tmp_path: Path
) -> None:
    make_ready(link, services)
    flags = ["--vehicle-url", f"udpin://127.0.0.1:{link.service_port}", "--scene", scene]
    flags += ["--detector-enabled", "false", "--guidance-min-battery-percent", "0"]
    try:
        with playing(tmp_path, *flags) as running:
            running.take_off(TAKEOFF_M)
            assert link.height_m == pytest.approx(TAKEOFF_M, abs=0.7)
            link.cut = True
            line = running.wait_for_line("companion: the simulator or its camera ended", 30.0)
            assert STOPPED in line
            assert running.process.wait(30.0) == 1
    finally:
        bring_down(link)


def test_the_demonstration_flies_it(link: AutopilotLink, services: Services, tmp_path: Path) -> None:
    make_ready(link, services)
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
