"""Commands that wait for the gimbal, and what supersedes them."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from companion.guidance.behaviour import Behaviour, BehaviourContext, Requirement
from companion.guidance.gimbal.controller import FIND_TIMEOUT_S
from companion.guidance.interface import Answer, EventKind, FindGimbal, Request
from companion.vehicle.gimbal import GimbalAim
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import FlightMode
from tests.companion.guidance.guidance_harness import (
    STEP_S,
    GuidanceHarness,
    ScriptedGimbal,
    assert_failed,
    flying,
    kinds,
    known,
)


class NeedsGimbal(Behaviour):
    name = "needs-gimbal"
    requirements = frozenset({Requirement.GIMBAL})

    def update(self, dt_s: float, context: BehaviourContext) -> Setpoint:
        return Setpoint.brake(context.now_ns)


class Waiting(GuidanceHarness):
    """The autopilot does not answer the gimbal request, and a command waits for it."""

    def __init__(self) -> None:
        super().__init__(flying())
        self.find: list[Request] = []
        start = self.autopilot.start

        def hold_back(request: Request) -> None:
            if isinstance(request.action, FindGimbal):
                self.find.append(request)
            else:
                start(request)

        self.autopilot.start = hold_back  # type: ignore[method-assign]
        self.run(0.1)
        self.waiting = self.command(NeedsGimbal())


def test_without_an_answer_it_is_refused_after_the_timeout() -> None:
    harness = Waiting()
    harness.run(FIND_TIMEOUT_S - 0.5)
    assert not harness.waiting.done()
    assert len(harness.find) == 1
    harness.run(1.0)
    assert_failed(harness.outcome(harness.waiting, 1.0), "not responding")


def test_found_gimbal_has_time_to_report_its_attitude() -> None:
    harness = Waiting()
    harness.autopilot._answers.append(Answer(harness.find[0].identifier))
    harness.run(1.0)
    assert not harness.waiting.done()
    harness.autopilot.gimbal = ScriptedGimbal()
    harness.run(0.2)
    assert known(harness.guidance.behaviour).name == "needs-gimbal"


def mode_there_and_back(harness: GuidanceHarness) -> None:
    """Between two steps of guidance."""
    for mode in (FlightMode.POSITION, FlightMode.HOLD):
        harness.autopilot.change_mode(mode)
        harness.autopilot.step(STEP_S)


SUPERSEDED: dict[str, tuple[Callable[[GuidanceHarness], object], tuple[str, ...]]] = {
    "behaviour": (lambda harness: harness.command("hold"), ("superseded by ", " hold ")),
    "aim": (lambda harness: harness.command(aim=GimbalAim(-0.5)), ("superseded by ", "by gimbal ")),
    "end of the service": (GuidanceHarness.close, ("superseded by ", "the service ")),
    "mode": (
        lambda harness: harness.autopilot.change_mode(FlightMode.POSITION),
        ("(now position, armed)",),
    ),
    "arming": (lambda harness: setattr(harness.vehicle, "armed", False), ("(now hold, disarmed)",)),
    "mode there and back": (mode_there_and_back, (" hold, armed)",)),
}


@pytest.mark.parametrize("change", SUPERSEDED)
def test_newer_command_or_another_mode_supersedes_it(change: str) -> None:
    harness, (begin, words) = Waiting(), SUPERSEDED[change]
    begin(harness)
    assert_failed(harness.outcome(harness.waiting, 1.0), *words)
    assert change != "behaviour" or harness.guidance.busy


def test_gimbal_command_is_not_superseded() -> None:
    harness = Waiting()
    pointing = harness.command(aim=GimbalAim(-0.5))
    harness.command("hold")
    harness.run(0.5)
    assert not pointing.done(), "gimbal only"


def test_loss_of_command_supersedes_it() -> None:
    harness = Waiting()
    harness.command("orbit")
    harness.until(lambda: harness.guidance.phase == "offboard", 5.0)
    later = harness.command(NeedsGimbal())
    harness.streaming = False
    harness.run(1.5)
    harness.streaming = True
    harness.run(0.1)
    assert EventKind.LOST in kinds(harness)
    assert_failed(later.result(), "command lost")
