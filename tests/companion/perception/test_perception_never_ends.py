"""A worker is tried without end, on a simulated clock: quickly at first, then every 30 s."""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import Callable

import pytest

from companion.host.restarts import LATER_S
from companion.perception.messages import StartFailed
from companion.perception.supervisor import PerceptionStartError, PerceptionState, PerceptionSupervisor
from companion.settings.reading import load_settings
from tests.companion.perception.scripted_worker import LOADING_S, ScriptedWorker
from tests.companion.simulated_clock import SimulatedClock, run_simulated

NO_CAMERA = StartFailed("/dev/video9: no such camera", wrong_settings=False)


@pytest.fixture
def worker(monkeypatch: pytest.MonkeyPatch) -> type[ScriptedWorker]:
    return ScriptedWorker.install(monkeypatch)


class Watched(PerceptionSupervisor):
    """A supervisor with the events that it has reported."""

    def __init__(self) -> None:
        self.events: list[tuple[str, str]] = []
        super().__init__(
            load_settings(os.devnull, {"detector.enabled": "false"}, {}),
            on_result=lambda _: None,
            on_event=lambda *event: self.events.append(event),
        )


async def until(condition: Callable[[], object], within_s: float) -> None:
    async with asyncio.timeout(within_s):
        while not condition():
            await asyncio.sleep(0.1)


def test_worker_killed_20_times_in_60_s_runs_again(
    worker: type[ScriptedWorker], monkeypatch: pytest.MonkeyPatch
) -> None:
    async def work() -> None:
        supervisor = Watched()
        await supervisor.start()
        for _ in range(20):
            if worker.started[-1].is_ready:
                worker.started[-1].kill()
            await asyncio.sleep(3.0)
        assert supervisor.state is PerceptionState.FAILED
        assert "killed by SIGKILL" in supervisor.problem
        await until(lambda: supervisor.state is PerceptionState.RUNNING, 60.0)
        assert supervisor.problem == ""
        worker.started[-1].kill()  # at once again: still slow
        await until(lambda: supervisor.state is PerceptionState.FAILED, 1.0)
        await until(lambda: supervisor.state is PerceptionState.RUNNING, LATER_S + LOADING_S + 1.0)
        await asyncio.sleep(2 * LATER_S)
        worker.started[-1].kill()  # after a while: quickly again
        await until(lambda: supervisor.state is PerceptionState.RESTARTING, 1.0)
        await until(lambda: supervisor.state is PerceptionState.RUNNING, LOADING_S + 1.0)
        await supervisor.stop()

    run_simulated(monkeypatch, SimulatedClock(), work())


def test_missing_source_is_waited_for_in_few_lines(
    worker: type[ScriptedWorker], monkeypatch: pytest.MonkeyPatch
) -> None:
    async def work() -> None:
        worker.fails = NO_CAMERA
        supervisor = Watched()
        starting = asyncio.create_task(supervisor.start())
        await asyncio.sleep(600.0)
        assert not starting.done()
        assert (supervisor.state, supervisor.problem) == (PerceptionState.FAILED, NO_CAMERA.text)
        assert len(supervisor.events) < 12
        levels = [level for level, _ in supervisor.events]
        assert levels == sorted(levels, reverse=True)  # warnings, then errors
        assert "16 failures so far" in supervisor.events[-1][1]
        next_ns = supervisor.next_try_ns
        assert next_ns is None or 0 <= next_ns - time.monotonic_ns() <= LATER_S * 1e9
        worker.fails = None
        await asyncio.wait_for(starting, LATER_S + 2 * LOADING_S)
        assert supervisor.state is PerceptionState.RUNNING
        assert supervisor.next_try_ns is None
        assert supervisor.events[-1][1].startswith("perception running: scripted")
        await supervisor.stop()

    run_simulated(monkeypatch, SimulatedClock(), work())


def test_wrong_settings_end_the_first_start_only(
    worker: type[ScriptedWorker], monkeypatch: pytest.MonkeyPatch
) -> None:
    wrong = StartFailed("the model has no class 'zebra'", wrong_settings=True)

    async def work() -> None:
        worker.fails = wrong
        with pytest.raises(PerceptionStartError, match="zebra"):
            await Watched().start()
        worker.fails = None
        supervisor = Watched()
        await supervisor.start()
        worker.fails = wrong  # the model's file was replaced meanwhile
        worker.started[-1].kill()
        await asyncio.sleep(120.0)
        assert supervisor.state is PerceptionState.FAILED
        worker.fails = None
        await until(lambda: supervisor.state is PerceptionState.RUNNING, LATER_S + LOADING_S + 1.0)
        await supervisor.stop()

    run_simulated(monkeypatch, SimulatedClock(), work())
