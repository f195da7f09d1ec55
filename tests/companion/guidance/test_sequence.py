"""Missions flown in lockstep by the real pilot, streamer and envelope."""

from typing import Any

import pytest

from companion.guidance.behaviour import Behaviour, BehaviourContext, BehaviourOutput, Outcome, Requirement
from companion.guidance.behaviours.hold import HoldBehaviour
from companion.guidance.interface import EventKind
from companion.guidance.missions.mission_file import plan_from
from companion.guidance.missions.sequence import Plan, PlannedStep, SequenceBehaviour
from companion.vehicle.landing_target import LandingTarget
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import FlightMode, LandedState
from tests.companion.guidance.guidance_harness import GuidanceHarness, Pending
from tests.companion.guidance.kinematic_vehicle import KinematicVehicle


def flying() -> KinematicVehicle:
    return KinematicVehicle(mode=FlightMode.HOLD)


def parked() -> KinematicVehicle:
    return KinematicVehicle(
        position=[0.0, 0.0, 0.0], mode=FlightMode.HOLD, armed=False, landed=LandedState.ON_GROUND
    )


def mission(harness: GuidanceHarness, *steps: dict[str, Any], **top: float | str) -> SequenceBehaviour:
    text = "".join(f"{key} = {value!r}\n" for key, value in top.items())
    for step in steps:
        text += "[[step]]\n" + "".join(f"{key} = {value!r}\n" for key, value in step.items())
    return SequenceBehaviour(plan_from(text, "test.toml"), harness.guidance.check_requirements)


def begun(harness: GuidanceHarness, behaviour: Behaviour) -> Pending:
    harness.run(0.1)
    return harness.command(behaviour)


def told(harness: GuidanceHarness) -> list[str]:
    return [event.message for event in harness.events if event.kind is EventKind.NOTED]


def test_a_mission_from_the_ground_and_back_to_it() -> None:
    harness = GuidanceHarness(parked())
    behaviour = mission(
        harness,
        {"do": "takeoff 5"},
        {"do": "goto 6 0", "name": "out"},
        {"do": "hold 2", "name": "wait"},
        {"do": "land"},
    )
    outcome = harness.outcome(begun(harness, behaviour))
    assert outcome == Outcome(True, "flown, 4 steps")
    assert [record.title for record in behaviour.records] == ["takeoff altitude=5", "out", "wait", "land"]
    assert all(record.success for record in behaviour.records)
    assert harness.vehicle.position[0] == pytest.approx(6.0, abs=1.0)
    assert not harness.vehicle.armed
    assert harness.guidance.phase == "idle"
    assert "mission test: step 2 of 4: goto north=6 east=0" in told(harness)
    assert "offboard" in harness.autopilot.requests


def test_between_two_steps_flown_by_setpoints_not_one_setpoint_is_missing() -> None:
    harness = GuidanceHarness(flying())
    behaviour = mission(
        harness, {"do": "hold 1", "repeat": 2}, {"do": "goto 3 0"}, {"do": "orbit radius=3 laps=0.5"}
    )
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


def test_from_a_landing_the_next_step_may_take_off_again() -> None:
    harness = GuidanceHarness(parked())
    behaviour = mission(
        harness, {"do": "takeoff 3"}, {"do": "land"}, {"do": "takeoff 4"}, {"do": "hold 1"}, {"do": "rtl"}
    )
    outcome = harness.outcome(begun(harness, behaviour))
    assert outcome.success, outcome.reason
    assert harness.autopilot.requests.count("arm") == 2


def test_a_step_that_fails_ends_the_mission_and_is_named_and_the_vehicle_holds() -> None:
    harness = GuidanceHarness(flying())
    behaviour = mission(
        harness, {"do": "hold 1"}, {"do": "hold 60", "name": "long", "timeout_s": 2}, {"do": "land"}
    )
    outcome = harness.outcome(begun(harness, behaviour))
    assert outcome == Outcome(False, "step 2 of 3 (long): timed out after 2 s: holding")
    assert harness.guidance.phase == "offboard"
    assert isinstance(harness.guidance.behaviour, HoldBehaviour)
    assert "land" not in harness.autopilot.requests


def test_on_failure_branches_are_taken() -> None:
    harness = GuidanceHarness(flying())
    steps: list[dict[str, Any]] = [
        {"do": "hold 60", "timeout_s": 1, "on_failure": "other"},
        {"do": "hold 1", "name": "skipped"},
        {"do": "hold 0.5", "name": "other", "on_failure": "skipped"},
        {"do": "hold 60", "timeout_s": 1, "name": "ignored", "on_failure": "continue"},
        {"do": "hold 0.5", "name": "last", "on_success": "end"},
    ]
    behaviour = mission(harness, *steps)
    outcome = harness.outcome(begun(harness, behaviour))
    assert outcome.success, outcome.reason
    titles = [record.title for record in behaviour.records]
    assert titles == ["hold duration=60", "other", "ignored", "last"]
    assert [record.success for record in behaviour.records] == [False, True, False, True]


