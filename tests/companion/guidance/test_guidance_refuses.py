"""Refused commands: by guidance before a behaviour begins, or by the autopilot."""

from collections.abc import Callable

import pytest

from companion.geometry.fence import Fence
from companion.guidance.behaviour import Behaviour, BehaviourContext, ModeRequest, Outcome, Requirement
from companion.guidance.behaviours.figure_eight import FigureEightBehaviour
from companion.guidance.behaviours.follow_path import FollowPathBehaviour
from companion.guidance.behaviours.goto import Goto, GotoBehaviour
from companion.guidance.behaviours.hold import HoldBehaviour
from companion.guidance.behaviours.land import LandBehaviour
from companion.guidance.behaviours.patrol import Patrol, PatrolBehaviour
from companion.guidance.behaviours.seek import SearchBehaviour, Seek, SeekBehaviour
from companion.guidance.behaviours.takeoff import TakeoffBehaviour
from companion.guidance.core import GuidanceOptions
from companion.guidance.interface import EventKind
from companion.guidance.limits.envelope import Limits
from companion.vehicle.state import FlightMode
from tests.companion.guidance.guidance_harness import (
    GuidanceHarness,
    assert_failed,
    engaged,
    flying,
    kinds,
    parked,
)
from tests.companion.guidance.kinematic_vehicle import KinematicVehicle


def test_refused_landing_holds_in_offboard() -> None:
    harness = GuidanceHarness(flying())
    engaged(harness)
    harness.autopilot.refuse[FlightMode.LAND] = "land refused"
    outcome = harness.outcome(harness.command(LandBehaviour()), 5.0)
    assert outcome == Outcome(False, "land refused")
    harness.run(1.0)
    assert harness.guidance.phase == "offboard"
    assert harness.streamer.last_sent is not None
    assert not harness.streamer.last_sent.expired(harness.vehicle.now_ns)


def test_refused_offboard_ends_command_and_stream() -> None:
    harness = GuidanceHarness(flying())
    harness.autopilot.refuse[FlightMode.OFFBOARD] = "offboard refused"
    harness.run(0.1)
    outcome = harness.outcome(harness.command(HoldBehaviour()), 5.0)
    assert outcome == Outcome(False, "offboard refused")
    sent = len(harness.autopilot.setpoints)
    harness.run(1.0)
    assert len(harness.autopilot.setpoints) == sent


@pytest.mark.realtime
@pytest.mark.parametrize(
    ("vehicle", "behaviour", "words"),
    [
        (parked, HoldBehaviour, ["hold needs", "in the air", "disarmed, on ground"]),
        (flying, TakeoffBehaviour, ["takeoff needs", "on the ground", "armed, in air"]),
        (flying, lambda: SeekBehaviour(Seek("zebra")), ["seek needs", "zebra"]),
    ],
)
def test_refused_command_names_what_is_missing(
    vehicle: Callable[[], KinematicVehicle], behaviour: Callable[[], Behaviour], words: list[str]
) -> None:
    harness = GuidanceHarness(vehicle(), class_names=("car", "person"))
    harness.run(0.1)
    future = harness.command(behaviour())
    assert future.done()
    for word in words:
        assert word in future.result().reason
    assert kinds(harness) == [EventKind.REFUSED]
    assert not harness.guidance.in_command


@pytest.mark.parametrize("age_s", [None, 2.0])
def test_seek_is_refused_without_fresh_perception(age_s: float | None) -> None:
    harness = GuidanceHarness(flying())
    harness.perception_age_s = age_s
    harness.run(0.1)
    reason = harness.outcome(harness.command(SeekBehaviour(Seek("car"))), 5.0).reason
    assert "perception" in reason
    assert ("2.0 s old" if age_s else "no detections") in reason


def test_seek_waits_for_the_first_detections() -> None:
    harness = GuidanceHarness(flying())
    harness.perception_age_s = None
    harness.run(0.1)
    future = harness.command(SeekBehaviour(Seek("car")))
    harness.run(3.0)
    assert not future.done()
    assert not harness.guidance.in_command
    harness.perception_age_s = 0.1
    harness.run(0.5)
    assert harness.guidance.phase == "offboard"


