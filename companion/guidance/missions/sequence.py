"""A mission: a sequence of behaviours, each with a time-out and branches on success and failure.

To guidance it is one behaviour, so the same rules hold for all steps. The next step begins in the same update
in which the previous one ends. An operator's next command replaces the whole mission, and a pilot's mode
change ends it: command is not released between steps.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from companion.guidance.behaviour import (
    OF_THE_MOMENT,
    Behaviour,
    BehaviourContext,
    BehaviourOutput,
    Outcome,
    Requirement,
)
from companion.vehicle.landing_target import LandingTarget
from companion.vehicle.state import LandedState, Vector3

logger = logging.getLogger(__name__)

# Branch targets besides steps.
CONTINUE, END, ABORT, RTL, LAND = "continue", "end", "abort", "rtl", "land"
# On failure the autopilot may bring the vehicle down; the mission has failed nevertheless.
WAYS_DOWN = (RTL, LAND)


@dataclass(frozen=True, slots=True)
class PlannedStep:
    """One step of a plan.

    Attributes:
        title: its name, or its command; for people.
        command: in the grammar.
        make: builds the behaviour.
        endless: it ends by its time-out, with success.
        timeout_s: after which it has failed (or, endless, succeeded); None: only the behaviour's own limits.
        repeat: how often it is executed in succession, as long as it succeeds.
        visits: how often it may be started; once more fails the mission. None: no limit.
        on_success, on_failure: index of the next step, or `end`, `abort`, `rtl` or `land`.
    """

    title: str
    command: str
    make: Callable[[], Behaviour]
    endless: bool = False
    timeout_s: float | None = None
    repeat: int = 1
    visits: int | None = None
    on_success: int | str = END
    on_failure: int | str = ABORT


@dataclass(frozen=True, slots=True)
class Plan:
    """A validated mission: every index is valid, and it has an end.

    Attributes:
        name: for people. steps: in the order of the file, starting with the first.
        way_down: builds the behaviour for `rtl` and `land`. timeout_s: of the whole; None: no limit.
    """

    name: str
    steps: tuple[PlannedStep, ...]
    way_down: Callable[[str], Behaviour]
    timeout_s: float | None = None


@dataclass(frozen=True, slots=True)
class StepRecord:
    """The result of one step."""

    title: str
    command: str
    success: bool
    reason: str
    started_ns: int
    ended_ns: int


class SequenceBehaviour(Behaviour):
    """Flies a plan.

    Args:
        refused: `Guidance.check_requirements`, called at every step.

    Attributes:
        plan: the active plan. current: index of the active step.
        records: the steps that have ended, in order.
        failure: why the failure handling is active; empty: it is not.
    """

    name = "mission"

    def __init__(self, plan: Plan, refused: Callable[[Behaviour], str | None]) -> None:
        self.plan, self._refused = plan, refused
        self.records: list[StepRecord] = []
        self.current = 0
        self._active: Behaviour | None = None
        # The first step's behaviour declares what the mission needs to begin.
        first = plan.steps[0].make()
        self._first: Behaviour | None = first
        self.neighbour_names = first.neighbour_names
        self._activated = False
        self._visits: Counter[int] = Counter()
        self._repeats = 0
        self._begun_ns = self._started_ns = 0
        self._request_failure = ""
        self.failure = ""
        self._ended = False
        self._goal_ned_m: Vector3 | None = None
        self.later = tuple(step.make() for step in plan.steps)

    @property
    def requirements(self) -> frozenset[Requirement]:  # type: ignore[override]
        """Of the current step, before the start of the first one; `later` has all steps."""
        if self._active is not None:
            return self._active.needs
        if self._first is None:
            return frozenset()
        branches = self.plan.steps[0].on_failure != ABORT
        return self._first.needs - (OF_THE_MOMENT if branches else frozenset())

    def blocked_by(self, active: Behaviour, context: BehaviourContext) -> str | None:
        """See Behaviour: as its first step."""
        return None if self._first is None else self._first.blocked_by(active, context)

    @property
    def where(self) -> str:
        """The current step: `step 2 of 6 (find)`."""
        step = self.plan.steps[self.current]
        if self.failure:
            return f"descent after {self.failure}"
        return f"step {self.current + 1} of {len(self.plan.steps)} ({step.title})"

    @property
    def status(self) -> str:
        doing = "" if self._active is None else f": {self._active.status}"
        return f"mission {self.plan.name}, {self.where}{doing}"

    def with_step(self, outcome: Outcome) -> Outcome:
        """Add the current step to an outcome that came from outside (a pilot, another command)."""
        if outcome.success or self._ended or self._active is None:
            return outcome
        return Outcome(False, f"{self.where}: {outcome.reason}")

    def take_notes(self) -> Sequence[str]:
        self._collect_notes()
        return super().take_notes()

    def request_failed(self, why: str) -> bool:
        """The autopilot refused a mode: the step fails, not the mission."""
        if self._active is None:
            return False
        self._request_failure = why
        return True

    @property
    def active(self) -> Behaviour:
        return self if self._active is None else self._active.active

    @property
    def landing_target(self) -> LandingTarget | None:
        return None if self._active is None else self._active.landing_target

    def on_activate(self, context: BehaviourContext) -> None:
        self._started_ns = context.now_ns
        self._goal_ned_m = context.goal_ned_m
        self.records.clear()
        self._visits.clear()
        self._request_failure = self.failure = ""
        self._ended = False
        self.current, self._repeats, self._active = 0, 0, None

    def on_deactivate(self) -> None:
        self._leave()

    def update(self, dt_s: float, context: BehaviourContext) -> BehaviourOutput:
        step = self._update(dt_s, context)
        self._ended = isinstance(step, Outcome)
        return step

    def _update(self, dt_s: float, context: BehaviourContext) -> BehaviourOutput:
        if self._active is None:
            if (ended := self._begin(0, context)) is not None:
                return ended
            dt_s = 0.0
        # Steps may end at once; this many in one update are a loop.
        for _ in range(2 * len(self.plan.steps) + 2):
            if not self.failure and self._out_of_time(context):
                ended = self._give_up(context)
            else:
                step = self._fly(dt_s, context)
                if not isinstance(step, Outcome):
                    return step
                ended = self._after(step, context)
            if ended is not None:
                return ended
            dt_s = 0.0
        return Outcome(False, f"{self.where}: loop of steps that end at once: {self.records[-1].reason}")

    def _fly(self, dt_s: float, context: BehaviourContext) -> BehaviourOutput:
        """Update the current step."""
        active, planned = self._active, self.plan.steps[self.current]
        assert active is not None
        context = replace(context, goal_ned_m=self._goal_ned_m)
        if self._request_failure:
            why, self._request_failure = self._request_failure, ""
            return Outcome(False, why)
        if not self.failure and (late := self._late(planned, context.now_ns)) is not None:
            return late
        try:
            if not self._activated:
                if (refused := self._refused(active)) is not None:
                    return Outcome(False, f"refused: {refused}")
                self._activated = True
                active.on_activate(context)
            return active.update(dt_s, context)
        except Exception as error:
            # An exception fails the step; the plan says how to go on.
            logger.exception("%s failed", active.name)
            return Outcome(False, f"{active.name} failed: {type(error).__name__}: {error}")

    def _late(self, planned: PlannedStep, now_ns: int) -> Outcome | None:
        elapsed_s, limit_s = (now_ns - self._begun_ns) / 1e9, planned.timeout_s
        if limit_s is None or elapsed_s < limit_s:
            return None
        if planned.endless and self._activated:
            return Outcome(True, f"flown for {limit_s:g} s")
        return Outcome(False, f"timed out after {limit_s:g} s: {self._status_of_active()}")

    def _status_of_active(self) -> str:
        return self._active.status if self._active is not None else "not started"

    def _after(self, outcome: Outcome, context: BehaviourContext) -> Outcome | None:
        """Start what follows a step that has ended; returns the mission's outcome if nothing does."""
        planned, where = self.plan.steps[self.current], self.where
        self._goal_ned_m = outcome.goal_ned_m
        self._collect_notes()
        self._leave()
        if self.failure:
            return Outcome(False, f"{self.failure}; {outcome.reason}")
        fields = (planned.title, planned.command, outcome.success, outcome.reason)
        self.records.append(StepRecord(*fields, self._begun_ns, context.now_ns))
        self._repeats += 1
        if outcome.success and self._repeats < planned.repeat:
            return self._begin(self.current, context, again=True)
        follows = planned.on_success if outcome.success else planned.on_failure
        self.add_notes(f"mission {self.plan.name}: {where} {_done(outcome)}{_then(self.plan, follows)}")
        return self._go_on(follows, f"{where}: {outcome.reason}", context)

    def _go_on(self, follows: int | str, reason: str, context: BehaviourContext) -> Outcome | None:
        if isinstance(follows, int):
            return self._begin(follows, context)
        if follows == END:
            return Outcome(True, f"flown, {len(self.records)} steps", self._goal_ned_m)
        if follows == ABORT or context.state.landed is LandedState.ON_GROUND:  # there is no way down
            return Outcome(False, reason)
        self.failure = reason
        self._active, self._activated, self._begun_ns = self.plan.way_down(follows), False, context.now_ns
        return None

    def _begin(self, index: int, context: BehaviourContext, *, again: bool = False) -> Outcome | None:
        planned = self.plan.steps[index]
        self.current, self._begun_ns, self._activated = index, context.now_ns, False
        if not again:
            self._repeats = 0
            self._visits[index] += 1
            if planned.visits is not None and self._visits[index] > planned.visits:
                reason = f"{self.where}: visits limit {planned.visits} reached"
                return self._go_on(_final(planned.on_failure), reason, context)
        self._active, self._first = self._first or planned.make(), None
        times = f", {self._repeats + 1} of {planned.repeat} times" if planned.repeat > 1 else ""
        number = f"step {index + 1} of {len(self.plan.steps)}"
        self.add_notes(f"mission {self.plan.name}: {number}{times}: {planned.command}")
        return None

    def _out_of_time(self, context: BehaviourContext) -> bool:
        limit_s = self.plan.timeout_s
        return limit_s is not None and context.now_ns - self._started_ns > limit_s * 1e9

    def _give_up(self, context: BehaviourContext) -> Outcome | None:
        """The mission's time-out has passed: the current step fails."""
        reason = f"{self.where}: mission timed out after {self.plan.timeout_s:g} s"
        self._goal_ned_m = None
        self._collect_notes()
        self._leave()
        self.add_notes(f"mission {self.plan.name}: {reason}")
        return self._go_on(_final(self.plan.steps[self.current].on_failure), reason, context)

    def _collect_notes(self) -> None:
        if self._active is not None:
            self.add_notes(*self._active.take_notes())

    def _leave(self) -> None:
        if self._active is not None and self._activated:
            self._activated = False
            self._active.on_deactivate()


def _done(outcome: Outcome) -> str:
    return f"{'done' if outcome.success else 'failed'}: {outcome.reason}"


def _then(plan: Plan, follows: int | str) -> str:
    """The next step or branch in words; empty at the end."""
    if isinstance(follows, str):
        return "" if follows == END else f"; {follows}"
    return f"; next: {plan.steps[follows].title}"


def _final(follows: int | str) -> str:
    """A step over its limit may be followed by `rtl` or `land`, not by more steps."""
    return follows if isinstance(follows, str) and follows in WAYS_DOWN else ABORT
