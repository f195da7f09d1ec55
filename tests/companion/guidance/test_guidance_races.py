"""Races: several events in one step, or missing ones."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from companion.guidance.behaviour import (
    Behaviour,
    BehaviourContext,
    BehaviourOutput,
    ModeRequest,
    Outcome,
)
from companion.guidance.behaviours.hold import HoldBehaviour
from companion.guidance.interface import CommandInput, EventKind
from companion.guidance.mode_control import Phase
from companion.vehicle.state import FlightMode, LandedState
from tests.companion.guidance.guidance_harness import (
    STEP_S,
    GuidanceHarness,
    assert_failed,
    engaged,
    flying,
    hovering,
    kinds,
    standing,
    with_state,
)


def test_takeoff_without_position_stops_climbing() -> None:
    harness = standing()
    harness.autopilot.takeoff_short_m = 1.0
    takeoff = harness.command("takeoff 5")
    harness.until(lambda: harness.guidance.phase is Phase.OFFBOARD, 30.0)
    harness.autopilot.position_alive = False
    assert_failed(harness.outcome(takeoff, 10.0), "position")
    assert -harness.vehicle.position[2] < 5.5
    assert not harness.guidance.in_command


class TakesOffOnce(Behaviour):
    """Requests a take-off, and ends once the pre-arm checks have passed."""

    name = "takes-off-once"

    def update(self, dt_s: float, context: BehaviourContext) -> BehaviourOutput:
        if context.state.ready_to_arm:
            return Outcome(False, "enough")
        return ModeRequest(FlightMode.TAKEOFF, 3.0, arm=True)


def test_request_cancelled_in_its_step_is_not_made() -> None:
    harness = standing(inputs=with_state(ready_to_arm=False))
    command = harness.command(TakesOffOnce())
    harness.run(0.5)
    harness._inputs = with_state(ready_to_arm=True)
    harness.run(0.5)
    assert command.result() == Outcome(False, "enough")
    assert harness.autopilot.requests == []
    assert not harness.vehicle.armed


@pytest.mark.parametrize(
    "command", ["follow-path 0,0;10,0 speed=2", "goto 10 0", "patrol points=0,0;10,0 classes=car"]
)
def test_unknown_goal_is_refused_and_the_flight_goes_on(command: str) -> None:
    harness = GuidanceHarness(flying(), inputs=with_state(home_position_ned_m=None))
    engaged(harness)
    assert_failed(harness.command(command).result(), "home")
    assert kinds(harness)[-1] is EventKind.REFUSED
    harness.run(0.5)
    assert harness.guidance.phase is Phase.OFFBOARD


def test_stop_whose_mode_shows_before_its_answer_ends_command() -> None:
    silent = False
    harness = GuidanceHarness(
        flying(), inputs=lambda inputs: replace(inputs, answers=() if silent else inputs.answers)
    )
    engaged(harness)
    silent = True
    stopped = harness.command("stop")
    assert harness.outcome(stopped, 5.0).success
    silent = False
    harness.run(2.0)
    assert harness.vehicle.mode is FlightMode.HOLD
    assert harness.guidance.phase is Phase.IDLE


def test_mode_change_after_a_command_supersedes_it() -> None:
    harness = hovering()
    given = CommandInput(99, "hold", HoldBehaviour(), mode_changes=harness.autopilot.mode_changes)
    harness.autopilot.change_mode(FlightMode.POSITION)
    harness.autopilot.step(STEP_S)
    harness.step(given)
    assert " position, armed)" in harness.results[99].reason
    harness.run(1.0)
    assert not harness.guidance.in_command
    assert harness.autopilot.setpoints == []


def test_goal_is_discarded_when_someone_else_flies() -> None:
    harness = standing()
    assert harness.outcome(harness.command("takeoff 3")).success
    assert not harness.guidance.in_command
    harness.autopilot.change_mode(FlightMode.POSITION)
    harness.run(0.5)
    position = (harness.vehicle.position[0] + 0.7, *harness.vehicle.position[1:])
    harness.vehicle.position[0] = position[0]
    harness.command("hold")
    harness.run(5.0)
    assert harness.vehicle.landed is LandedState.IN_AIR
    assert math.dist(harness.vehicle.position, position) < 0.1
