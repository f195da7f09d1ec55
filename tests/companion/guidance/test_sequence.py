"""Missions in lockstep with the real guidance, streamer and envelope."""

from collections.abc import Callable
from typing import Any

import pytest

from companion.guidance.behaviour import Behaviour, BehaviourContext, BehaviourOutput, Outcome, Requirement
from companion.guidance.behaviours.hold import HoldBehaviour
from companion.guidance.interface import EventKind
from companion.guidance.missions.sequence import Plan, PlannedStep, SequenceBehaviour
from companion.vehicle.landing_target import LandingTarget
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import FlightMode
from tests.companion.guidance.guidance_harness import (
    GuidanceHarness,
    Pending,
    ScriptedAutopilot,
    assert_failed,
    assert_succeeded,
    flying,
    hovering,
    known,
    mission,
    parked,
)
from tests.companion.guidance.kinematic_vehicle import KinematicVehicle


def begun(harness: GuidanceHarness, behaviour: Behaviour) -> Pending:
    harness.run(0.1)
    return harness.command(behaviour)


def flown(
    *steps: str | dict[str, Any],
    of: KinematicVehicle | None = None,
    prepare: Callable[[ScriptedAutopilot], object] = lambda autopilot: None,
    **top: Any,
) -> tuple[GuidanceHarness, SequenceBehaviour, Outcome]:
    """A mission from its start, by default in the air, to its end."""
    harness = GuidanceHarness(of or flying())
    prepare(harness.autopilot)
    behaviour = mission(harness, *steps, **top)
    return harness, behaviour, known(harness.outcome(begun(harness, behaviour)))


def messages(harness: GuidanceHarness) -> list[str]:
    return [event.message for event in harness.events if event.kind is EventKind.NOTED]


def test_mission_from_takeoff_to_landing() -> None:
    harness, behaviour, outcome = flown(
        "takeoff 5",
        {"do": "goto 6 0", "name": "out"},
        {"do": "hold 2", "name": "wait"},
        "land",
        of=parked(),
    )
    assert outcome == Outcome(True, "flown, 4 steps")
    assert [record.title for record in behaviour.records] == ["takeoff altitude=5", "out", "wait", "land"]
    assert all(record.success for record in behaviour.records)
    assert harness.vehicle.position[0] == pytest.approx(6.0, abs=1.0)
    assert not harness.vehicle.armed
    assert harness.guidance.phase == "idle"
    step = "step 2 of 4: goto north=6 east=0"
    assert f"mission test: {step}" in messages(harness)
    assert "offboard" in harness.autopilot.requests


def test_setpoints_continue_between_steps() -> None:
    harness = GuidanceHarness(flying())
    behaviour = mission(harness, {"do": "hold 1", "repeat": 2}, "goto 3 0", "orbit radius=3 laps=0.5")
    future = begun(harness, behaviour)
    harness.until(lambda: harness.guidance.phase == "offboard")
    while not future.done():
        before = len(harness.autopilot.setpoints)
        harness.run()
        assert len(harness.autopilot.setpoints) == before + 1
        assert harness.autopilot.setpoints[-1].deadline_ns >= harness.vehicle.now_ns
        assert harness.guidance.phase == "offboard"
    assert future.result().success, future.result().reason
    assert len(behaviour.records) == 4
    assert harness.autopilot.requests == ["offboard"]


def test_takeoff_after_a_landing_step() -> None:
    harness, _, outcome = flown("takeoff 3", "land", "takeoff 4", "hold 1", "rtl", of=parked())
    assert_succeeded(outcome)
    assert harness.autopilot.requests.count("arm") == 2


def test_failed_step_ends_the_mission_in_hold() -> None:
    harness, _, outcome = flown("hold 1", {"do": "hold 60", "name": "long", "timeout_s": 2}, "land")
    assert_failed(outcome, "step 2 of 3 (long)", "timed out after 2 s: holding")
    assert harness.guidance.phase == "offboard"
    assert isinstance(harness.guidance.behaviour, HoldBehaviour)
    assert "land" not in harness.autopilot.requests


