"""Commands that wait for the gimbal, and what supersedes them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from companion.guidance.behaviour import Behaviour, BehaviourContext, Requirement
from companion.guidance.behaviours.hold import HoldBehaviour
from companion.guidance.behaviours.orbit import Orbit, OrbitBehaviour
from companion.guidance.gimbal.controller import FIND_TIMEOUT_S
from companion.guidance.interface import EventKind, FindGimbal, GuidanceInput, Request
from companion.vehicle.gimbal import GimbalAim
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import FlightMode
from tests.companion.guidance.guidance_harness import GuidanceHarness, Pending, flying, kinds


class NeedsGimbal(Behaviour):
    name = "needs-gimbal"
    requirements = frozenset({Requirement.GIMBAL})

    def update(self, dt_s: float, context: BehaviourContext) -> Setpoint:
        return Setpoint.brake(context.now_ns)


class Waiting:
    """A harness whose autopilot does not answer the gimbal request, and a command that waits for it."""

    def __init__(self) -> None:
        self.harness = GuidanceHarness(flying())
        self.find: list[Request] = []
        start = self.harness.autopilot.start

        def hold_back(request: Request) -> None:
            if isinstance(request.action, FindGimbal):
                self.find.append(request)
            else:
                start(request)

        self.harness.autopilot.start = hold_back  # type: ignore[method-assign]
        self.harness.run(0.1)
        self.command = self.harness.command(NeedsGimbal())

    def reason(self) -> str:
        return self.harness.outcome(self.command, 1.0).reason


def test_without_an_answer_it_is_refused_after_the_timeout() -> None:
    waiting = Waiting()
    waiting.harness.run(FIND_TIMEOUT_S - 0.5)
    assert not waiting.command.done()
    assert len(waiting.find) == 1
    waiting.harness.run(1.0)
    assert "not responding" in waiting.reason()


@pytest.mark.parametrize("newer", ["behaviour", "aim"])
def test_newer_command_supersedes_it(newer: str) -> None:
    waiting = Waiting()
    if newer == "behaviour":
        later: Pending = waiting.harness.command(HoldBehaviour())
        reason = waiting.reason()
        assert reason.startswith("superseded by ")
        assert " hold " in reason
        assert not later.done()
    else:
        waiting.harness.command(aim=GimbalAim(-0.5))
        reason = waiting.reason()
        assert reason.startswith("superseded by ")
        assert "by gimbal " in reason


def test_gimbal_command_is_not_superseded() -> None:
    harness = Waiting().harness
    pointing = harness.command(aim=GimbalAim(-0.5))
    harness.command(HoldBehaviour())
    harness.run(0.5)
    assert not pointing.done(), "gimbal only"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda harness: harness.autopilot.change_mode(FlightMode.POSITION), "(now position, armed)"),
        (lambda harness: setattr(harness.vehicle, "armed", False), "(now hold, disarmed)"),
    ],
)
def test_change_of_mode_or_arming_supersedes_it(
    change: Callable[[GuidanceHarness], None], words: str
) -> None:
    waiting = Waiting()
    change(waiting.harness)
    waiting.harness.run(0.1)
    assert words in waiting.reason()


def test_change_reverted_between_steps_supersedes_it() -> None:
    harness = GuidanceHarness(flying())
    changes = 0

    def counted(inputs: GuidanceInput) -> GuidanceInput:
        return replace(inputs, mode_changes=changes)

    harness._inputs = counted
    harness.run(0.1)
    harness.autopilot.start = lambda request: None  # type: ignore[method-assign]
    command = harness.command(NeedsGimbal())
    harness.run(0.1)
    assert not command.done()
    changes += 2
    harness.run(0.1)
    assert " hold, armed)" in command.result().reason


def test_end_of_service_supersedes_it() -> None:
    waiting = Waiting()
    waiting.harness.close()
    reason = waiting.reason()
    assert reason.startswith("superseded by ")
    assert "the service " in reason


def test_loss_of_command_supersedes_it() -> None:
    waiting = Waiting()
    harness = waiting.harness
    harness.command(OrbitBehaviour(Orbit()))
    harness.until(lambda: harness.guidance.phase == "offboard", 5.0)
    later = harness.command(NeedsGimbal())
    harness.streaming = False
    harness.run(1.5)
    harness.streaming = True
    harness.run(0.1)
    assert EventKind.LOST in kinds(harness)
    assert "command lost" in later.result().reason
