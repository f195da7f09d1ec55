"""The service starts with what is there, says what is missing, and uses it when it comes."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import socket
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import zenoh

from companion.bus.client import NoAnswerError, client_settings, open_client, send_command
from companion.perception.messages import StartFailed
from companion.perception.supervisor import PerceptionStartError
from companion.service import Service
from companion.settings import ZenohSection
from companion.settings.reading import load_settings
from companion.vehicle.driver import LinkError
from mavlink_sim.testing import QUICK_FLIGHT, free_port, running_simulator
from tests.companion.perception.scripted_worker import ScriptedWorker
from tests.companion.simulated_clock import SimulatedClock, run_simulated
from tests.companion.vehicle.fake_autopilot import FakeAutopilot

pytestmark = pytest.mark.realtime

ABSENT_S, MOST_LINES, FLYING_WITHIN_S = 600.0, 30, 10.0
# Until the vehicle is found, and its position is known.
NOT_YET = ("no autopilot yet", "no link", "vehicle state", "takeoff needs")
NO_CAMERA = StartFailed("/dev/video9: no such camera", wrong_settings=False)


def service_of(**changes: str) -> Service:
    """A service without a camera, on a zenoh port of its own."""
    settings = {
        "source.uri": "none",
        "detector.enabled": "false",
        "guidance.rate_hz": "5",
        "vehicle.url": f"udpin://127.0.0.1:{free_port()}",
        "zenoh.listen": f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}",
        **{key.replace("__", "."): value for key, value in changes.items()},
    }
    return Service(load_settings(os.devnull, settings, {}))


@contextlib.asynccontextmanager
async def running(service: Service) -> AsyncIterator[asyncio.Task[None]]:
    """Run the service until the end of the context; yields once it is ready."""
    ready = asyncio.Event()
    task = asyncio.create_task(service.run(ready.set))
    try:
        await asyncio.wait({task, asyncio.create_task(ready.wait())}, return_when=asyncio.FIRST_COMPLETED)
        if task.done():
            task.result()
        yield task
    finally:
        service.stop()
        await asyncio.gather(task, return_exceptions=True)


def states(service: Service) -> dict[str, str]:
    return {part["name"]: part["state"] for part in service.status()["parts"]}


def reason(service: Service, name: str) -> str:
    return next(part["reason"] for part in service.status()["parts"] if part["name"] == name)


def until_next_try_s(service: Service, name: str) -> float:
    (next_ns,) = (part["next_try_ns"] for part in service.status()["parts"] if part["name"] == name)
    return 0.0 if next_ns is None else (next_ns - time.monotonic_ns()) / 1e9


async def until(condition: Callable[[], object], within_s: float = 30.0) -> None:
    async with asyncio.timeout(within_s):
        while not condition():
            await asyncio.sleep(0.02)


async def test_without_a_vehicle_commands_are_refused_by_that() -> None:
    service = service_of(vehicle__url="none")
    async with running(service):
        reply = await service.command("takeoff 3")
        assert not reply["success"]
        assert "vehicle.url" in reply["reason"]
        assert states(service) == {"zenoh": "ready"}
        status = service.status()
        assert status["healthy"]
        assert status["vehicle"]["autopilot"] is None
        await service.parts.complete(1.0)


async def test_autopilot_is_used_when_it_comes() -> None:
    port = free_port()
    service = service_of(vehicle__url=f"udpin://127.0.0.1:{port}")
    async with running(service):
        assert states(service) == {"autopilot": "starting", "zenoh": "ready"}
        assert not service.status()["healthy"]
        await until(lambda: states(service)["autopilot"] == "missing")
        assert str(port) in reason(service, "autopilot")
        reply = await service.command("takeoff 3")
        assert reply["reason"].startswith("no autopilot yet: ")
        assert reason(service, "autopilot") in reply["reason"]
        autopilot = FakeAutopilot(port)
        autopilot.start()
        try:
            await service.parts.complete()
            assert (states(service)["autopilot"], reason(service, "autopilot")) == ("ready", "")
            assert "no autopilot yet" not in (await service.command("takeoff 3"))["reason"]
            await until(lambda: [e for e in service.events if e.text == "up: autopilot"])
        finally:
            await autopilot.stop()
        await until(lambda: [event for event in service.events if event.level == "error"])
        assert [e.text for e in service.events if e.level == "error"] == ["autopilot heartbeat lost"]
        assert states(service)["autopilot"] == "missing"


async def test_link_that_cannot_be_opened_is_retried() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        service = service_of(vehicle__url=f"udpin://127.0.0.1:{port}")
        async with running(service):
            await until(lambda: states(service)["autopilot"] == "retrying")
            assert "in use" in reason(service, "autopilot")
            with pytest.raises(LinkError, match="in use"):
                await service.parts.complete(10.0)
            taken.close()
            autopilot = FakeAutopilot(port)
            autopilot.start()
            await until(lambda: states(service)["autopilot"] == "ready")
            await autopilot.stop()


async def test_unsupported_autopilot_is_reported_and_not_lost() -> None:
    port = free_port()
    service = service_of(vehicle__url=f"udpin://127.0.0.1:{port}")
    other = FakeAutopilot(port, autopilot=0)
    async with running(service):
        other.start()
        await until(lambda: "PX4 and ArduPilot" in reason(service, "autopilot"))
        await other.stop()
        await asyncio.sleep(3.5)  # longer than a heartbeat is valid
        assert not [event for event in service.events if "heartbeat" in event.text and event.level == "error"]


async def test_missing_autopilot_ends_work_that_needs_it() -> None:
    service = service_of()
    async with running(service):
        with pytest.raises(LinkError):
            await service.parts.complete(0.5)


async def test_wrong_settings_of_a_camera_end_the_service(monkeypatch: pytest.MonkeyPatch) -> None:
    worker = ScriptedWorker.install(monkeypatch)
    worker.fails = StartFailed("no class 'zebra'", wrong_settings=True)
    service = service_of(vehicle__url="none", source__uri="/dev/video9")
    with pytest.raises(PerceptionStartError, match="zebra"):
        await asyncio.wait_for(service.run(), 20.0)


async def test_wrong_settings_do_not_end_it_while_armed(monkeypatch: pytest.MonkeyPatch) -> None:
    worker = ScriptedWorker.install(monkeypatch)
    worker.fails = StartFailed("no class 'zebra'", wrong_settings=True)
    monkeypatch.setattr("tests.companion.perception.scripted_worker.LOADING_S", 3.0)
    port = free_port()
    service = service_of(vehicle__url=f"udpin://127.0.0.1:{port}", source__uri="/dev/video9")
    autopilot = FakeAutopilot(port)
    autopilot.base_mode |= 128  # armed
    autopilot.start()
    try:
        async with running(service) as task:
            await until(lambda: [event for event in service.events if "after disarming" in event.text])
            assert not task.done()
            autopilot.base_mode &= ~128
            with pytest.raises(PerceptionStartError, match="zebra"):
                await asyncio.wait_for(task, 20.0)
    finally:
        await autopilot.stop()


@pytest.mark.timeout(180)
@pytest.mark.parametrize("absent", ["autopilot", "camera", "zenoh"])
def test_part_absent_for_ten_minutes(
    absent: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    """On a simulated clock; the vehicle comes with the part, in real time."""
    caplog.set_level(logging.INFO)
    clock, port = SimulatedClock(), free_port()
    router = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    worker = ScriptedWorker.install(monkeypatch)
    changes = {"vehicle__url": f"udpin://127.0.0.1:{port}"}
    if absent == "camera":
        worker.fails = NO_CAMERA
        changes |= {"source__uri": "/dev/video9"}
    if absent == "zenoh":
        changes |= {"zenoh__mode": "client", "zenoh__connect": router, "zenoh__listen": ""}
    service = service_of(**changes)

    async def take_off(through: ZenohSection) -> dict[str, Any]:
        """As a program does that repeats the command until the position is known."""

        def send() -> dict[str, Any]:
            with open_client(client_settings(through), timeout_s=15.0) as session:
                while True:
                    with contextlib.suppress(NoAnswerError):  # the service is not connected yet
                        reply = send_command(session, "vehicle1", "takeoff 2.5", timeout_s=60.0)
                        if reply["success"] or not reply["reason"].startswith(NOT_YET):
                            return reply
                    time.sleep(0.2)

        return await asyncio.to_thread(send)

    async def work() -> None:
        async with running(service) as task:
            await asyncio.sleep(ABSENT_S)
            assert not task.done()
            lines = [record.getMessage() for record in caplog.records if record.name.startswith("companion")]
            assert len(lines) <= MOST_LINES, lines
            assert states(service)[absent] in ("missing", "failed")
            assert reason(service, absent)
            worker.fails = None
            # A camera is tried every half minute: nearly all of that passes on the simulated clock too.
            while until_next_try_s(service, absent) > 1.0:
                await asyncio.sleep(0.5)
            clock.run_in_real_time()
            with contextlib.ExitStack() as stack:
                config = zenoh.Config()
                config.insert_json5("mode", '"router"')
                config.insert_json5("listen/endpoints", f'["{router}"]')
                if absent == "zenoh":
                    stack.enter_context(await asyncio.to_thread(zenoh.open, config))
                vehicle = running_simulator(onboard_port=port, ready_after=0.0, parameters=QUICK_FLIGHT)
                await asyncio.to_thread(stack.enter_context, vehicle)
                flying = asyncio.create_task(take_off(service.settings.zenoh))
                await until(lambda: service.driver.state.armed, FLYING_WITHIN_S)
                assert (await flying)["success"]
                await until(lambda: states(service)[absent] == "ready", 45.0)

    run_simulated(monkeypatch, clock, work())


async def test_targets_of_a_camera_that_is_gone_are_not_shown() -> None:
    service = service_of(vehicle__url="none")
    (camera,) = service.cameras
    camera.targets, camera.localization_error = (Mock(), Mock()), "no attitude"
    camera.seen_ns = time.monotonic_ns()
    assert service.status()["targets"] == {"camera": None, "count": 2, "localization_error": "no attitude"}
    camera.seen_ns -= 5_000_000_000
    assert service.status()["targets"] == {"camera": None, "count": 0, "localization_error": ""}


async def test_station_link_is_a_part_that_names_a_port_in_use() -> None:
    """And is tried again; nothing else waits for it."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        url = f"udpin://127.0.0.1:{taken.getsockname()[1]}"
        service = service_of(vehicle__url="none", ground_station__url=url)
        async with running(service):
            await service.parts.complete(1.0)
            await until(lambda: url in reason(service, "ground_station"))
            assert states(service)["ground_station"] == "retrying"


async def test_recorder_is_a_part_that_waits_for_its_folder(tmp_path: Path) -> None:
    """And nothing else waits for it."""
    (tmp_path / "recordings").write_text("no folder")
    service = service_of(vehicle__url="none", recording__directory=str(tmp_path / "recordings"))
    async with running(service):
        await service.parts.complete(1.0)
        await until(lambda: "paused" in reason(service, "recorder"))
        assert states(service)["recorder"] == "retrying"
        assert str(tmp_path / "recordings") in service.parts.missing_text()
        (tmp_path / "recordings").unlink()
        await until(lambda: states(service)["recorder"] == "ready")
        assert list((tmp_path / "recordings").glob("*.mcap"))
    assert states(service)["recorder"] == "ready"
