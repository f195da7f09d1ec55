"""The whole service before a wall or a pillar: rendered depth, zenoh, MAVLink, and collisions."""

from __future__ import annotations

import json
import os
import signal
import time
import uuid
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from mavlink_sim.testing import QUICK_FLIGHT, RunningSimulator, running_simulator
from tests.companion.service_process import ServiceProcess, running_service

pytestmark = pytest.mark.realtime

WALL_NORTH_M, THICKNESS_M, MARGIN_M = 9.0, 0.4, 2.0
# As for `python -m benchmarks.flights obstacles`: gusts push it a little into the margin.
ALLOWED_M = 1.0
SCENE = """
name = "obstacle"
[ground]
kinds = ["gravel"]
tile_texels = 256
texel_m = 0.05
[[objects]]
class = "{kind}"
place_m = [{north_m}, 0.2]
yaw_deg = 180
size_m = {size_m}
[camera]
width = 240
height = 180
horizontal_fov_deg = 80
rate_hz = 6
[camera.mount]
pitch_deg = 0
"""


class Truth:
    """The simulator's truth file, read as it grows."""

    def __init__(self, path: Path) -> None:
        self.rows: list[dict[str, Any]] = []
        self._file, self._rest = path.open(), ""

    def wait_for(self, condition: Any, timeout_s: float = 30.0) -> dict[str, Any]:
        """Wait for the first new row that meets the condition."""
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline:
            *lines, self._rest = (self._rest + self._file.read()).split("\n")
            for line in lines:
                row: dict[str, Any] = json.loads(line)
                self.rows.append(row)
                if condition(row):
                    return row
            time.sleep(0.02)
        raise TimeoutError(f"never true; the last row: {self.rows[-1:]}")


def camera_pid(simulator_pid: int) -> int:
    """Process id of the renderer: the simulator's youngest child."""
    children = Path(f"/proc/{simulator_pid}/task/{simulator_pid}/children").read_text().split()
    return max(map(int, children))


@contextmanager
def in_the_air(
    folder: Path, scene_text: str, *flags: str
) -> Iterator[tuple[RunningSimulator, ServiceProcess, Truth]]:
    """The service with a vehicle 2.5 m above the ground, south of the obstacle."""
    scene, path = folder / "scene.toml", folder / "truth.jsonl"
    scene.write_text(scene_text)
    camera = f"obstacle-{uuid.uuid4().hex[:8]}"
    flags = (
        "--source-uri", f"shm://{camera}", "--detector-enabled", "false",
        "--camera-horizontal-fov-deg", "80", "--camera-mount-pitch-deg", "0",
        "--guidance-obstacles", "required", *flags,
    )  # fmt: skip
    with (
        running_simulator(
            scene=scene, camera=camera, truth=path, ready_after=0.0, seed=2, parameters=QUICK_FLIGHT
        ) as simulator,
        running_service(simulator.onboard_port, flags, cwd=folder) as service,
    ):
        simulator.wait_for_event("camera")
        service.take_off(2.5)
        yield simulator, service, Truth(path)


def north_m(row: dict[str, Any]) -> float:
    return float(row["position_ned_m"][0])


@pytest.mark.slow  # in lockstep: `test_avoidance_flights`
def test_flies_around_a_pillar_to_the_goal(tmp_path: Path) -> None:
    scene = SCENE.format(kind="box", north_m=6.0, size_m=[1.0, 1.0, 6.0])
    flags = ("--guidance-avoid", "true", "--guidance-obstacle-margin-m", "1")
    with in_the_air(tmp_path, scene, *flags) as (_, service, truth):
        reply = service.command_when_it_can("goto north=9 east=0 speed=2", 90.0)
        assert reply["success"], reply
        last = truth.wait_for(lambda row: north_m(row) > 8.0)
        assert last["collisions"] == 0
        passing = [row["position_ned_m"][:2] for row in truth.rows if 5.0 < north_m(row) < 7.0]
        assert min(abs(east - 0.2) for _, east in passing) > 0.5 + 0.6  # half its width


def test_brakes_before_a_wall_and_without_depth(tmp_path: Path) -> None:
    scene = SCENE.format(kind="wall", north_m=WALL_NORTH_M, size_m=[30.0, THICKNESS_M, 6.0])
    flags = ("--guidance-obstacle-margin-m", f"{MARGIN_M}")
    with in_the_air(tmp_path, scene, *flags) as (simulator, service, truth):

        def north_mps(row: dict[str, Any]) -> float:
            return float(row["velocity_ned_mps"][0])

        with ThreadPoolExecutor(2) as operators:
            there = operators.submit(service.command_when_it_can, "goto north=40 east=0 speed=3", 90.0)
            truth.wait_for(lambda row: north_mps(row) > 1.5)
            stands = truth.wait_for(lambda row: north_m(row) > 5.0 and abs(north_mps(row)) < 0.3)
            truth.wait_for(lambda row: row["stamp_ns"] > stands["stamp_ns"] + 3e9)
            assert WALL_NORTH_M - THICKNESS_M / 2 - max(map(north_m, truth.rows)) >= MARGIN_M - ALLOWED_M
            assert truth.rows[-1]["collisions"] == 0
            assert truth.rows[-1]["mode"] == "OFFBOARD"
            assert not there.done()  # it waits for a free path

            # It may fly away from the wall; then the images stop.
            back = operators.submit(service.command_when_it_can, "goto north=-150 east=0 speed=3", 90.0)
            truth.wait_for(lambda row: north_mps(row) < -1.5)
            assert not there.result(10.0)["success"]
            os.kill(camera_pid(simulator.pid), signal.SIGSTOP)
            dark_ns = time.monotonic_ns()
            try:
                braked = truth.wait_for(lambda row: row["stamp_ns"] > dark_ns and abs(north_mps(row)) < 0.4)
                assert north_m(braked) > -50.0  # far from where it was sent
                assert braked["mode"] == "OFFBOARD"
                assert not back.done()
                service.wait_for_line("WARNING companion.service: braking: ")
            finally:
                os.kill(camera_pid(simulator.pid), signal.SIGCONT)
            truth.wait_for(lambda row: row["stamp_ns"] > braked["stamp_ns"] and north_mps(row) < -1.0)
            assert service.command("hold")["success"]
            assert not back.result(10.0)["success"]
