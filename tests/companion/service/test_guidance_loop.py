"""The guidance loop and a slow behaviour, with a clock that the test sets."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from types import SimpleNamespace
from typing import Any

import pytest

from companion.guidance.behaviour import BehaviourContext, BehaviourOutput
from companion.guidance.behaviours.hold import HoldBehaviour
from companion.guidance.interface import GuidanceInput, StreamStatus
from companion.host.clock import Standstill, StandstillWatch
from companion.service import guidance_loop
from companion.service.guidance_loop import GuidanceLoop
from companion.vehicle.precise_sleep import Sleep
from companion.vehicle.state import VehicleState
from companion.vehicle.streamer import Streamer, StreamState
from tests.companion.guidance.guidance_harness import STEP_S, GuidanceHarness, engaged, flying

MS = 1_000_000


class SlowBehaviour(HoldBehaviour):
    """A hold whose update calls `on_update` first."""

    name = "slow"

    def __init__(self) -> None:
        super().__init__()
        self.on_update: Callable[[], None] = lambda: None

    def update(self, dt_s: float, context: BehaviourContext) -> BehaviourOutput:
        self.on_update()
        return super().update(dt_s, context)


class LoopHarness:
    """The guidance loop and the streamer in one event loop; each step takes 20 ms of a simulated clock.

    Attributes:
        events: texts of the loop's events.
        sent: time and state of the streamer at each sent setpoint.
        used_ns: processor time of the thread.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.vehicle = flying()
        self.harness = GuidanceHarness(self.vehicle)
        self.sent: list[tuple[int, StreamState]] = []
        self.streamer = self.harness.streamer = Streamer(
            lambda setpoint: self.sent.append((self.vehicle.now_ns, self.streamer.state)),
            clock_ns=lambda: self.vehicle.now_ns,
            sleeper=self._sleeper,
        )
        self.behaviour = SlowBehaviour()
        self.used_ns = self.suspended_ns = 0
        self.discarded: list[str] = []
        self.watch = StandstillWatch(
            lambda: self.vehicle.now_ns + self.suspended_ns, lambda: self.vehicle.now_ns
        )
        self.events: list[str] = []
        engaged(self.harness, self.behaviour)
        clock = SimpleNamespace(
            monotonic=lambda: self.vehicle.now_ns / 1e9,
            monotonic_ns=lambda: self.vehicle.now_ns,
            thread_time_ns=lambda: self.used_ns,
        )
        monkeypatch.setattr(guidance_loop, "time", clock)

    def take(self, used_ms: float, passed_ms: float) -> None:
        """Let time pass within an update."""
        self.used_ns += round(used_ms * MS)
        self.vehicle.now_ns += round(passed_ms * MS)

    async def run(self, seconds: float) -> None:
        """Run loop and streamer until that time has passed."""
        end_ns = self.vehicle.now_ns + round(seconds * 1e9)
        over = asyncio.Event()

        def on_step(now_ns: int) -> None:
            self.harness.autopilot.step(STEP_S)
            if self.vehicle.now_ns >= end_ns:
                over.set()

        loop = self._loop(on_step)
        tasks = [asyncio.create_task(loop.run()), asyncio.create_task(self.streamer.run())]
        ended = asyncio.create_task(over.wait())
        done, _ = await asyncio.wait([*tasks, ended], return_when=asyncio.FIRST_COMPLETED)
        for task in (*tasks, ended):
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        assert done == {ended}, [task.exception() for task in done - {ended}]

    async def crash_and_shut_down(self) -> None:
        """A step raises, and the shutdown begins."""

        def crash(now_ns: int) -> None:
            raise ZeroDivisionError

        loop = self._loop(crash)
        with contextlib.suppress(ZeroDivisionError):
            await loop.run()
        loop.begin_shutdown()

    def _loop(self, on_step: Callable[[int], None]) -> GuidanceLoop:
        driver: Any = SimpleNamespace(
            state=self.harness.autopilot.state,
            watch=self.watch,
            abandon=lambda why: self.discarded.append("pending"),
            discard_received=lambda: self.discarded.append("driver"),
            send_landing_target=None,
            send_obstacle_distance=None,
        )
        return GuidanceLoop(
            self.harness.guidance,
            self._inputs(),
            driver,
            self.streamer,
            rate_hz=1 / STEP_S,
            on_event=lambda level, text: self.events.append(text),
            on_step=on_step,
            others=SimpleNamespace(),  # type: ignore[arg-type]
        )

    def _inputs(self) -> Any:
        autopilot = self.harness.autopilot

        def assemble(
            now_ns: int,
            state: VehicleState,
            stream: StreamStatus,
            standstill: Standstill | None = None,
            **_rest: object,
        ) -> GuidanceInput:
            return GuidanceInput(
                autopilot.state, stream, seen_ns=now_ns, mode_changes=autopilot.mode_changes,
                answers=autopilot.take_answers(), standstill=standstill,
            )  # fmt: skip

        return SimpleNamespace(
            assemble=assemble,
            discard_received=lambda now_ns: self.discarded.append("inputs"),
            step_context=lambda mounting: None,
            steering=SimpleNamespace(request_path=None),
            select=None,
            poses=SimpleNamespace(source="s"),
        )

    @asynccontextmanager
    async def _sleeper(self) -> AsyncIterator[Sleep]:
        async def sleep(seconds: float) -> None:
            until_ns = self.vehicle.now_ns + round(seconds * 1e9)
            while self.vehicle.now_ns < until_ns:
                await asyncio.sleep(0)

        yield sleep


