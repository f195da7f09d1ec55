"""Missions flown in lockstep by the real pilot, streamer and envelope."""

import pytest
from kinematic_vehicle import KinematicVehicle
from scripted_autopilot import Cockpit

from companion.guidance.behaviour import Behaviour, Outcome, Requirement
from companion.guidance.hold import HoldBehaviour
from companion.guidance.pilot_event import PilotEventKind
from companion.guidance.sequence import Plan, PlannedStep, SequenceBehaviour
from companion.missions.mission_file import plan_from
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import FlightMode, LandedState


def flying():
    return KinematicVehicle(mode=FlightMode.HOLD)


def parked():
    return KinematicVehicle(
        position=[0.0, 0.0, 0.0], mode=FlightMode.HOLD, armed=False, landed=LandedState.ON_GROUND
    )


def mission(cockpit, *steps, **top):
    text = "".join(f"{key} = {value!r}\n" for key, value in top.items())
    for step in steps:
        text += "[[step]]\n" + "".join(f"{key} = {value!r}\n" for key, value in step.items())
    return SequenceBehaviour(plan_from(text, "test.toml"), cockpit.pilot.refusal_of)


async def begun(cockpit, behaviour):
    await cockpit.turn(0.1)
    return cockpit.pilot.command(behaviour)


def told(cockpit):
    return [event.message for event in cockpit.events if event.kind is PilotEventKind.NOTED]


async def test_a_mission_from_the_ground_and_back_to_it():
    cockpit = Cockpit(parked())
    behaviour = mission(
        cockpit,
        {"do": "takeoff 5"},
        {"do": "goto 6 0", "name": "out"},
        {"do": "hold 2", "name": "wait"},
        {"do": "land"},
    )
    outcome = await cockpit.outcome(await begun(cockpit, behaviour))
    assert outcome == Outcome(True, "flown, 4 steps")
    assert [record.title for record in behaviour.records] == ["takeoff altitude=5", "out", "wait", "land"]
    assert all(record.success for record in behaviour.records)
    assert cockpit.vehicle.position[0] == pytest.approx(6.0, abs=1.0)
    assert not cockpit.vehicle.armed
    assert cockpit.pilot.phase == "idle"
    assert "mission test: step 2 of 4: goto north=6 east=0" in told(cockpit)
    assert "offboard" in cockpit.autopilot.requests


async def test_between_two_steps_flown_by_setpoints_not_one_setpoint_is_missing():
    cockpit = Cockpit(flying())
    behaviour = mission(
        cockpit, {"do": "hold 1", "repeat": 2}, {"do": "goto 3 0"}, {"do": "orbit radius=3 laps=0.5"}
    )
    future = await begun(cockpit, behaviour)
    await cockpit.until(lambda: cockpit.pilot.phase == "offboard")
    while not future.done():
        before = len(cockpit.autopilot.setpoints)
        await cockpit.turn()
        assert len(cockpit.autopilot.setpoints) == before + 1
        assert cockpit.autopilot.setpoints[-1].deadline_ns >= cockpit.vehicle.now_ns
        assert cockpit.pilot.phase == "offboard"
    assert future.result().success, future.result().reason
    assert len(behaviour.records) == 4
    assert cockpit.autopilot.requests == ["offboard"]


async def test_from_a_landing_the_next_step_may_take_off_again():
    cockpit = Cockpit(parked())
    behaviour = mission(
        cockpit, {"do": "takeoff 3"}, {"do": "land"}, {"do": "takeoff 4"}, {"do": "hold 1"}, {"do": "rtl"}
    )
    outcome = await cockpit.outcome(await begun(cockpit, behaviour))
    assert outcome.success, outcome.reason
    assert cockpit.autopilot.requests.count("arm") == 2


async def test_a_step_that_fails_ends_the_mission_and_is_named_and_the_vehicle_holds():
    cockpit = Cockpit(flying())
    behaviour = mission(
        cockpit, {"do": "hold 1"}, {"do": "hold 60", "name": "long", "timeout_s": 2}, {"do": "land"}
    )
    outcome = await cockpit.outcome(await begun(cockpit, behaviour))
    assert outcome == Outcome(False, "step 2 of 3 (long): timed out after 2 s: holding")
    assert cockpit.pilot.phase == "offboard"
    assert isinstance(cockpit.pilot.behaviour, HoldBehaviour)
    assert "land" not in cockpit.autopilot.requests


async def test_on_failure_branches_are_taken():
    cockpit = Cockpit(flying())
    steps = [
        {"do": "hold 60", "timeout_s": 1, "on_failure": "other"},
        {"do": "hold 1", "name": "skipped"},
        {"do": "hold 0.5", "name": "other", "on_failure": "skipped"},
        {"do": "hold 60", "timeout_s": 1, "name": "ignored", "on_failure": "continue"},
        {"do": "hold 0.5", "name": "last", "on_success": "end"},
    ]
    behaviour = mission(cockpit, *steps)
    outcome = await cockpit.outcome(await begun(cockpit, behaviour))
    assert outcome.success, outcome.reason
    titles = [record.title for record in behaviour.records]
    assert titles == ["hold duration=60", "other", "ignored", "last"]
    assert [record.success for record in behaviour.records] == [False, True, False, True]


