"""The dead-man's whole logic, with a clock set by the test."""

from __future__ import annotations

import asyncio
import itertools
import logging
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.vehicle.setpoint import Setpoint
from companion.vehicle.streamer import SILENCE_S, Streamer, StreamState

pytestmark = pytest.mark.realtime

MS = 1_000_000


@dataclass
class Bench:
    """A streamer with a clock in milliseconds and what it sent."""

    brake_ms: int = 500
    now_ms: int = 1000
    sent: list[tuple[int, Setpoint]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.streamer = Streamer(lambda s: self.sent.append((self.now_ms, s)), brake_s=self.brake_ms / 1000)

    def submit(self, lifetime_ms: int = 300, north_mps: float = 1.0) -> Setpoint:
        setpoint = Setpoint.velocity((north_mps, 0.0, 0.0), self.now_ms * MS, lifetime_s=lifetime_ms / 1000)
        self.streamer.submit(setpoint)
        return setpoint

    def run(self, duration_ms: int, period_ms: int = 20) -> None:
        for _ in range(duration_ms // period_ms):
            self.now_ms += period_ms
            self.streamer.tick(self.now_ms * MS)


def is_brake(setpoint: Setpoint) -> bool:
    return setpoint.velocity_ned_mps == (0.0, 0.0, 0.0) and setpoint.yaw_rate_radps == 0.0


def test_fresh_setpoint_is_sent_once_per_tick() -> None:
    bench = Bench()
    setpoint = bench.submit(300)
    bench.run(300)
    assert [sent for _, sent in bench.sent] == [setpoint] * 15
    assert bench.streamer.state is StreamState.FRESH
    assert bench.streamer.sent_count == 15
    assert bench.streamer.last_sent is setpoint
    assert bench.streamer.last_sent_ns == 1300 * MS


def test_send_now_sends_once_between_two_ticks() -> None:
    bench = Bench()
    first = bench.submit(north_mps=1.0)
    bench.run(40)
    bench.now_ms += 5
    second = bench.submit(north_mps=2.0)
    bench.streamer.send_now(bench.now_ms * MS)
    bench.streamer.send_now(bench.now_ms * MS)
    bench.now_ms -= 5
    bench.run(40)
    assert bench.sent == [(1020, first), (1040, first), (1045, second), (1060, second), (1080, second)]


def test_send_now_neither_starts_nor_resumes_a_stream() -> None:
    bench = Bench(brake_ms=500)
    bench.submit(300)
    bench.streamer.send_now(bench.now_ms * MS)
    assert bench.sent == []
    bench.run(1000)
    assert bench.streamer.state is StreamState.EXPIRED
    count = bench.streamer.sent_count
    bench.submit(300)
    bench.streamer.send_now(bench.now_ms * MS)
    assert bench.streamer.sent_count == count


def test_expired_setpoint_brakes_then_stays_silent(caplog: pytest.LogCaptureFixture) -> None:
    bench = Bench(brake_ms=500)
    bench.submit(300)
    bench.run(800)
    assert [is_brake(sent) for _, sent in bench.sent] == [False] * 15 + [True] * 25
    before = bench.streamer.state
    assert before is StreamState.BRAKING
    bench.run(200)
    assert bench.streamer.state is StreamState.EXPIRED
    count = bench.streamer.sent_count
    # PX4 would return to OFFBOARD by itself; only a stop and a new start may do that.
    bench.submit(1000)
    bench.run(500)
    assert bench.streamer.sent_count == count
    assert [record.levelno for record in caplog.records] == [logging.WARNING, logging.ERROR]


def test_stream_can_restart_after_stop() -> None:
    bench = Bench(brake_ms=100)
    bench.submit(100)
    bench.run(1000)
    bench.streamer.stop()
    assert bench.streamer.state is StreamState.SILENT
    fresh = bench.submit(200)
    bench.run(100)
    assert bench.sent[-1] == (bench.now_ms, fresh)


def test_fresh_setpoint_ends_braking() -> None:
    bench = Bench()
    bench.submit(100)
    bench.run(300)
    before = bench.streamer.state
    assert before is StreamState.BRAKING
    fresh = bench.submit(300, north_mps=2.0)
    bench.run(20)
    assert bench.sent[-1][1] is fresh
    assert bench.streamer.state is StreamState.FRESH


def test_first_setpoint_that_is_expired_is_not_sent() -> None:
    bench = Bench()
    bench.submit(100)
    bench.now_ms += 200
    bench.run(400)
    assert bench.sent == []
    assert bench.streamer.state is StreamState.SILENT


def test_after_a_long_hang_nothing_is_sent() -> None:
    bench = Bench()
    bench.submit(60_000)
    bench.run(100)
    count = bench.streamer.sent_count
    bench.now_ms += round(SILENCE_S * 1000) + 1
    bench.run(200)
    assert bench.streamer.state is StreamState.EXPIRED
    assert bench.streamer.sent_count == count


def test_nothing_is_sent_before_submit_or_after_stop() -> None:
    bench = Bench()
    bench.run(200)
    assert bench.sent == []
    bench.submit(1000)
    bench.run(100)
    count = len(bench.sent)
    bench.streamer.stop()
    bench.run(500)
    assert len(bench.sent) == count


STEPS = st.lists(
    st.one_of(
        st.tuples(st.just("pass"), st.integers(0, 1500)),
        st.tuples(st.just("submit"), st.integers(-400, 900)),
        st.tuples(st.just("stop"), st.just(0)),
    ),
    max_size=80,
)


@given(steps=STEPS, brake_ms=st.integers(0, 600))
def test_expired_setpoints_are_never_sent_and_silence_is_final(
    steps: list[tuple[str, int]], brake_ms: int
) -> None:
    bench = Bench(brake_ms=brake_ms)
    newest: Setpoint | None = None
    silent = False  # a silence began and stop() has not been called since
    for number, (step, value) in enumerate(steps):
        before = len(bench.sent)
        if step == "submit":
            submitted = bench.submit(value, north_mps=1.0 + number)
            newest = newest if silent else submitted
        elif step == "stop":
            bench.streamer.stop()
            newest, silent = None, False
        else:
            bench.now_ms += value
            bench.streamer.tick(bench.now_ms * MS)
        sent = bench.sent[before:]
        assert len(sent) <= (1 if step == "pass" else 0)
        for at_ms, setpoint in sent:
            assert not silent
            assert newest is not None
            assert not setpoint.expired(at_ms * MS)
            assert setpoint.deadline_ns <= at_ms * MS + 300 * MS, "a delayed setpoint may arrive late"
            if replace(setpoint, deadline_ns=newest.deadline_ns) != newest:
                assert is_brake(setpoint)
                assert 0 < at_ms * MS - newest.deadline_ns <= brake_ms * MS
        silent = silent or bench.streamer.state is StreamState.EXPIRED


class ManualClock:
    """Replaces clock and sleep: time passes only by sleeping, or by a hang."""

    def __init__(self, sleeps: int) -> None:
        self.now_ns = 0
        self.sleeps_left = sleeps

    @asynccontextmanager
    async def sleeper(self) -> AsyncIterator[Callable[[float], Awaitable[None]]]:
        yield self.sleep

    async def sleep(self, delay_s: float) -> None:
        assert delay_s >= 0.0
        self.sleeps_left -= 1
        if self.sleeps_left < 0:
            raise asyncio.CancelledError
        self.now_ns += round(delay_s * 1e9)


async def run_streamer(clock: ManualClock, send: Callable[[Setpoint], None], **options: float) -> Streamer:
    streamer = Streamer(send, clock_ns=lambda: clock.now_ns, sleeper=clock.sleeper, **options)
    streamer.submit(Setpoint.velocity((1.0, 0.0, 0.0), 0, lifetime_s=60.0))
    with pytest.raises(asyncio.CancelledError):
        await streamer.run()
    return streamer


async def test_rate_is_kept_when_sending_takes_time() -> None:
    clock, times = ManualClock(sleeps=100), []

    def send(_setpoint: Setpoint) -> None:
        times.append(clock.now_ns)
        clock.now_ns += 3 * MS

    await run_streamer(clock, send, rate_hz=100.0)
    assert times == [number * 10 * MS for number in range(101)]


async def test_missed_ticks_are_skipped() -> None:
    clock, times = ManualClock(sleeps=20), []

    def send(_setpoint: Setpoint) -> None:
        times.append(clock.now_ns)
        if len(times) == 5:
            clock.now_ns += 333 * MS  # the loop was blocked

    await run_streamer(clock, send, rate_hz=100.0)
    gaps = [after - before for before, after in itertools.pairwise(times)]
    assert gaps == [10 * MS] * 4 + [340 * MS] + [10 * MS] * 15


async def test_streamer_runs_in_a_real_loop_until_cancelled() -> None:
    sent, enough = [], asyncio.Event()

    def send(setpoint: Setpoint) -> None:
        sent.append(setpoint)
        if len(sent) >= 10:
            enough.set()

    streamer = Streamer(send, rate_hz=200.0)
    streamer.submit(Setpoint.velocity((1.0, 0.0, 0.0), time.monotonic_ns(), lifetime_s=30.0))
    task = asyncio.create_task(streamer.run())
    async with asyncio.timeout(20):
        await enough.wait()
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    assert task.cancelled()
