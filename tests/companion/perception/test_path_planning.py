"""Paths planned in the perception worker, from depth and pose to the service."""

from __future__ import annotations

import asyncio
import math
import os
import secrets
import time

import numpy as np
import pytest

from companion.host.clock import StandstillWatch
from companion.perception.path_planning import PathPlanning, PositionHistory
from companion.perception.supervisor import PerceptionSupervisor
from companion.settings.reading import load_settings
from companion.vehicle.state import Vector3
from vision.camera_model import CameraModel, CameraMount
from vision.frame import Frame
from vision.path_planner import PathRequest, PlannedPath
from vision.shared_frame import SharedFrameWriter

LEVEL = (1.0, 0.0, 0.0, 0.0)
CAMERA = CameraModel.from_horizontal_fov(160, 120, math.radians(80.0))
POSITION: Vector3 = (100.0, -40.0, -3.0)
REQUEST = PathRequest(((100.0, -40.0), (112.0, -40.0)), 1.3, number=7)
TENTH_NS = 100_000_000


def pillar(captured_ns: int, sequence: int = 0) -> Frame:
    """A pillar 1 m wide, 6 m ahead, in the middle of the image; nothing else within 50 m."""
    depth_m = np.full((CAMERA.height, CAMERA.width), 50.0, np.float32)
    half = round(0.5 / 6.0 * CAMERA.fx)
    depth_m[:, CAMERA.width // 2 - half : CAMERA.width // 2 + half] = 6.0
    image = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
    return Frame(image, captured_ns, sequence, depth_m)


def planning_at(position: Vector3 | None = POSITION) -> PathPlanning:
    positions = PositionHistory()
    if position is not None:
        positions.add(1, position)
    return PathPlanning(
        positions, lambda stamp_ns: (CameraMount(), np.eye(3)), lambda width, height: CAMERA, lambda: 3.0
    )


def aside_m(path: PlannedPath) -> float:
    return max(abs(east - POSITION[1]) for _, east in path.points)


def test_position_is_interpolated_and_none_outside_the_history() -> None:
    history = PositionHistory()
    assert history.at(0) is None
    history.add(1000, (0.0, 0.0, -2.0))
    history.add(2000, (1.0, 2.0, -3.0))
    history.add(1500, (9.0, 9.0, 9.0))  # late: ignored
    assert history.at(1250) == pytest.approx((0.25, 0.5, -2.25))
    assert history.newest == (1.0, 2.0, -3.0)
    assert history.at(2000 + TENTH_NS) == (1.0, 2.0, -3.0)
    assert history.at(2000 + 3 * TENTH_NS) is None
    assert history.at(999) is None


def test_path_leads_around_what_the_depth_shows() -> None:
    planning = planning_at()
    paths = []
    for step in range(8):
        now_ns = TENTH_NS * (step + 1)
        planning.request(REQUEST, now_ns)
        paths.append(planning.update(pillar(1 + step), now_ns))
    path = paths[-1]
    assert path is not None
    assert aside_m(path) > 1.3
    assert (path.number, path.reason, path.captured_ns) == (7, "", 8)
    assert path.points[0] == POSITION[:2]


def test_nothing_is_planned_without_a_recent_request_or_pose() -> None:
    planning = planning_at()
    assert planning.update(pillar(1), TENTH_NS) is None
    planning.request(REQUEST, 2 * TENTH_NS)
    assert planning.update(pillar(2), 2 * TENTH_NS) is not None
    assert planning.update(pillar(3), 2 * TENTH_NS + 10_000_000) is None  # not due
    assert planning.update(pillar(4), 8 * TENTH_NS) is None  # not repeated
    nowhere = planning_at(None)
    nowhere.request(REQUEST, TENTH_NS)
    assert nowhere.update(pillar(1), TENTH_NS) is None


def test_map_begins_again_after_a_suspend() -> None:
    suspended_ns, now_ns = [0], [TENTH_NS]
    positions = PositionHistory()
    positions.add(1, POSITION)
    planning = PathPlanning(
        positions,
        lambda stamp_ns: (CameraMount(), np.eye(3)),
        lambda width, height: CAMERA,
        lambda: 3.0,
        watch=StandstillWatch(lambda: now_ns[0] + suspended_ns[0], lambda: now_ns[0]),
    )
    planning.request(REQUEST, TENTH_NS)
    grid = planning.grid
    assert planning.update(pillar(1), now_ns[0]) is not None
    now_ns[0] += 5_000_000_000  # the camera paused
    planning.update(pillar(2), now_ns[0])
    assert planning.grid is grid
    suspended_ns[0] = 30_000_000_000
    planning.request(REQUEST, now_ns[0])
    assert planning.update(pillar(3), now_ns[0]) is None
    assert planning.grid is not grid
    assert positions.newest is None


@pytest.mark.parametrize(("rate_hz", "least", "most"), [(6.0, 11, 13), (10.0, 19, 21), (30.0, 19, 21)])
def test_path_is_replanned_with_images_up_to_10_times_a_second(rate_hz: float, least: int, most: int) -> None:
    planning, plans = planning_at(), 0
    for step in range(round(2.0 * rate_hz)):
        now_ns = round((step + 1) / rate_hz * 1e9)
        planning.request(REQUEST, now_ns)
        plans += planning.update(pillar(1 + step), now_ns) is not None
    assert least <= plans <= most


@pytest.mark.realtime
async def test_worker_process_plans_and_sends_the_path() -> None:
    name = f"avoid-{secrets.token_hex(4)}"
    values = {
        "source.uri": f"shm://{name}",
        "source.open_timeout_s": "30",
        "detector.enabled": "false",
        "camera.horizontal_fov_deg": "80",
        "camera.mount_pitch_deg": "0",
        "guidance.obstacles": "required",
        "guidance.avoid": "true",
    }
    paths: list[PlannedPath] = []
    results: list[object] = []
    supervisor = PerceptionSupervisor(
        load_settings(os.devnull, values, {}),
        on_result=results.append,
        on_event=lambda *_: None,
        on_path=paths.append,
    )
    with SharedFrameWriter(name, CAMERA.width, CAMERA.height, depth=True) as writer:

        async def feed() -> None:
            sequence = 0
            while True:
                now_ns = time.monotonic_ns()
                supervisor.send_attitude(now_ns, LEVEL, 3.0, (now_ns, POSITION))
                writer.write(pillar(now_ns - 20_000_000, sequence))
                if results:
                    supervisor.request_path(REQUEST)
                sequence += 1
                await asyncio.sleep(0.05)

        feeding = asyncio.create_task(feed())
        try:
            await supervisor.start()
            async with asyncio.timeout(60.0):
                while len(paths) < 8:
                    await asyncio.sleep(0.02)
        finally:
            feeding.cancel()
            await supervisor.stop()
    assert aside_m(paths[-1]) > 1.3
    assert (paths[-1].number, paths[-1].reason) == (7, "")
    stamps = [path.captured_ns for path in paths]
    assert stamps == sorted(set(stamps))