@pytest.mark.parametrize(("way", "mode"), [("rtl", FlightMode.RETURN), ("land", FlightMode.LAND)])
async def test_a_failure_may_take_the_vehicle_down_and_the_mission_has_failed_all_the_same(way, mode):
    cockpit = Cockpit(flying())
    behaviour = mission(cockpit, {"do": "hold 60", "timeout_s": 1, "name": "wait", "on_failure": way})
    future = await begun(cockpit, behaviour)
    await cockpit.until(lambda: cockpit.vehicle.mode is mode)
    assert "way down after step 1 of 1 (wait)" in cockpit.pilot.status
    outcome = await cockpit.outcome(future)
    assert not outcome.success
    assert outcome.reason.startswith("step 1 of 1 (wait): timed out after 1 s")
    assert outcome.reason.endswith("landed and disarmed")
    assert not cockpit.vehicle.armed


async def test_a_step_that_is_refused_fails_with_what_it_needs():
    cockpit = Cockpit(parked())
    behaviour = mission(
        cockpit, {"do": "takeoff 3"}, {"do": "land"}, {"do": "hold 5", "name": "too late"}, {"do": "land"}
    )
    outcome = await cockpit.outcome(await begun(cockpit, behaviour))
    assert outcome.reason == (
        "step 3 of 4 (too late): refused: hold needs to be in the air (disarmed, on ground)"
    )


async def test_what_the_first_step_needs_refuses_the_mission_and_leaves_what_flies_alone():
    cockpit = Cockpit(flying())
    current = await begun(cockpit, HoldBehaviour())
    refused = cockpit.pilot.command(mission(cockpit, {"do": "takeoff 3"}, {"do": "land"}))
    assert refused.result().reason == "mission needs to be on the ground (armed, in air)"
    assert not current.done()
    # A mission that knows what to do then is flown.
    behaviour = mission(cockpit, {"do": "takeoff 3", "on_failure": "continue"}, {"do": "hold 1"})
    outcome = await cockpit.outcome(cockpit.pilot.command(behaviour))
    assert outcome.success
    assert current.result().reason == "replaced by mission"


async def test_a_class_the_detector_does_not_know_refuses_the_whole_mission():
    cockpit = Cockpit(flying(), class_names=("person", "car"))
    await cockpit.turn(0.1)
    outcome = cockpit.pilot.command(mission(cockpit, {"do": "hold 1"}, {"do": "seek zebra"})).result()
    assert outcome == Outcome(False, "mission needs a detector that knows zebra")


async def test_a_mode_the_autopilot_refuses_is_the_failure_of_its_step_alone():
    cockpit = Cockpit(flying())
    cockpit.autopilot.refuse[FlightMode.LAND] = "land refused: no place"
    behaviour = mission(
        cockpit,
        {"do": "hold 0.5"},
        {"do": "land", "name": "down", "on_failure": "stay"},
        {"do": "hold 1", "name": "stay", "on_failure": "down"},
    )
    outcome = await cockpit.outcome(await begun(cockpit, behaviour))
    assert outcome.success, outcome.reason
    assert [(record.title, record.success) for record in behaviour.records][1:] == [
        ("down", False),
        ("stay", True),
    ]
    assert behaviour.records[1].reason == "land refused: no place"
    assert cockpit.autopilot.requests.count("offboard") == 1


async def test_a_refused_offboard_is_a_failure_of_the_step_and_nothing_is_sent_any_more():
    cockpit = Cockpit(flying())
    cockpit.autopilot.refuse[FlightMode.OFFBOARD] = "offboard refused"
    behaviour = mission(cockpit, {"do": "hold 1", "name": "stay", "on_failure": "land"})
    outcome = await cockpit.outcome(await begun(cockpit, behaviour))
    assert outcome.reason == "step 1 of 1 (stay): offboard refused; landed and disarmed"


async def test_an_arming_that_is_refused_ends_the_mission_on_the_ground():
    cockpit = Cockpit(parked())

    async def no_arming():
        from companion.vehicle.driver import CommandRefusedError

        raise CommandRefusedError("arming refused: no GPS")

    cockpit.autopilot.arm = no_arming
    outcome = await cockpit.outcome(await begun(cockpit, mission(cockpit, {"do": "takeoff 3"})))
    assert outcome == Outcome(False, "step 1 of 1 (takeoff altitude=3): arming refused: no GPS")
    assert cockpit.pilot.phase == "idle"
    assert not cockpit.autopilot.setpoints


async def test_a_command_without_end_is_done_after_its_time():
    cockpit = Cockpit(flying())
    behaviour = mission(cockpit, {"do": "orbit radius=5", "timeout_s": 4}, {"do": "hold 0.5"})
    outcome = await cockpit.outcome(await begun(cockpit, behaviour))
    assert outcome.success
    assert behaviour.records[0].reason == "flown for 4 s"