@pytest.fixture
def loop(monkeypatch: pytest.MonkeyPatch) -> LoopHarness:
    return LoopHarness(monkeypatch)


@pytest.mark.parametrize(
    ("used_ms", "passed_ms", "named"),
    [(5.1, 5.1, True), (4.9, 4.9, False), (0.1, 50.1, True), (0.1, 49.9, False)],
)
async def test_slow_update_is_named_in_an_event(
    loop: LoopHarness, used_ms: float, passed_ms: float, named: bool
) -> None:
    loop.behaviour.on_update = lambda: loop.take(used_ms, passed_ms)
    await loop.run(0.2)
    assert [text.startswith("slow: ") for text in loop.events] == [True] * named


async def test_slow_behaviour_is_named_again_after_ten_seconds(loop: LoopHarness) -> None:
    loop.behaviour.on_update = lambda: loop.take(6.0, 6.0)
    await loop.run(9.8)
    assert len(loop.events) == 1
    await loop.run(10.4)  # a loop of its own, which names it at its start and 10 s later
    assert len(loop.events) == 3


async def test_blocked_update_stops_the_stream_for_good(loop: LoopHarness) -> None:
    await loop.run(0.2)
    assert {state for _, state in loop.sent} == {StreamState.FRESH}
    blocked_ns = loop.vehicle.now_ns
    loop.behaviour.on_update = lambda: loop.take(0.0, 2000.0)
    await loop.run(3.0)
    # Nothing is sent while it blocks, nor after it has returned a setpoint: the autopilot's failsafe acts.
    assert [state for at_ns, state in loop.sent if at_ns > blocked_ns + 20 * MS] == []
    assert loop.streamer.state is not StreamState.FRESH


async def test_setpoint_of_an_update_that_took_too_long_is_expired(loop: LoopHarness) -> None:
    await loop.run(0.2)
    blocked_ns = loop.vehicle.now_ns
    loop.behaviour.on_update = lambda: loop.take(0.0, 600.0)
    await loop.run(1.0)
    after = [(at_ns, state) for at_ns, state in loop.sent if at_ns > blocked_ns + 20 * MS]
    assert after[0][0] - blocked_ns >= 600 * MS
    assert {state for _, state in after} == {StreamState.BRAKING}


async def test_suspend_ends_the_command_and_discards_what_was_received(loop: LoopHarness) -> None:
    await loop.run(0.2)
    at_ns = loop.vehicle.now_ns
    loop.suspended_ns = 42_000_000_000
    await loop.run(2.0)
    assert loop.discarded == ["pending", "driver", "inputs"]
    assert [sent_ns for sent_ns, _ in loop.sent if sent_ns > at_ns] == []
    assert not loop.harness.guidance.in_command
    assert "suspended for 42.0 s" in loop.events[0]
    assert loop.watch.observe().standstill is None, "acknowledged"


async def test_short_suspend_changes_nothing(loop: LoopHarness) -> None:
    await loop.run(0.2)
    at_ns = loop.vehicle.now_ns
    loop.suspended_ns = 200_000_000
    await loop.run(2.0)
    assert loop.discarded == []
    assert loop.harness.guidance.in_command
    assert {state for sent_ns, state in loop.sent if sent_ns > at_ns + 100 * MS} == {StreamState.FRESH}


async def test_shutdown_after_a_crash_may_request_for_long(loop: LoopHarness) -> None:
    """A pilot's mode is requested again up to 3 s after the request that overrode it."""
    await loop.crash_and_shut_down()
    loop.vehicle.now_ns += 3_500 * MS
    assert loop.watch.observe().standstill is None
    loop.suspended_ns = 400 * MS
    assert loop.watch.observe().standstill is not None