def test_on_failure_branches_are_taken() -> None:
    _, behaviour, outcome = flown(
        {"do": "hold 60", "timeout_s": 1, "on_failure": "other"},
        {"do": "hold 1", "name": "skipped"},
        {"do": "hold 0.5", "name": "other", "on_failure": "skipped"},
        {"do": "hold 60", "timeout_s": 1, "name": "ignored", "on_failure": "continue"},
        {"do": "hold 0.5", "name": "last", "on_success": "end"},
    )
    assert_succeeded(outcome)
    titles = [record.title for record in behaviour.records]
    assert titles == ["hold duration=60", "other", "ignored", "last"]
    assert [record.success for record in behaviour.records] == [False, True, False, True]


@pytest.mark.parametrize(("branch", "mode"), [("rtl", FlightMode.RETURN), ("land", FlightMode.LAND)])
def test_on_failure_rtl_or_land_still_fails_the_mission(branch: str, mode: FlightMode) -> None:
    harness = GuidanceHarness(flying())
    behaviour = mission(harness, {"do": "hold 60", "timeout_s": 1, "name": "wait", "on_failure": branch})
    future = begun(harness, behaviour)
    harness.until(lambda: harness.vehicle.mode is mode)
    assert "descent after " in harness.guidance.status
    assert "after step 1" in harness.guidance.status
    outcome = assert_failed(harness.outcome(future), "timed out")
    assert outcome.reason.endswith("and disarmed")
    assert not harness.vehicle.armed


def test_refused_step_fails_with_its_requirement() -> None:
    _, _, outcome = flown("takeoff 3", "land", {"do": "hold 5", "name": "too late"}, "land", of=parked())
    assert_failed(outcome, "step 3 of 4 (too late)", "in the air")


def test_first_step_requirement_refuses_the_mission() -> None:
    harness = GuidanceHarness(flying())
    current = begun(harness, HoldBehaviour())
    refused = harness.command(mission(harness, "takeoff 3", "land"))
    assert_failed(refused.result(), "mission needs ", "the ground")
    assert not current.done()
    # A mission with a branch for that failure is flown.
    behaviour = mission(harness, {"do": "takeoff 3", "on_failure": "continue"}, "hold 1")
    assert_succeeded(harness.outcome(harness.command(behaviour)))
    assert_failed(current.result(), "replaced by ", " mission")


def test_unknown_class_refuses_the_whole_mission() -> None:
    harness = hovering(class_names=("person", "car"))
    outcome = harness.command(mission(harness, "hold 1", "seek zebra")).result()
    assert_failed(outcome, "a detector ", "knows zebra")


def test_refused_mode_fails_only_its_step() -> None:
    harness, behaviour, outcome = flown(
        "hold 0.5",
        {"do": "land", "name": "down", "on_failure": "stay"},
        {"do": "hold 1", "name": "stay", "on_failure": "down"},
        prepare=lambda autopilot: autopilot.refuse.update({FlightMode.LAND: "land refused"}),
    )
    assert_succeeded(outcome)
    assert [(record.title, record.success) for record in behaviour.records][1:] == [
        ("down", False),
        ("stay", True),
    ]
    assert behaviour.records[1].reason == "land refused"
    assert harness.autopilot.requests.count("offboard") == 1


def test_refused_offboard_fails_the_step_and_stops_stream() -> None:
    _, _, outcome = flown(
        {"do": "hold 1", "name": "stay", "on_failure": "land"},
        prepare=lambda autopilot: autopilot.refuse.update({FlightMode.OFFBOARD: "offboard refused"}),
    )
    assert_failed(outcome, "(stay)", "offboard refused", "landed and disarmed")


def test_refused_arming_ends_the_mission_on_the_ground() -> None:
    harness, _, outcome = flown(
        "takeoff 3", of=parked(), prepare=lambda autopilot: setattr(autopilot, "refuse_arming", "no GPS")
    )
    assert assert_failed(outcome).reason.endswith("no GPS")
    assert harness.guidance.phase == "idle"
    assert not harness.autopilot.setpoints


def test_endless_step_succeeds_at_its_timeout() -> None:
    _, behaviour, outcome = flown({"do": "orbit radius=5", "timeout_s": 4}, "hold 0.5")
    assert_succeeded(outcome)
    assert "4 s" in behaviour.records[0].reason


def test_visits_limit_ends_a_loop() -> None:
    _, behaviour, outcome = flown(
        {"do": "hold 0.2", "name": "a", "visits": 3}, {"do": "hold 0.2", "name": "b", "on_success": "a"}
    )
    assert_failed(outcome, "visits limit 3")
    assert [record.title for record in behaviour.records] == ["a", "b"] * 3


