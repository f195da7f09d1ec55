"""The real-time loop: simulations on one clock, stepped when due, after processing received messages."""

from __future__ import annotations

import selectors
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

PACE_PERIOD_S = 5.0


class Readable(Protocol):
    """Something that a selector can wait for."""

    def fileno(self) -> int: ...


class Paced(Protocol):
    """A simulation as the loop sees it; times are simulated seconds unless noted."""

    @property
    def speed(self) -> float:
        """Simulated seconds per second."""

    @property
    def endpoints(self) -> Mapping[str, Readable]:
        """Its sockets, by name."""

    def start_clock(self, now_ns: int) -> None: ...

    def backlog(self) -> float: ...

    def let_go(self, lost_s: float) -> None: ...

    def until_next_step(self) -> float: ...

    def receive(self, name: str) -> None: ...

    def steps_due(self, now_ns: int) -> int:
        """The number of steps due at a monotonic time; the same for all on one clock."""

    def step(self) -> None:
        """Take one step."""

    def settle(self, *, stepped: bool) -> None:
        """Send the messages of the steps, if there were any, and process fault commands."""

    def show(self, now_ns: int) -> None:
        """Update camera and truth file for that time."""


class _Pace:
    """Reports, every few seconds, that the machine is too slow for the requested speed."""

    def __init__(self, speed: float, on_event: Callable[[str], None]) -> None:
        self._speed = speed
        self._on_event = on_event
        self._lost_s = 0.0
        self._since_s = time.monotonic()

    def lose(self, simulated_s: float) -> None:
        self._lost_s += simulated_s

    def report(self) -> None:
        passed_s = time.monotonic() - self._since_s
        if passed_s < PACE_PERIOD_S:
            return
        if self._lost_s > 0.01 * self._speed * passed_s:
            reached = self._speed - self._lost_s / passed_s
            self._on_event(
                f"cannot keep up: {reached:.2f} times real time in the last {passed_s:.0f} s, "
                f"not {self._speed:g}; the machine is too busy"
            )
        self._lost_s = 0.0
        self._since_s += passed_s


def run_together(
    simulations: Sequence[Paced],
    stopped: Callable[[], bool],
    on_event: Callable[[str], None],
    stepped_all: Callable[[], None] = lambda: None,
) -> None:
    """The loop: wait for the sockets until the next step is due, process messages, step, send.

    `stepped_all` is called after each step of all of them.
    """
    first = simulations[0]
    speed = first.speed
    pace = _Pace(speed, on_event)
    started_ns = time.monotonic_ns()
    for simulation in simulations:
        simulation.start_clock(started_ns)
    with selectors.DefaultSelector() as selector:
        for simulation in simulations:
            for name, endpoint in simulation.endpoints.items():
                selector.register(endpoint, selectors.EVENT_READ, (simulation, name))
        while not stopped():
            lost_s = first.backlog()
            if lost_s > 0.0:
                pace.lose(lost_s)
                for simulation in simulations:
                    simulation.let_go(lost_s)
            pace.report()
            for key, _ in selector.select(first.until_next_step()):
                simulation, name = key.data
                simulation.receive(name)
            # one time for all, so that cameras show all of them at one simulated time
            now_ns = time.monotonic_ns()
            steps = first.steps_due(now_ns)
            for _ in range(steps):
                for simulation in simulations:
                    simulation.step()
                stepped_all()
            for simulation in simulations:
                simulation.settle(stepped=steps > 0)
            if steps:
                for simulation in simulations:
                    simulation.show(now_ns)
