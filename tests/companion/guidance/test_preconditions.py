"""What a take-off or a mission needs later is checked before it arms; a failed take-off disarms again."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import pytest

from companion.guidance.behaviour import OF_THE_MOMENT, Outcome, Requirement
from companion.guidance.behaviours.takeoff import TakeoffBehaviour
from companion.guidance.command import COMMANDS, NO_CONTEXT
from companion.guidance.core import GuidanceOptions
from companion.guidance.formation.neighbours import Neighbour, Neighbourhood
from companion.guidance.gimbal.controller import GimbalMounting
from companion.guidance.grammar import parse
from companion.guidance.interface import GuidanceInput
from companion.guidance.limits.battery import BatteryMinimum
from companion.guidance.limits.envelope import Limits
from companion.guidance.limits.obstacles import ObstacleRules
from companion.guidance.missions.mission_file import MissionError
from companion.guidance.missions.sequence import SequenceBehaviour
from companion.guidance.mode_control import Phase
from companion.guidance.objects.from_markers import NO_MARKERS, MarkerSight
from companion.guidance.objects.ranging import RangeMeans
from companion.vehicle.state import FlightMode, LandedState, with_fields
from tests.companion.guidance.guidance_harness import (
    GuidanceHarness,
    Pending,
    ScriptedGimbal,
    assert_failed,
    mission,
    parked,
    standing,
)
from vision.obstacle_sectors import SECTORS, ObstacleSectors

CLASSES = ("person", "car")
LEADER = Neighbour("alpha", (5.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0, 0.0, age_s=0.1)
MARKERS = MarkerSight((), 1, 0.1, fresh=True, missing="")
OPTIONS = GuidanceOptions(
    battery=BatteryMinimum(0.2),
    obstacles=ObstacleRules("required"),
    gimbal=GimbalMounting(carries_camera=True, carries_steering=True),
)
# One of each command that flies by setpoints, and with each of its needs. `policy` needs a file.
STEPS = [
    "hold 5",
    "goto 6 0",
    "orbit radius=5 laps=1",
    "orbit car laps=1",
    "follow-path points=0,0;5,5",
    "figure-eight laps=1",
    "velocity",
    "seek car",
    "seek car sweep=-60",
    "seek car pattern=square radius=10",
    "approach car",
    "approach marker=7",
    "approach car gimbal=track",
    "follow car",
    "follow marker=7",
    "follow car gimbal=track",
    "patrol points=0,0;5,5 classes=car laps=1",
    "patrol points=0,0;5,5 classes=car laps=1 on_detection=approach",
    "formation line alpha",
    "land-on-marker 3",
]
NOT_FLOWN = {"takeoff", "land", "rtl", "stop", "mission", "select", "gimbal", "policy"}


@dataclass
class World:
    """Everything that a behaviour may need; a fault takes one part away."""

    harness: GuidanceHarness
    changes: dict[str, Any]
    home: bool = True

    def inputs(self, inputs: GuidanceInput) -> GuidanceInput:
        now_ns = inputs.state.heartbeat_ns
        if not self.home:
            inputs = replace(inputs, state=with_fields(inputs.state, home_altitude_amsl_m=None))
        parts: dict[str, Any] = {
            "neighbourhood": Neighbourhood("own", (LEADER,)),
            "markers": MARKERS,
            "steering_markers": MARKERS,
            "obstacles": ObstacleSectors(now_ns, (math.inf,) * SECTORS),
        }
        return replace(inputs, **parts | self.changes)


def world(options: GuidanceOptions = OPTIONS) -> World:
    harness = GuidanceHarness(
        parked(), class_names=CLASSES, options=options, inputs=lambda inputs: made.inputs(inputs)
    )
    harness.autopilot.gimbal = ScriptedGimbal()
    made = World(harness, {})
    harness.run(0.1)
    return made


def _without_position(made: World) -> None:
    made.harness.autopilot.position_alive = False


def _without_home(made: World) -> None:
    made.home = False


def _without_frames(made: World) -> None:
    made.harness.perception_age_s = None


def _without_gimbal(made: World) -> None:
    made.harness.autopilot.gimbal = None


def _change(name: str, value: object) -> Callable[[World], None]:
    return lambda made: made.changes.update({name: value})


FAULTS: dict[str, Callable[[World], None]] = {
    Requirement.POSITION: _without_position,
    Requirement.PERCEPTION: _without_frames,
    Requirement.BATTERY: lambda made: setattr(made.harness.autopilot, "battery_fraction", 0.1),
    Requirement.DEPTH_OR_SIZE: _change("ranging", RangeMeans(depth=False, ground=False)),
    Requirement.MARKER: _change("markers", NO_MARKERS),
    Requirement.STEERING_MARKER: _change("steering_markers", NO_MARKERS),
    Requirement.GIMBAL: _without_gimbal,
    Requirement.NEIGHBOURS: _change("neighbourhood", Neighbourhood("own")),
    Requirement.HOME: _without_home,
    "charge": lambda made: setattr(made.harness.autopilot, "battery_fraction", None),
    "depth": _change("obstacles", None),
}
# What every flight needs.
OF_ALL = {"charge", "depth", Requirement.BATTERY, Requirement.POSITION, Requirement.HOME}


def planned(harness: GuidanceHarness, *steps: str, on_failure: str = "rtl") -> SequenceBehaviour:
    return mission(harness, *steps, each={"timeout_s": 60, "on_failure": on_failure})


def started(made: World, *steps: str, on_failure: str = "rtl") -> Pending:
    harness = made.harness
    pending = harness.command(planned(harness, *steps, on_failure=on_failure))
    ends_ns = harness.now_ns + 6_000_000_000  # longer than a command waits for a gimbal
    while harness.now_ns < ends_ns and not pending.done():
        harness.run(0.1)
    harness.run(0.5)  # what is refused requests nothing later either
    return pending


def test_every_command_is_in_the_table() -> None:
    assert {step.split()[0] for step in STEPS} | NOT_FLOWN == set(COMMANDS)
    assert set(FAULTS) | OF_THE_MOMENT == {*Requirement, "charge", "depth"}


@pytest.mark.parametrize("step", STEPS)
def test_mission_with_all_it_needs_arms(step: str) -> None:
    made = world()
    assert not started(made, "takeoff 4", step).done()
    assert "arm" in made.harness.autopilot.requests


def own_needs(step: str) -> set[str]:
    return set(parse(step).build(NO_CONTEXT).requirements - OF_THE_MOMENT)


@pytest.mark.parametrize(
    ("step", "missing", "on_failure"),
    [
        (step, missing, on_failure)
        for step in STEPS
        for missing in sorted(own_needs(step) | OF_ALL)
        for on_failure in (("rtl", "continue", "abort") if missing in own_needs(step) else ("rtl",))
    ],
)
def test_missing_part_refuses_a_mission_disarmed(step: str, missing: str, on_failure: str) -> None:
    made = world()
    FAULTS[missing](made)
    made.harness.run(1.0)  # the last position is too old by then
    assert not started(made, "takeoff 4", step, on_failure=on_failure).result().success
    assert made.harness.autopilot.requests == []
    assert not made.harness.vehicle.armed


@pytest.mark.parametrize(
    ("step", "word"),
    [
        ("seek zebra", "zebra"),
        ("approach zebra", "zebra"),
        ("patrol points=0,0;5,5 classes=zebra laps=1", "zebra"),
        ("goto 300 0", "limits"),
        ("goto 5 0 altitude=70", "limits"),
        ("follow-path points=0,0;0,400", "limits"),
        ("patrol points=0,0;400,5 classes=car laps=1", "limits"),
    ],
)
def test_unknown_class_or_far_goal_refuses_a_mission_disarmed(step: str, word: str) -> None:
    made = world()
    assert_failed(started(made, "takeoff 4", "hold 1", step).result(), word)
    assert made.harness.autopilot.requests == []


def test_goal_from_the_later_position_is_not_refused() -> None:
    made = world(replace(OPTIONS, limits=Limits(max_distance_m=20.0)))
    # 24 m ahead of where the mission begins, but 14 m from home where the step begins.
    made.harness.vehicle.position[0] = 0.0
    steps = ("takeoff 4", "goto -10 0", "goto forward=24 right=0")
    assert not started(made, *steps).done()
    assert "arm" in made.harness.autopilot.requests


def test_unknown_command_of_a_step_is_refused_when_read() -> None:
    with pytest.raises(MissionError, match="step 2"):
        mission(GuidanceHarness(parked()), "takeoff 4", "circle-of-a-plugin 5")


@pytest.mark.parametrize("missing", [Requirement.POSITION, Requirement.HOME, "depth"])
def test_takeoff_is_refused_before_it_arms(missing: str) -> None:
    made = world()
    FAULTS[missing](made)
    made.harness.run(1.0)
    assert_failed(made.harness.outcome(made.harness.command("takeoff 4"), 5.0), missing)
    assert made.harness.autopilot.requests == []


def test_takeoff_waits_for_the_first_report_of_home() -> None:
    made = world()
    _without_home(made)
    pending = made.harness.command("takeoff 4")
    made.harness.run(2.0)
    assert made.harness.autopilot.requests == []
    made.home = True
    assert made.harness.outcome(pending).success


def test_ardupilot_takes_off_without_a_known_home() -> None:
    made = world()
    state = made.harness.autopilot.state
    made.changes["state"] = replace(state, home_altitude_amsl_m=None, autopilot="ArduPilot")
    made.harness.run(0.1)
    made.harness.command("takeoff 4")
    assert "arm" in made.harness.autopilot.requests


# --- a failed take-off --------------------------------------------------------------------------------------


LOW_M = 1.5  # flown by setpoints from the ground


def refused_on_the_ground() -> GuidanceHarness:
    harness = standing()
    harness.autopilot.refuse_takeoff = "no home"
    return harness


def on_ground() -> GuidanceHarness:
    """A PX4 that reports to be on the ground forever."""

    def grounded(inputs: GuidanceInput) -> GuidanceInput:
        return replace(inputs, state=replace(inputs.state, landed=LandedState.ON_GROUND, autopilot="PX4"))

    return standing(inputs=grounded)


def assert_disarmed(harness: GuidanceHarness) -> None:
    harness.run(1.0)
    assert harness.autopilot.requests[-1] == "disarm"
    assert not harness.vehicle.armed
    assert harness.guidance.phase is Phase.IDLE
    assert harness.outputs[-1].setpoint is None


@pytest.mark.parametrize("on_failure", ["", "abort", "continue", "rtl", "land"])
def test_refused_takeoff_disarms_what_it_armed(on_failure: str) -> None:
    harness = refused_on_the_ground()
    steps = planned(harness, "takeoff 4", "hold 1", on_failure=on_failure) if on_failure else "takeoff 4"
    outcome = harness.outcome(harness.command(steps), 5.0)
    assert on_failure or outcome == Outcome(False, "no home")
    assert_disarmed(harness)
    assert harness.autopilot.requests == ["arm", "disarm"]


@pytest.mark.parametrize(
    ("heights_m", "on_failure"),
    [([4.0], ""), ([LOW_M], ""), ([LOW_M, 4.0], "abort"), ([LOW_M, 4.0], "continue")],
)
def test_takeoff_that_never_lifts_disarms(heights_m: list[float], on_failure: str) -> None:
    harness = on_ground()
    steps = [f"takeoff {height_m}" for height_m in heights_m]
    command = planned(harness, *steps, on_failure=on_failure) if on_failure else steps[0]
    assert harness.outcome(harness.command(command)).success is (on_failure == "continue")
    assert_disarmed(harness)


@pytest.mark.parametrize("word", ["ZeroDivisionError", "position"])
def test_failure_in_a_low_takeoff_on_the_ground_disarms(word: str, monkeypatch: pytest.MonkeyPatch) -> None:
    harness, behaviour = on_ground(), TakeoffBehaviour(LOW_M)
    pending = harness.command(behaviour)
    harness.until(lambda: harness.guidance.phase is Phase.OFFBOARD, 5.0)
    if word == "position":
        harness.autopilot.position_alive = False
    else:
        monkeypatch.setattr(behaviour, "update", lambda dt_s, context: 1 / 0)
    assert_failed(harness.outcome(pending), word)
    assert_disarmed(harness)


def test_stop_before_the_takeoff_disarms() -> None:
    harness = standing(lag_s=0.5)
    harness.command("takeoff 4")
    harness.until(lambda: harness.autopilot.state.armed, 2.0)
    harness.autopilot.cancel(2)
    harness.vehicle.mode = FlightMode.HOLD
    harness.command("stop")
    harness.run(3.0)
    assert harness.autopilot.requests[-1] == "disarm"


def armed_before(harness: GuidanceHarness) -> None:
    harness.autopilot.refuse_takeoff = "no home"
    harness.vehicle.armed = True
    harness.run(0.5)
    harness.command("takeoff 4")


def taken_over(harness: GuidanceHarness) -> None:
    """By a pilot, after arming."""
    harness.command("takeoff 4")
    harness.until(lambda: harness.vehicle.armed, 2.0)
    harness.autopilot.change_mode(FlightMode.POSITION)
    harness.vehicle.landed = LandedState.ON_GROUND


def in_the_climb(harness: GuidanceHarness) -> None:
    harness.command("takeoff 4")
    harness.until(lambda: harness.vehicle.landed is LandedState.TAKING_OFF)
    harness.command("stop")


@pytest.mark.parametrize("end", [armed_before, taken_over, in_the_climb])
def test_vehicle_of_others_or_in_the_air_stays_armed(end: Callable[[GuidanceHarness], None]) -> None:
    harness = standing(lag_s=0.2)
    end(harness)
    harness.run(3.0)
    assert not harness.results[1].success
    assert "disarm" not in harness.autopilot.requests
    assert harness.vehicle.armed


def test_new_takeoff_cancels_the_pending_disarming() -> None:
    harness = refused_on_the_ground()
    harness.outcome(harness.command("takeoff 4"), 5.0)
    request = harness.outputs[-1].requests[-1]
    harness.command("takeoff 4")
    assert request.identifier in harness.outputs[-1].cancelled
