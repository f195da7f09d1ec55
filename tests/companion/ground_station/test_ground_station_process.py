"""The process beside a real service and the simulated vehicle, behind a router, with MAVSDK as the station.

The router has mavlink-router's rule: a message is never delivered to an endpoint that has itself sent with
its system and component id.
"""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import AsyncIterator, Callable
from contextlib import ExitStack, asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from mavsdk.asyncio.plugins.camera import CameraAsync, Mode

from mavlink_sim.testing import free_port, running_simulator
from tests.companion.mavlink_router import mavlink_router
from tests.companion.service_process import ServiceProcess, running_service
from tests.mavlink_sim.mavsdk_client import MavsdkClient, mavsdk_client, wait_for

pytestmark = [pytest.mark.realtime, pytest.mark.slow]

CAMERA_ID = 100
SERVICE, PROCESS, STATION = range(3)


@asynccontextmanager
async def flight(
    flags: list[str], folder: Path, *others: int
) -> AsyncIterator[tuple[ServiceProcess, MavsdkClient]]:
    """Vehicle, service with its ground station process, and MAVSDK, all behind one router.

    `others`: ports of further stations.
    """
    autopilot_port, station_port, service_port = (free_port() for _ in range(3))
    ports = [service_port, free_port(), station_port, *others]
    async with mavlink_router(autopilot_port, ports) as router:
        with ExitStack() as stack:
            simulator = running_simulator(onboard_port=autopilot_port)
            await asyncio.to_thread(stack.enter_context, simulator)
            own = [*flags, "--ground-station-url", f"udpout://127.0.0.1:{router.port(PROCESS)}"]
            service = running_service(service_port, own, cwd=folder)
            running = await asyncio.to_thread(stack.enter_context, service)
            async with mavsdk_client(f"udpin://127.0.0.1:{station_port}") as client:
                yield running, client


async def until(condition: Callable[[], object], timeout_s: float = 30.0) -> None:
    async with asyncio.timeout(timeout_s):
        while not condition():
            await asyncio.sleep(0.05)


async def found(camera: CameraAsync) -> Any:
    """The camera with its size, which is known after its first frame."""
    listed = await wait_for(
        camera.subscribe_camera_list(),
        lambda each: bool(each.cameras) and each.cameras[0].horizontal_resolution_px > 0,
    )
    return listed.cameras


async def test_mavsdk_finds_the_camera_and_takes_a_photo(filming: list[str], tmp_path: Path) -> None:
    recordings = tmp_path / "recordings"
    flags = [*filming, "--recording-directory", str(recordings)]
    async with flight(flags, tmp_path) as (service, client):
        camera = client.plugin(CameraAsync)
        (information,) = await found(camera)
        assert (information.component_id, information.vendor_name) == (CAMERA_ID, "companion")
        assert (information.horizontal_resolution_px, information.vertical_resolution_px) == (160, 120)

        await camera.set_mode(CAMERA_ID, Mode.VIDEO)
        assert await camera.get_mode(CAMERA_ID) == Mode.VIDEO
        storage = await wait_for(camera.subscribe_storage(), lambda each: each.storage.total_storage_mib > 0)
        assert 0 < storage.storage.available_storage_mib < storage.storage.total_storage_mib

        captures = camera.subscribe_capture_info()
        waiting = asyncio.create_task(wait_for(captures))
        await asyncio.sleep(0)  # the subscription begins
        await camera.take_photo(CAMERA_ID)
        capture = await waiting
        assert (capture.component_id, capture.is_success, capture.index) == (CAMERA_ID, True, 0)
        assert capture.position.latitude_deg == pytest.approx(47.4, abs=0.1)
        assert (recordings / capture.file_url).read_bytes()[:2] == b"\xff\xd8"

        await camera.start_video(CAMERA_ID)
        await until(lambda: list(recordings.glob("videos/*.webm")))
        await camera.stop_video(CAMERA_ID)
        await wait_for(camera.subscribe_storage(), lambda each: not each.storage.video_on)
        assert [
            line for line in service.last_lines() if "ground_station" in line and "open at" not in line
        ] == []


async def test_camera_answers_again_after_its_process_was_killed(filming: list[str], tmp_path: Path) -> None:
    async with flight(filming, tmp_path) as (service, client):
        camera = client.plugin(CameraAsync)
        assert len(await found(camera)) == 1
        opened = "ground_station: open at"
        await asyncio.to_thread(service.wait_for_line, opened)
        line = len(service.lines)
        os.kill(process_of_cameras(service), signal.SIGKILL)
        await asyncio.to_thread(service.wait_for_line, opened, after=line)
        await camera.set_mode(CAMERA_ID, Mode.VIDEO)


def process_of_cameras(service: ServiceProcess) -> int:
    """Process id of the cameras' process of a service."""
    (found,) = [pid for pid in _children(service.pid) if "companion.ground_station" in _command(pid)]
    return found


def _children(pid: int) -> list[int]:
    return [int(each) for each in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def _command(pid: int) -> str:
    return Path(f"/proc/{pid}/cmdline").read_text().replace("\0", " ")