@pytest.mark.parametrize(("way", "mode"), [("rtl", FlightMode.RETURN), ("land", FlightMode.LAND)])
def test_a_failure_may_take_the_vehicle_down_and_the_mission_has_failed_all_the_same(
    way: str, mode: FlightMode
) -> None:
    harness = GuidanceHarness(flying())
    behaviour = mission(harness, {"do": "hold 60", "timeout_s": 1, "name": "wait", "on_failure": way})
    future = begun(harness, behaviour)
    harness.until(lambda: harness.vehicle.mode is mode)
    assert "way down after step 1 of 1 (wait)" in harness.guidance.status
    outcome = harness.outcome(future)
    assert not outcome.success
    assert outcome.reason.startswith("step 1 of 1 (wait): timed out after 1 s")
    assert outcome.reason.endswith("landed and disarmed")
    assert not harness.vehicle.armed


def test_a_step_that_is_refused_fails_with_what_it_needs() -> None:
    harness = GuidanceHarness(parked())
    behaviour = mission(
        harness, {"do": "takeoff 3"}, {"do": "land"}, {"do": "hold 5", "name": "too late"}, {"do": "land"}
    )
    outcome = harness.outcome(begun(harness, behaviour))
    assert outcome.reason == (
        "step 3 of 4 (too late): refused: hold needs to be in the air (disarmed, on ground)"
    )


def test_what_the_first_step_needs_refuses_the_mission_and_leaves_what_flies_alone() -> None:
    harness = GuidanceHarness(flying())
    current = begun(harness, HoldBehaviour())
    refused = harness.command(mission(harness, {"do": "takeoff 3"}, {"do": "land"}))
    assert refused.result().reason == "mission needs to be on the ground (armed, in air)"
    assert not current.done()
    # A mission that knows what to do then is flown.
    behaviour = mission(harness, {"do": "takeoff 3", "on_failure": "continue"}, {"do": "hold 1"})
    outcome = harness.outcome(harness.command(behaviour))
    assert outcome.success
    assert current.result().reason == "replaced by mission"


def test_a_class_the_detector_does_not_know_refuses_the_whole_mission() -> None:
    harness = GuidanceHarness(flying(), class_names=("person", "car"))
    harness.run(0.1)
    outcome = harness.command(mission(harness, {"do": "hold 1"}, {"do": "seek zebra"})).result()
    assert outcome == Outcome(False, "mission needs a detector that knows zebra")


def test_a_mode_the_autopilot_refuses_is_the_failure_of_its_step_alone() -> None:
    harness = GuidanceHarness(flying())
    harness.autopilot.refuse[FlightMode.LAND] = "land refused: no place"
    behaviour = mission(
        harness,
        {"do": "hold 0.5"},
        {"do": "land", "name": "down", "on_failure": "stay"},
        {"do": "hold 1", "name": "stay", "on_failure": "down"},
    )
    outcome = harness.outcome(begun(harness, behaviour))
    assert outcome.success, outcome.reason
    assert [(record.title, record.success) for record in behaviour.records][1:] == [
        ("down", False),
        ("stay", True),
    ]
    assert behaviour.records[1].reason == "land refused: no place"
    assert harness.autopilot.requests.count("offboard") == 1


def test_a_refused_offboard_is_a_failure_of_the_step_and_nothing_is_sent_any_more() -> None:
    harness = GuidanceHarness(flying())
    harness.autopilot.refuse[FlightMode.OFFBOARD] = "offboard refused"
    behaviour = mission(harness, {"do": "hold 1", "name": "stay", "on_failure": "land"})
    outcome = harness.outcome(begun(harness, behaviour))
    assert outcome.reason == "step 1 of 1 (stay): offboard refused; landed and disarmed"


def test_an_arming_that_is_refused_ends_the_mission_on_the_ground() -> None:
    harness = GuidanceHarness(parked())

    harness.autopilot.refuse_arming = "arming refused: no GPS"
    outcome = harness.outcome(begun(harness, mission(harness, {"do": "takeoff 3"})))
    assert outcome == Outcome(False, "step 1 of 1 (takeoff altitude=3): arming refused: no GPS")
    assert harness.guidance.phase == "idle"
    assert not harness.autopilot.setpoints


def test_a_command_without_end_is_done_after_its_time() -> None:
    harness = GuidanceHarness(flying())
    behaviour = mission(harness, {"do": "orbit radius=5", "timeout_s": 4}, {"do": "hold 0.5"})
    outcome = harness.outcome(begun(harness, behaviour))
    assert outcome.success
    assert behaviour.records[0].reason == "flown for 4 s"


