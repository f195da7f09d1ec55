"""A fault in a task of the service, of any part, is shown, and the task runs again."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import importlib
import inspect
import socket
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import zenoh

from companion.bus.client import client_settings, open_client
from mavlink_sim.testing import free_port
from tests.companion.perception.scripted_worker import ScriptedWorker
from tests.companion.service.test_parts import reason, running, service_of, states, until
from tests.companion.vehicle.fake_autopilot import FakeAutopilot

pytestmark = pytest.mark.realtime

FAULTS = 2


class FaultOfATestError(Exception):
    """What nobody has foreseen."""


class Faulty:
    """A function that raises at its first calls.

    Attributes:
        calls: so far.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch, path: str) -> None:
        module, _, names = path.partition(":")
        *owners, name = names.split(".")
        owner: Any = importlib.import_module(module)
        for part in owners:
            owner = getattr(owner, part)
        self._original = getattr(owner, name)
        self.calls = 0
        monkeypatch.setattr(owner, name, self._wrapper())

    def _wrapper(self) -> Any:
        original = self._original

        @functools.wraps(original)
        def call(*arguments: Any, **named: Any) -> Any:
            self.calls += 1
            if self.calls <= FAULTS:
                raise FaultOfATestError("of a test")
            return original(*arguments, **named)

        @functools.wraps(original)
        async def call_later(*arguments: Any, **named: Any) -> Any:
            return await call(*arguments, **named)

        return call_later if inspect.iscoroutinefunction(original) else call


@dataclass(frozen=True)
class Case:
    """What fails: its function, and the part that shows it; None: an event or the log does."""

    path: str
    part: str | None = None


CASES = {
    "status": Case("companion.service.service:status_message"),
    "vehicle messages": Case("companion.service.publisher:Publisher._publish_vehicle"),
    "health": Case("companion.service.health:Health.check"),
    "connection": Case("companion.vehicle.pymavlink_driver:PymavlinkDriver.connect", "autopilot"),
    "supervision of the link": Case("companion.vehicle.autopilot_driver:AutopilotDriver._supervise"),
    "clock of the link": Case("companion.vehicle.autopilot_driver:AutopilotDriver._synchronise"),
    "streams of the link": Case("companion.vehicle.stream_requests:StreamRequests.run"),
    "search for a gimbal": Case("companion.vehicle.gimbal_commands:GimbalCommands.run"),
    "zenoh": Case("companion.bus.session:Bus._declare_all", "zenoh"),
    "messages of the worker": Case("companion.perception.supervisor:PerceptionSupervisor._read", "camera"),
    "calibration of a camera": Case("companion.perception.cameras:WorkerCamera._adopt", "camera"),
    "end of a worker": Case(
        "companion.perception.supervisor:PerceptionSupervisor._selection_ended", "camera"
    ),
    "recorder": Case("companion.host.child_process:_run_once", "recorder"),
    "steps for the recorder": Case("companion.recording.tap:FlightTap._publish"),
}


@contextlib.contextmanager
def router() -> Iterator[str]:
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", f'["{endpoint}"]')
    with zenoh.open(config):
        yield endpoint


@pytest.mark.parametrize("name", CASES)
async def test_fault_is_shown_and_its_task_runs_again(
    name: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    case, port = CASES[name], free_port()
    worker = ScriptedWorker.install(monkeypatch)
    monkeypatch.setattr("tests.companion.perception.scripted_worker.LOADING_S", 0.2)
    faulty = Faulty(monkeypatch, case.path)
    autopilot = FakeAutopilot(port)
    changes = {"vehicle__url": f"udpin://127.0.0.1:{port}", "source__uri": "/dev/video9"}
    with router() as endpoint:
        if case.part == "zenoh":
            changes |= {"zenoh__mode": "client", "zenoh__connect": endpoint, "zenoh__listen": ""}
        if case.part == "recorder":
            changes |= {"recording__directory": str(tmp_path)}
        service = service_of(**changes)
        async with running(service) as task:
            autopilot.start()
            try:
                for _ in range(FAULTS if name == "end of a worker" else 0):
                    calls = faulty.calls
                    await until(lambda: states(service)["camera"] == "ready")
                    worker.started[-1].kill()
                    await until(lambda: faulty.calls > calls)  # noqa: B023 - awaited here
                if case.part is not None:
                    part = case.part
                    if part != "zenoh":  # whose reason is that nothing is delivered
                        await until(lambda: "FaultOfATestError" in reason(service, part))
                    await until(lambda: states(service)[part] == "ready")
                    assert reason(service, part) == ""
                if name != "end of a worker":
                    await until(lambda: faulty.calls > FAULTS)
                assert not task.done()
                texts = [event.text for event in service.events]
                shown = [text for text in (*texts, caplog.text) if "FaultOfATestError: of a test" in text]
                assert shown
                if case.part is None or case.part == "zenoh":
                    await until(lambda: service.bus.published["vehicle"] > 0)
            finally:
                await autopilot.stop()


async def test_fault_in_a_query_is_answered(monkeypatch: pytest.MonkeyPatch) -> None:
    service = service_of(vehicle__url="none")

    async def faulty() -> None:
        raise FaultOfATestError("of a test")

    service.bus._queries["status"] = faulty
    async with running(service):
        with open_client(client_settings(service.settings.zenoh)) as session:
            replies = await asyncio.to_thread(
                lambda: list(session.get("companion/vehicle1/status", timeout=5.0))
            )
        assert [reply.err is not None for reply in replies] == [True]
