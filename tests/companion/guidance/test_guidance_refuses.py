"""Refused commands: by guidance before a behaviour begins, or by the autopilot."""

import pytest

from companion.geometry.fence import Fence
from companion.guidance.behaviour import Behaviour, BehaviourContext, ModeRequest, Outcome, Requirement
from companion.guidance.behaviours.figure_eight import FigureEightBehaviour
from companion.guidance.behaviours.follow_path import FollowPathBehaviour
from companion.guidance.behaviours.takeoff import TakeoffBehaviour
from companion.guidance.core import GuidanceOptions
from companion.guidance.interface import EventKind
from companion.guidance.limits.envelope import Limits
from companion.vehicle.state import FlightMode
from tests.companion.guidance.guidance_harness import (
    GuidanceHarness,
    assert_failed,
    built,
    engaged,
    flying,
    hovering,
    kinds,
    known,
    parked,
    standing,
)


def test_refused_landing_holds_in_offboard() -> None:
    harness = GuidanceHarness(flying())
    engaged(harness)
    harness.autopilot.refuse[FlightMode.LAND] = "land refused"
    outcome = harness.outcome(harness.command("land"), 5.0)
    assert outcome == Outcome(False, "land refused")
    harness.run(1.0)
    assert harness.guidance.phase == "offboard"
    assert not known(harness.streamer.last_sent).expired(harness.vehicle.now_ns)


def test_refused_offboard_ends_command_and_stream() -> None:
    harness = GuidanceHarness(flying())
    harness.autopilot.refuse[FlightMode.OFFBOARD] = "offboard refused"
    harness.run(0.1)
    outcome = harness.outcome(harness.command("hold"), 5.0)
    assert outcome == Outcome(False, "offboard refused")
    assert harness.silent(1.0)


@pytest.mark.parametrize(
    ("on_ground", "command", "words"),
    [
        (True, "hold", ["hold needs", "in the air", "disarmed, on ground"]),
        (False, "takeoff", ["takeoff needs", "on the ground", "armed, in air"]),
        (False, "seek zebra", ["seek needs", "zebra"]),
    ],
)
def test_refused_command_names_what_is_missing(on_ground: bool, command: str, words: list[str]) -> None:
    harness = hovering(parked() if on_ground else flying(), class_names=("car", "person"))
    assert_failed(harness.command(command).result(), *words)
    assert kinds(harness) == [EventKind.REFUSED]
    assert not harness.guidance.in_command


@pytest.mark.parametrize(("age_s", "word"), [(None, "no detections"), (2.0, "2.0 s old")])
def test_seek_is_refused_without_fresh_perception(age_s: float | None, word: str) -> None:
    harness = hovering()
    harness.perception_age_s = age_s
    assert_failed(harness.outcome(harness.command("seek car"), 5.0), "perception", word)


def test_seek_waits_for_the_first_detections() -> None:
    harness = hovering()
    harness.perception_age_s = None
    future = harness.command("seek car")
    harness.run(3.0)
    assert not future.done()
    assert not harness.guidance.in_command
    harness.perception_age_s = 0.1
    harness.run(0.5)
    assert harness.guidance.phase == "offboard"


def test_late_detector_allows_seek_but_does_not_steer_it() -> None:
    harness = hovering()
    harness.perception_age_s = 0.8
    future = harness.command("seek car")
    harness.run(0.5)
    assert not future.done()
    assert harness.guidance.phase == "offboard"
    assert known(harness.guidance.setpoints.asked).yaw_rate_radps in (None, 0.0)


BOX = Fence(((-20.0, -20.0), (20.0, -20.0), (20.0, 20.0), (-20.0, 20.0)))


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ("goto 30 5000", ["5000.0 m east"]),
        (FollowPathBehaviour([(0.0, 0.0), (0.0, -7000.0)], 3.0), ["-7000.0 m east"]),
        ("patrol 0,0;4000,0 classes=car", ["4000.0 m north"]),
        (FigureEightBehaviour(6000.0, 3.0, 1.0), ["guidance.max_distance_m"]),
        ("orbit radius=30", ["m north", "fence_include"]),
        ("seek car pattern=lawnmower width=900 height=20 spacing=9", ["guidance.max_distance_m"]),
        ("goto 0 0 altitude=90", ["guidance.max_altitude_m = 50"]),
        (FollowPathBehaviour([(0.0, 0.0), (5.0, 0.0, 0.2)], 3.0), ["guidance.min_altitude_m = 1"]),
        ("follow-path 0,0;5,0,60", ["60.0 m above"]),
        ("goto 30 0", ["30.0 m north", "fence_include"]),
        (TakeoffBehaviour(60.0), ["guidance.max_altitude_m = 50"]),
    ],
)
def test_goal_beyond_the_limits_is_refused_before_flight(command: Behaviour | str, words: list[str]) -> None:
    behaviour = built(command)
    fenced = GuidanceOptions(Limits(fence=BOX)) if "fence_include" in words else None
    vehicle = parked() if behaviour.name == "takeoff" else flying()
    harness = hovering(vehicle, options=fenced)
    outcome = assert_failed(harness.command(behaviour).result(), "limits: ", *words)
    assert outcome.reason.startswith(f"{behaviour.name} would leave ")
    assert not harness.autopilot.setpoints
    assert not harness.autopilot.requests


@pytest.mark.parametrize(
    ("height_m", "limits", "command"),
    [(60.0, Limits(), "goto 5 0"), (5.0, Limits(fence=BOX), "goto 10 0")],
)
def test_goal_that_leaves_no_limit_is_flown(height_m: float, limits: Limits, command: str) -> None:
    """Level flight above the greatest altitude does not leave it."""
    vehicle = flying()
    vehicle.position[2] = -height_m
    harness = hovering(vehicle, options=GuidanceOptions(limits))
    assert not harness.command(command).done()


def test_refused_command_keeps_the_current_behaviour() -> None:
    harness = GuidanceHarness(flying())
    future = engaged(harness)
    assert harness.command("takeoff").done()
    harness.run(0.2)
    assert not future.done()
    assert harness.guidance.phase == "offboard"


class Daring(Behaviour):
    name = "daring"
    requirements = frozenset({Requirement.ON_GROUND})

    def update(self, dt_s: float, context: BehaviourContext) -> ModeRequest:
        return ModeRequest(FlightMode.LAND, arm=True)


def test_only_a_takeoff_arms() -> None:
    harness = standing()
    harness.command(Daring())
    harness.run(1.0)
    assert "arm" not in harness.autopilot.requests