def test_late_detector_allows_seek_but_does_not_steer_it() -> None:
    harness = GuidanceHarness(flying())
    harness.perception_age_s = 0.8
    harness.run(0.1)
    future = harness.command(SeekBehaviour(Seek("car")))
    harness.run(0.5)
    assert not future.done()
    assert harness.guidance.phase == "offboard"
    assert harness.guidance.setpoints.asked is not None
    assert harness.guidance.setpoints.asked.yaw_rate_radps in (None, 0.0)


@pytest.mark.parametrize(
    ("behaviour", "where"),
    [
        (GotoBehaviour(Goto(north_m=30.0, east_m=5000.0)), "5000.0 m east"),
        (FollowPathBehaviour([(0.0, 0.0), (0.0, -7000.0)], 3.0), "-7000.0 m east"),
        (PatrolBehaviour(Patrol("0,0 4000,0", "car")), "4000.0 m north"),
        (FigureEightBehaviour(6000.0, 3.0, 1.0), "guidance.max_distance_m"),
        (
            SearchBehaviour(Seek("car", pattern="lawnmower", width_m=900.0, height_m=20.0, spacing_m=9.0)),
            "guidance.max_distance_m",
        ),
        (GotoBehaviour(Goto(north_m=0.0, east_m=0.0, altitude_m=90.0)), "guidance.max_altitude_m = 50"),
        (FollowPathBehaviour([(0.0, 0.0), (5.0, 0.0, 0.2)], 3.0), "guidance.min_altitude_m = 1"),
        (FollowPathBehaviour([(0.0, 0.0), (5.0, 0.0, 60.0)], 3.0), "60.0 m above"),
    ],
)
def test_goal_beyond_the_limits_is_refused_before_flight(behaviour: Behaviour, where: str) -> None:
    harness = GuidanceHarness(flying())
    harness.run(0.1)
    outcome = assert_failed(harness.command(behaviour).result())
    assert outcome.reason.startswith(f"{behaviour.name} would leave ")
    assert "limits: " in outcome.reason
    assert where in outcome.reason
    assert not harness.autopilot.setpoints


def test_takeoff_beyond_max_altitude_is_refused_disarmed() -> None:
    harness = GuidanceHarness(parked())
    harness.run(0.1)
    outcome = harness.command(TakeoffBehaviour(60.0)).result()
    assert "guidance.max_altitude_m = 50" in outcome.reason
    assert not harness.autopilot.requests


def test_level_flight_above_max_altitude_is_allowed() -> None:
    vehicle = flying()
    vehicle.position[2] = -60.0
    harness = GuidanceHarness(vehicle)
    harness.run(0.1)
    assert not harness.command(GotoBehaviour(Goto(north_m=5.0, east_m=0.0))).done()


def test_goal_outside_the_fence_is_refused() -> None:
    fence = Fence(((-20.0, -20.0), (20.0, -20.0), (20.0, 20.0), (-20.0, 20.0)))
    harness = GuidanceHarness(flying(), options=GuidanceOptions(Limits(fence=fence)))
    harness.run(0.1)
    outcome = harness.command(GotoBehaviour(Goto(north_m=30.0, east_m=0.0))).result()
    assert "30.0 m north" in outcome.reason
    assert "fence_include" in outcome.reason
    assert not harness.command(GotoBehaviour(Goto(north_m=10.0, east_m=0.0))).done()


def test_refused_command_keeps_the_current_behaviour() -> None:
    harness = GuidanceHarness(flying())
    future = engaged(harness)
    assert harness.command(TakeoffBehaviour()).done()
    harness.run(0.2)
    assert not future.done()
    assert harness.guidance.phase == "offboard"


class Daring(Behaviour):
    name = "daring"
    requirements = frozenset({Requirement.ON_GROUND})

    def update(self, dt_s: float, context: BehaviourContext) -> ModeRequest:
        return ModeRequest(FlightMode.LAND, arm=True)


def test_only_a_takeoff_arms() -> None:
    harness = GuidanceHarness(parked())
    harness.run(0.1)
    harness.command(Daring())
    harness.run(1.0)
    assert "arm" not in harness.autopilot.requests