async def test_a_limit_of_visits_ends_a_loop():
    cockpit = Cockpit(flying())
    behaviour = mission(
        cockpit,
        {"do": "hold 0.2", "name": "a", "visits": 3},
        {"do": "hold 0.2", "name": "b", "on_success": "a"},
    )
    outcome = await cockpit.outcome(await begun(cockpit, behaviour))
    assert outcome == Outcome(False, "step 1 of 2 (a): begun 3 times already")
    assert [record.title for record in behaviour.records] == ["a", "b"] * 3


async def test_steps_that_fail_at_once_do_not_go_round_for_ever():
    cockpit = Cockpit(flying())
    cockpit.perception_age_s = None
    behaviour = mission(cockpit, {"do": "hold 0.2"}, {"do": "seek car", "name": "look", "on_failure": "look"})
    outcome = await cockpit.outcome(await begun(cockpit, behaviour))
    assert not outcome.success
    assert "end as soon as they begin" in outcome.reason
    assert "perception" in outcome.reason


async def test_the_time_of_the_whole_mission_ends_the_step_that_is_flown():
    cockpit = Cockpit(flying())
    behaviour = mission(cockpit, {"do": "hold 60", "name": "wait", "on_failure": "continue"}, timeout_s=3)
    outcome = await cockpit.outcome(await begun(cockpit, behaviour))
    assert outcome == Outcome(False, "step 1 of 1 (wait): the mission's 3 s are over")


@pytest.mark.parametrize("mode", [FlightMode.POSITION, FlightMode.HOLD, FlightMode.RETURN])
async def test_a_pilot_ends_the_mission_at_any_step_and_nothing_is_sent_after(mode):
    cockpit = Cockpit(flying())
    behaviour = mission(
        cockpit, *({"do": "hold 0.1", "on_failure": "continue"} for _ in range(30)), {"do": "land"}
    )
    future = await begun(cockpit, behaviour)
    await cockpit.until(lambda: len(behaviour.records) >= 3)
    cockpit.autopilot.change_mode(mode)
    await cockpit.until(future.done, 2.0)
    sent, flown = len(cockpit.autopilot.setpoints), len(behaviour.records)
    ended = behaviour.told(future.result())
    assert ended.reason.startswith("step ")
    assert "the pilot took over" in ended.reason
    # OFFBOARD that comes back by itself is not ours to use.
    cockpit.autopilot.change_mode(FlightMode.OFFBOARD)
    await cockpit.turn(5.0)
    assert len(cockpit.autopilot.setpoints) == sent
    assert len(behaviour.records) == flown
    assert not cockpit.pilot.in_command


async def test_an_operators_command_ends_the_mission_at_once():
    cockpit = Cockpit(flying())
    behaviour = mission(cockpit, {"do": "hold 5", "on_failure": "land"}, {"do": "land"})
    future = await begun(cockpit, behaviour)
    await cockpit.until(lambda: cockpit.pilot.phase == "offboard")
    await cockpit.turn(1.0)
    cockpit.pilot.command(HoldBehaviour())
    assert behaviour.told(future.result()).reason == "step 1 of 2 (hold duration=5): replaced by hold"
    await cockpit.turn(10.0)
    assert "land" not in cockpit.autopilot.requests
    assert cockpit.pilot.phase == "offboard"


class Broken(Behaviour):
    """Fails in its second turn."""

    name = "broken"
    requirements = frozenset({Requirement.POSITION})
    left = False

    def update(self, dt_s, situation):
        if dt_s:
            raise ZeroDivisionError("no such luck")
        return Setpoint.brake(situation.now_ns)

    def on_deactivate(self):
        self.left = True


async def test_what_goes_wrong_in_a_step_is_its_failure_and_the_plan_goes_on():
    cockpit, broken = Cockpit(flying()), Broken()
    plan = Plan(
        "test",
        (
            PlannedStep("first", "broken", lambda: broken, on_success=1, on_failure=1),
            PlannedStep("second", "hold", lambda: HoldBehaviour(0.5)),
        ),
        way_down=lambda word: HoldBehaviour(0.1),
    )
    behaviour = SequenceBehaviour(plan, cockpit.pilot.refusal_of)
    outcome = await cockpit.outcome(await begun(cockpit, behaviour))
    assert outcome.success
    assert behaviour.records[0].reason == "broken failed: ZeroDivisionError: no such luck"
    assert broken.left


class Telling(HoldBehaviour):
    landing_target = "what the autopilot is to land on"


async def test_what_a_step_tells_and_needs_is_told_and_needed_by_the_mission():
    cockpit, telling = Cockpit(flying()), Telling(1.0)
    plan = Plan(
        "test", (PlannedStep("tell", "hold", lambda: telling),), way_down=lambda word: HoldBehaviour()
    )
    behaviour = SequenceBehaviour(plan, cockpit.pilot.refusal_of)
    assert behaviour.landing_target is None
    future = await begun(cockpit, behaviour)
    await cockpit.until(lambda: cockpit.pilot.phase == "offboard")
    assert behaviour.landing_target == "what the autopilot is to land on"
    assert behaviour.flown is telling
    assert behaviour.requirements == telling.requirements
    await cockpit.outcome(future)