def test_a_limit_of_visits_ends_a_loop() -> None:
    harness = GuidanceHarness(flying())
    behaviour = mission(
        harness,
        {"do": "hold 0.2", "name": "a", "visits": 3},
        {"do": "hold 0.2", "name": "b", "on_success": "a"},
    )
    outcome = harness.outcome(begun(harness, behaviour))
    assert outcome == Outcome(False, "step 1 of 2 (a): begun 3 times already")
    assert [record.title for record in behaviour.records] == ["a", "b"] * 3


def test_steps_that_fail_at_once_do_not_go_round_for_ever() -> None:
    harness = GuidanceHarness(flying())
    harness.perception_age_s = None
    behaviour = mission(harness, {"do": "hold 0.2"}, {"do": "seek car", "name": "look", "on_failure": "look"})
    outcome = harness.outcome(begun(harness, behaviour))
    assert not outcome.success
    assert "end as soon as they begin" in outcome.reason
    assert "perception" in outcome.reason


def test_the_time_of_the_whole_mission_ends_the_step_that_is_flown() -> None:
    harness = GuidanceHarness(flying())
    behaviour = mission(harness, {"do": "hold 60", "name": "wait", "on_failure": "continue"}, timeout_s=3)
    outcome = harness.outcome(begun(harness, behaviour))
    assert outcome == Outcome(False, "step 1 of 1 (wait): the mission's 3 s are over")


@pytest.mark.parametrize("mode", [FlightMode.POSITION, FlightMode.HOLD, FlightMode.RETURN])
def test_a_pilot_ends_the_mission_at_any_step_and_nothing_is_sent_after(mode: FlightMode) -> None:
    harness = GuidanceHarness(flying())
    behaviour = mission(
        harness, *({"do": "hold 0.1", "on_failure": "continue"} for _ in range(30)), {"do": "land"}
    )
    future = begun(harness, behaviour)
    harness.until(lambda: len(behaviour.records) >= 3)
    harness.autopilot.change_mode(mode)
    harness.until(future.done, 2.0)
    sent, active = len(harness.autopilot.setpoints), len(behaviour.records)
    ended = behaviour.told(future.result())
    assert ended.reason.startswith("step ")
    assert "the pilot took over" in ended.reason
    # OFFBOARD that comes back by itself is not ours to use.
    harness.autopilot.change_mode(FlightMode.OFFBOARD)
    harness.run(5.0)
    assert len(harness.autopilot.setpoints) == sent
    assert len(behaviour.records) == active
    assert not harness.guidance.in_command


def test_an_operators_command_ends_the_mission_at_once() -> None:
    harness = GuidanceHarness(flying())
    behaviour = mission(harness, {"do": "hold 5", "on_failure": "land"}, {"do": "land"})
    future = begun(harness, behaviour)
    harness.until(lambda: harness.guidance.phase == "offboard")
    harness.run(1.0)
    harness.command(HoldBehaviour())
    assert behaviour.told(future.result()).reason == "step 1 of 2 (hold duration=5): replaced by hold"
    harness.run(10.0)
    assert "land" not in harness.autopilot.requests
    assert harness.guidance.phase == "offboard"


class Broken(Behaviour):
    """Fails in its second turn."""

    name = "broken"
    requirements = frozenset({Requirement.POSITION})
    left = False

    def update(self, dt_s: float, context: BehaviourContext) -> BehaviourOutput:
        if dt_s:
            raise ZeroDivisionError("no such luck")
        return Setpoint.brake(context.now_ns)

    def on_deactivate(self) -> None:
        self.left = True


def test_what_goes_wrong_in_a_step_is_its_failure_and_the_plan_goes_on() -> None:
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
    outcome = harness.outcome(begun(harness, behaviour))
    assert outcome.success
    assert behaviour.records[0].reason == "broken failed: ZeroDivisionError: no such luck"
    assert broken.left


TARGET = LandingTarget(7, 1, (1.0, 2.0, 0.0), (0.1, 0.2, 4.0), 0.2)


class Telling(HoldBehaviour):
    landing_target = TARGET


def test_what_a_step_tells_and_needs_is_told_and_needed_by_the_mission() -> None:
    harness, telling = GuidanceHarness(flying()), Telling(1.0)
    plan = Plan(
        "test", (PlannedStep("tell", "hold", lambda: telling),), way_down=lambda word: HoldBehaviour()
    )
    behaviour = SequenceBehaviour(plan, harness.guidance.check_requirements)
    assert behaviour.landing_target is None
    future = begun(harness, behaviour)
    harness.until(lambda: harness.guidance.phase == "offboard")
    assert behaviour.landing_target == TARGET
    assert [output.landing_target for output in harness.outputs if output.landing_target] == [TARGET], "once"
    assert behaviour.active is telling
    assert behaviour.requirements == telling.requirements
    harness.outcome(future)
