"""The watch for a suspended computer and a stopped process, with clocks that the test sets."""

import itertools

import pytest

from companion.host.clock import PAUSED_S, SUSPENDED_S, StandstillWatch, boottime_ns


class Clocks:
    """Both clocks, nanoseconds. CLOCK_MONOTONIC stands still in a suspend."""

    def __init__(self) -> None:
        self.boottime_ns = 5_000_000_000_000
        self.monotonic_ns = 1_000_000_000_000

    def watch(self) -> StandstillWatch:
        return StandstillWatch(lambda: self.boottime_ns, lambda: self.monotonic_ns)

    def run(self, seconds: float) -> None:
        self.boottime_ns += round(seconds * 1e9)
        self.monotonic_ns += round(seconds * 1e9)

    def suspend(self, seconds: float) -> None:
        self.boottime_ns += round(seconds * 1e9)


@pytest.mark.parametrize("seconds", [0.31, 1.0, 60.0, 86400.0])
def test_suspend_is_seen_until_it_is_acknowledged(seconds: float) -> None:
    clocks = Clocks()
    watch = clocks.watch()
    clocks.suspend(seconds)
    clocks.run(0.01)
    seen = watch.observe()
    assert seen.standstill is not None
    assert seen.standstill.seconds == pytest.approx(seconds)
    assert seen.standstill.long is (seconds > PAUSED_S)
    assert watch.now_ns() == clocks.monotonic_ns + round(seconds * 1e9)
    watch.acknowledge(seen)
    assert watch.observe().standstill is None
    assert watch.now_ns() == clocks.monotonic_ns


def test_suspend_after_the_observation_is_not_acknowledged() -> None:
    clocks = Clocks()
    watch = clocks.watch()
    seen = watch.observe()
    clocks.suspend(1.0)
    watch.acknowledge(seen)
    assert watch.observe().standstill is not None


def test_short_suspends_of_different_steps_do_not_add_up() -> None:
    clocks = Clocks()
    watch = clocks.watch()
    for _ in range(10):
        clocks.suspend(SUSPENDED_S - 0.01)
        clocks.run(0.05)
        seen = watch.observe()
        assert seen.standstill is None
        watch.acknowledge(seen)


@pytest.mark.parametrize(
    ("seconds", "found"), [(PAUSED_S - 0.01, False), (PAUSED_S + 0.01, True), (60.0, True)]
)
def test_pause_of_the_loop_is_seen_by_its_last_step(seconds: float, found: bool) -> None:
    clocks = Clocks()
    watch = clocks.watch()
    watch.acknowledge(watch.observe())
    clocks.run(seconds)
    standstill = watch.observe().standstill
    assert (standstill is not None) is found
    assert standstill is None or standstill.long


def test_time_before_the_first_step_is_no_pause() -> None:
    clocks = Clocks()
    watch = clocks.watch()
    clocks.run(100.0)
    assert watch.observe().standstill is None


def test_delay_between_two_readings_is_no_suspend() -> None:
    reading = itertools.count()

    def now_ns() -> int:
        return next(reading) * 400_000_000  # every reading takes 0.4 s

    watch = StandstillWatch(now_ns, now_ns)
    assert watch.observe().standstill is None


def test_boottime_is_not_behind_monotonic() -> None:
    watch = StandstillWatch()
    assert watch.observe().standstill is None
    assert boottime_ns() > 0
