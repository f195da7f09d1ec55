"""What the demonstration does when its mission fails, its page, and its video."""

from __future__ import annotations

import asyncio
import re
import socket
import threading
import urllib.request
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import zenoh
from numpy.typing import NDArray

from companion.bus.config import zenoh_config
from companion.service import Service
from companion.settings import Settings, ZenohSection
from companion.simulation import demo
from companion.simulation.session import session_settings
from companion.vehicle.state import LandedState, VehicleState
from mavlink_sim.testing import free_port
from vision.detections import Detections
from vision.frame import Frame
from vision.recording import Recording
from vision.video_writer import VideoWriter

FLYING = VehicleState(armed=True, ready_to_arm=True, landed=LandedState.IN_AIR)
LANDED = VehicleState(ready_to_arm=True, landed=LandedState.ON_GROUND)


class Driver:
    """A vehicle that is ready to be armed."""

    state = FLYING

    def subscribe(self, callback: Callable[[VehicleState], None]) -> Callable[[], None]:
        callback(self.state)
        return lambda: None


class FailingService:
    """Its missions fail in the air; a return lands."""

    def __init__(self, *, in_command: bool) -> None:
        self.driver, self.guidance = Driver(), SimpleNamespace(in_command=in_command)
        self.commands: list[str] = []

    async def command(self, text: str) -> dict[str, Any]:
        self.commands.append(text)
        if text == "rtl":
            self.driver.state = LANDED
        return {"success": text == "rtl", "reason": "battery 14%", "steps": []}


@pytest.mark.parametrize("in_command", [True, False])
async def test_a_failed_demo_returns_unless_the_pilot_flies(in_command: bool) -> None:
    service, flight = FailingService(in_command=in_command), demo._Flight()
    await demo._mission(cast(Service, service), flight)
    assert service.commands[1:] == (["rtl"] if in_command else [])
    assert flight.failure is not None
    assert flight.failure.startswith("battery 14%")
    assert flight.on_ground is flight.ended is in_command


@pytest.mark.parametrize("video_rate_hz", [demo._CAMERA_RATE_HZ, demo._SLOW_VIDEO_RATE_HZ])
def test_video_of_the_demo_misses_no_image(
    video_rate_hz: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frames come at the camera's rate, and the writer keeps up: each waits for the one before."""
    video = tmp_path / demo.VIDEO_NAME
    section = session_settings(14540, "none", video=video, video_rate_hz=video_rate_hz).recording
    assert section.video == str(video)
    added, writers = threading.Semaphore(0), []

    class Writer(VideoWriter):
        def write(self, image: NDArray[np.uint8], captured_ns: int) -> int:
            slots = super().write(image, captured_ns)
            writers.append(self)
            added.release()
            return slots

    monkeypatch.setattr("vision.recording.VideoWriter", Writer)
    recording = Recording(section.video, section.rate_hz)
    image, nothing = np.full((480, 640, 3), 90, np.uint8), Detections.empty(("car",))
    rng = np.random.default_rng(1)
    taken = 0
    for sequence in range(54):
        # A fifth of the period early or late.
        at_s = (sequence + rng.uniform(-0.2, 0.2)) / demo._CAMERA_RATE_HZ
        recording.write(Frame(image, 10**9 + round(at_s * 1e9), sequence), nothing)
        if recording._next_slot > taken:
            taken = recording._next_slot
            assert added.acquire(timeout=30.0)
    recording.close()
    assert recording.skipped == 0
    assert (writers[-1].repeated, writers[-1].frames) == (0, taken)
    assert abs(taken - 54 * video_rate_hz / demo._CAMERA_RATE_HZ) <= 1


async def test_demo_prints_the_address_of_its_page_which_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    bus = ZenohSection(listen=(f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}",))
    settings = Settings(zenoh=bus)
    assert settings.dashboard.listen == "127.0.0.1:8088"  # on by default
    port = free_port(socket.SOCK_STREAM)
    page = settings.dashboard.model_copy(update={"listen": f"127.0.0.1:{port}"})
    said: asyncio.Queue[str] = asyncio.Queue()
    answers: list[tuple[int, bytes]] = []

    async def mission(_service: object, _flight: object) -> None:
        found = re.search(r"http://[\d.:]+/", await asyncio.wait_for(said.get(), 30.0))
        assert found is not None
        assert found[0] == f"http://127.0.0.1:{port}/"
        answer = await asyncio.to_thread(urllib.request.urlopen, found[0], timeout=10.0)
        answers.append((answer.status, answer.read()))

    monkeypatch.setattr(demo, "_mission", mission)
    service = SimpleNamespace(settings=settings.model_copy(update={"dashboard": page}))
    with zenoh.open(zenoh_config(bus)):
        await demo._watched_mission(cast(Service, service), demo._Flight(), said.put_nowait)
    ((status, html),) = answers
    assert status == 200
    assert b"<title>" in html
