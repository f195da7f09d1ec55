"""An asyncio loop on a simulated clock: where it would wait for a timer, the clock is set to it.

For code of one loop: what other processes and threads do takes no simulated time.
"""

from __future__ import annotations

import asyncio
import selectors
import time
from collections.abc import Coroutine
from typing import Any, TypeVar

import pytest

from companion.host.clock import StandstillWatch

_T = TypeVar("_T")
_real_ns = time.monotonic_ns


class SimulatedClock:
    """CLOCK_MONOTONIC and CLOCK_BOOTTIME of this process."""

    def __init__(self) -> None:
        self._now_ns, self._real_since_ns = _real_ns(), 0

    def now_ns(self) -> int:
        if self._real_since_ns:
            return self._now_ns + _real_ns() - self._real_since_ns
        return self._now_ns

    def now_s(self) -> float:
        return self.now_ns() / 1e9

    def run_in_real_time(self) -> None:
        """From now on time passes by itself."""
        self._real_since_ns = _real_ns()

    @property
    def simulated(self) -> bool:
        return not self._real_since_ns

    def advance(self, seconds: float) -> None:
        self._now_ns += max(round(seconds * 1e9), 1)


class _Selector(selectors.DefaultSelector):
    def __init__(self, clock: SimulatedClock) -> None:
        super().__init__()
        self._clock = clock

    def select(self, timeout: float | None = None) -> Any:
        if timeout is None or not self._clock.simulated:
            return super().select(timeout)
        events = super().select(0)
        if not events and timeout > 0:
            self._clock.advance(timeout)
        return events


class _Loop(asyncio.SelectorEventLoop):
    def __init__(self, clock: SimulatedClock) -> None:
        super().__init__(_Selector(clock))
        self._clock = clock

    def time(self) -> float:
        return self._clock.now_s()


def run_simulated(
    monkeypatch: pytest.MonkeyPatch, clock: SimulatedClock, work: Coroutine[Any, Any, _T]
) -> _T:
    """Run a coroutine in a loop of its own, on a simulated clock."""
    monkeypatch.setattr(time, "monotonic", clock.now_s)
    monkeypatch.setattr(time, "monotonic_ns", clock.now_ns)
    monkeypatch.setattr("companion.host.clock.boottime_ns", clock.now_ns)
    monkeypatch.setattr(StandstillWatch.__init__, "__defaults__", (clock.now_ns, clock.now_ns))
    with asyncio.Runner(loop_factory=lambda: _Loop(clock)) as runner:
        return runner.run(work)