def test_loop_of_steps_that_fail_at_once_ends() -> None:
    harness = GuidanceHarness(flying())
    behaviour = mission(harness, "hold 0.2", {"do": "seek car", "name": "look", "on_failure": "look"})
    pending = begun(harness, behaviour)
    harness.perception_age_s = None
    outcome = harness.outcome(pending)
    assert_failed(outcome, "loop of ", "at once", "perception")


def test_mission_timeout_ends_the_current_step() -> None:
    _, _, outcome = flown({"do": "hold 60", "name": "wait", "on_failure": "continue"}, timeout_s=3)
    assert_failed(outcome, "after 3 s")


@pytest.mark.parametrize("mode", [FlightMode.POSITION, FlightMode.HOLD, FlightMode.RETURN])
def test_pilot_ends_the_mission_at_any_step(mode: FlightMode) -> None:
    harness = GuidanceHarness(flying())
    behaviour = mission(harness, *({"do": "hold 0.1", "on_failure": "continue"} for _ in range(30)), "land")
    future = begun(harness, behaviour)
    harness.until(lambda: len(behaviour.records) >= 3)
    harness.autopilot.change_mode(mode)
    harness.until(future.done, 2.0)
    active = len(behaviour.records)
    ended = behaviour.with_step(future.result())
    assert ended.reason.startswith("step ")
    assert "pilot" in ended.reason
    # OFFBOARD that comes back by itself does not restore our command.
    harness.autopilot.change_mode(FlightMode.OFFBOARD)
    assert harness.silent(5.0)
    assert len(behaviour.records) == active
    assert not harness.guidance.in_command


def test_new_command_ends_the_mission_at_once() -> None:
    harness = GuidanceHarness(flying())
    behaviour = mission(harness, {"do": "hold 5", "on_failure": "land"}, "land")
    future = begun(harness, behaviour)
    harness.until(lambda: harness.guidance.phase == "offboard")
    harness.run(1.0)
    harness.command("hold")
    reason = behaviour.with_step(future.result()).reason
    assert reason.startswith("step 1 of 2 (hold ")
    assert ": replaced " in reason
    assert reason.endswith(" hold")
    harness.run(10.0)
    assert "land" not in harness.autopilot.requests
    assert harness.guidance.phase == "offboard"


class Broken(Behaviour):
    """Fails in its second update."""

    name = "broken"
    requirements = frozenset({Requirement.POSITION})
    left = False

    def update(self, dt_s: float, context: BehaviourContext) -> BehaviourOutput:
        if dt_s:
            raise ZeroDivisionError("test")
        return Setpoint.brake(context.now_ns)

    def on_deactivate(self) -> None:
        self.left = True


def test_exception_fails_the_step_and_the_plan_goes_on() -> None:
    harness, broken = GuidanceHarness(flying()), Broken()
    plan = Plan(
        "test",
        (
            PlannedStep("first", "broken", lambda: broken, on_success=1, on_failure=1),
            PlannedStep("second", "hold", lambda: HoldBehaviour(0.5)),
        ),
        way_down=lambda word: HoldBehaviour(0.1),
    )
    behaviour = SequenceBehaviour(plan, harness.guidance.check_requirements)
    assert_succeeded(harness.outcome(begun(harness, behaviour)))
    assert "ZeroDivisionError" in behaviour.records[0].reason
    assert broken.left


TARGET = LandingTarget(7, 1, (1.0, 2.0, 0.0), (0.1, 0.2, 4.0), 0.2)


class Noting(HoldBehaviour):
    landing_target = TARGET


def test_mission_forwards_notes_and_requirements() -> None:
    harness, noting = GuidanceHarness(flying()), Noting(1.0)
    plan = Plan("test", (PlannedStep("note", "hold", lambda: noting),), way_down=lambda word: HoldBehaviour())
    behaviour = SequenceBehaviour(plan, harness.guidance.check_requirements)
    assert behaviour.landing_target is None
    future = begun(harness, behaviour)
    harness.until(lambda: harness.guidance.phase == "offboard")
    assert behaviour.landing_target == TARGET
    assert harness.autopilot.landing_targets == [TARGET], "once"
    assert behaviour.active is noting
    assert behaviour.requirements == noting.requirements
    harness.outcome(future)
