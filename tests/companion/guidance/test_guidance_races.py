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
    Requirement,
)
from companion.guidance.behaviours.approach import Approach, ApproachBehaviour
from companion.guidance.behaviours.follow_path import FollowPathBehaviour
from companion.guidance.behaviours.hold import HoldBehaviour
from companion.guidance.behaviours.stop import StopBehaviour
from companion.guidance.behaviours.takeoff import TakeoffBehaviour
from companion.guidance.interface import Answer, CommandInput, EventKind, FindGimbal, GuidanceInput, Request
from companion.guidance.mode_control import Phase
from companion.guidance.objects.tracked_object import Subject
from companion.vehicle.gimbal import NOBODY, GimbalState, YawFrame
from companion.vehicle.state import FlightMode, LandedState
from tests.companion.guidance.guidance_harness import (
    STEP_S,
    GuidanceHarness,
    assert_failed,
    engaged,
    flying,
    kinds,
    parked,
)


def test_takeoff_without_position_stops_climbing() -> None:
    harness = GuidanceHarness(parked())
    harness.autopilot.takeoff_short_m = 1.0
    harness.run(0.2)
    takeoff = harness.command(TakeoffBehaviour(5.0))
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
    ready = False
    harness = GuidanceHarness(
        parked(),
        inputs=lambda inputs: replace(inputs, state=replace(inputs.state, ready_to_arm=ready)),
    )
    harness.run(0.1)
    command = harness.command(TakesOffOnce())
    harness.run(0.5)
    ready = True
    harness.run(0.5)
    assert command.result() == Outcome(False, "enough")
    assert harness.autopilot.requests == []
    assert not harness.vehicle.armed


def test_failing_check_is_refused_and_the_flight_goes_on() -> None:
    def homeless(inputs: GuidanceInput) -> GuidanceInput:
        return replace(inputs, state=replace(inputs.state, home_position_ned_m=None))

    harness = GuidanceHarness(flying(), inputs=homeless)
    engaged(harness)
    assert_failed(harness.command(FollowPathBehaviour([(0.0, 0.0), (10.0, 0.0)], 2.0)).result(), "home")
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
    stopped = harness.command(StopBehaviour())
    assert harness.outcome(stopped, 5.0).success
    silent = False
    harness.run(2.0)
    assert harness.vehicle.mode is FlightMode.HOLD
    assert harness.guidance.phase is Phase.IDLE


def test_takeoff_request_needs_an_altitude() -> None:
    with pytest.raises(ValueError, match="altitude"):
        ModeRequest(FlightMode.TAKEOFF)


def test_mode_change_after_a_command_supersedes_it() -> None:
    harness = GuidanceHarness(flying())
    harness.run(0.1)
    given = CommandInput(99, "hold", HoldBehaviour(), mode_changes=harness.autopilot.mode_changes)
    harness.autopilot.change_mode(FlightMode.POSITION)
    harness.autopilot.step(STEP_S)
    harness.step(given)
    assert " position, armed)" in harness.results[99].reason
    harness.run(1.0)
    assert not harness.guidance.in_command
    assert harness.autopilot.setpoints == []


class NeedsGimbal(HoldBehaviour):
    name = "needs-gimbal"
    requirements = HoldBehaviour.requirements | {Requirement.GIMBAL}


def test_found_gimbal_has_time_to_report_its_attitude() -> None:
    gimbal: GimbalState | None = None

    def modify(inputs: GuidanceInput) -> GuidanceInput:
        return replace(inputs, state=replace(inputs.state, gimbal=gimbal))

    harness = GuidanceHarness(flying(), inputs=modify)
    start = harness.autopilot.start

    def found(request: Request) -> None:
        if isinstance(request.action, FindGimbal):
            harness.autopilot._answers.append(Answer(request.identifier))
        else:
            start(request)

    harness.autopilot.start = found  # type: ignore[method-assign]
    harness.run(0.1)
    command = harness.command(NeedsGimbal())
    harness.run(1.0)
    assert not command.done()
    now_ns = harness.vehicle.now_ns + 10**9
    gimbal = GimbalState(
        1, now_ns, now_ns, now_ns, (1.0, 0.0, 0.0, 0.0), YawFrame.NOSE, primary_control=NOBODY
    )
    harness.run(0.2)
    assert harness.guidance.behaviour is not None
    assert harness.guidance.behaviour.name == "needs-gimbal"


def test_goal_is_discarded_when_someone_else_flies() -> None:
    harness = GuidanceHarness(parked())
    harness.run(0.2)
    assert harness.outcome(harness.command(TakeoffBehaviour(3.0))).success
    assert not harness.guidance.in_command
    harness.autopilot.change_mode(FlightMode.POSITION)
    harness.run(0.5)
    position = (harness.vehicle.position[0] + 0.7, *harness.vehicle.position[1:])
    harness.vehicle.position[0] = position[0]
    harness.command(HoldBehaviour())
    harness.run(5.0)
    assert harness.vehicle.landed is LandedState.IN_AIR
    assert math.dist(harness.vehicle.position, position) < 0.1


@pytest.mark.parametrize(("speed_mps", "nearest_m"), [(0.5, 4.2), (0.8, 4.2)])
def test_approach_retreats_from_an_approaching_object(speed_mps: float, nearest_m: float) -> None:
    from tests.companion.guidance.guidance_harness import Flight
    from tests.companion.guidance.kinematic_vehicle import KinematicVehicle, SeenObject

    car, vehicle = SeenObject("car", 20.0, 0.0), KinematicVehicle()
    ranges: list[float] = []

    def each(seconds: float, active: KinematicVehicle) -> None:
        car.north = 20.0 - speed_mps * seconds
        ranges.append(math.hypot(car.north - active.position[0], car.east - active.position[1]))

    Flight(ApproachBehaviour(Approach(Subject("car"), distance_m=5.0, retries=0.0)), vehicle, [car]).run(
        25.0, each
    )
    assert min(ranges) > nearest_m
    assert min(ranges[-100:]) > 4.6
