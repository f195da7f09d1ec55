"""What cannot be done is refused and named, by us before the flight or by the autopilot in it."""

import pytest
from scripted_autopilot import Cockpit, engaged, flying, kinds, parked

from companion.geometry.fence import Fence
from companion.guidance.behaviour import Behaviour, ModeRequest, Outcome, Requirement
from companion.guidance.envelope import Envelope, Limits
from companion.guidance.figure_eight import FigureEightBehaviour
from companion.guidance.follow_path import FollowPathBehaviour
from companion.guidance.goto import GotoBehaviour
from companion.guidance.hold import HoldBehaviour
from companion.guidance.land import LandBehaviour
from companion.guidance.patrol import PatrolBehaviour
from companion.guidance.pilot_event import PilotEventKind
from companion.guidance.seek import SeekBehaviour
from companion.guidance.takeoff import TakeoffBehaviour
from companion.vehicle.state import FlightMode


async def test_a_refused_landing_holds_in_offboard():
    cockpit = Cockpit(flying())
    await engaged(cockpit)
    cockpit.autopilot.refuse[FlightMode.LAND] = "land refused: no position"
    outcome = await cockpit.outcome(cockpit.pilot.command(LandBehaviour()), 5.0)
    assert outcome == Outcome(False, "land refused: no position")
    await cockpit.turn(1.0)
    assert cockpit.pilot.phase == "offboard"
    assert not cockpit.streamer.last_sent.expired(cockpit.vehicle.now_ns)


async def test_a_refused_offboard_ends_the_command_and_sends_nothing_more():
    cockpit = Cockpit(flying())
    cockpit.autopilot.refuse[FlightMode.OFFBOARD] = "offboard refused"
    await cockpit.turn(0.1)
    outcome = await cockpit.outcome(cockpit.pilot.command(HoldBehaviour()), 5.0)
    assert outcome == Outcome(False, "offboard refused")
    sent = len(cockpit.autopilot.setpoints)
    await cockpit.turn(1.0)
    assert len(cockpit.autopilot.setpoints) == sent


@pytest.mark.parametrize(
    ("vehicle", "behaviour", "words"),
    [
        (parked, HoldBehaviour, ["hold needs", "in the air", "disarmed, on ground"]),
        (flying, TakeoffBehaviour, ["takeoff needs", "on the ground", "armed, in air"]),
        (flying, lambda: SeekBehaviour("zebra"), ["seek needs", "zebra"]),
    ],
)
async def test_a_refusal_names_what_is_missing(vehicle, behaviour, words):
    cockpit = Cockpit(vehicle(), class_names=("car", "person"))
    await cockpit.turn(0.1)
    future = cockpit.pilot.command(behaviour())
    assert future.done()
    for word in words:
        assert word in future.result().reason
    assert kinds(cockpit) == [PilotEventKind.REFUSED]
    assert not cockpit.pilot.in_command


@pytest.mark.parametrize("age_s", [None, 2.0])
async def test_without_perception_seek_is_refused_with_its_age(age_s):
    cockpit = Cockpit(flying())
    cockpit.perception_age_s = age_s
    await cockpit.turn(0.1)
    reason = cockpit.pilot.command(SeekBehaviour("car")).result().reason
    assert "perception" in reason
    assert ("2.0 s old" if age_s else "nothing came") in reason


async def test_a_detector_that_is_late_for_a_moment_does_not_refuse_seek_but_does_not_steer_it_either():
    cockpit = Cockpit(flying())
    cockpit.perception_age_s = 0.8
    await cockpit.turn(0.1)
    future = cockpit.pilot.command(SeekBehaviour("car"))
    await cockpit.turn(0.5)
    assert not future.done()
    assert cockpit.pilot.phase == "offboard"
    assert cockpit.pilot.asked.yaw_rate_radps in (None, 0.0)


@pytest.mark.parametrize(
    ("behaviour", "where"),
    [
        (GotoBehaviour(from_home_m=(30.0, 5000.0)), "30.0 m north and 5000.0 m east of home is farther than"),
        (FollowPathBehaviour([(0.0, 0.0), (0.0, -7000.0)], 3.0), "0.0 m north and -7000.0 m east of home"),
        (PatrolBehaviour([(0.0, 0.0), (9000.0, 0.0)], ("car",)), "9000.0 m north"),
        (FigureEightBehaviour(6000.0, 3.0, 1.0), "is farther than guidance.max_distance_m"),
    ],
)
async def test_a_goal_beyond_the_limits_is_refused_and_named_before_anything_is_flown(behaviour, where):
    cockpit = Cockpit(flying())
    await cockpit.turn(0.1)
    outcome = cockpit.pilot.command(behaviour).result()
    assert not outcome.success
    assert outcome.reason.startswith(f"{behaviour.name} would leave the limits: ")
    assert where in outcome.reason
    assert not cockpit.autopilot.setpoints


async def test_a_goal_outside_the_fence_is_refused_and_one_inside_is_not():
    cockpit = Cockpit(flying())
    cockpit.pilot._envelope = Envelope(
        Limits(fence=Fence(((-20.0, -20.0), (20.0, -20.0), (20.0, 20.0), (-20.0, 20.0))))
    )
    await cockpit.turn(0.1)
    outcome = cockpit.pilot.command(GotoBehaviour(from_home_m=(30.0, 0.0))).result()
    assert outcome.reason == (
        "goto would leave the limits: 30.0 m north and 0.0 m east of home is not inside the fence "
        "(guidance.fence_include, fence_exclude)"
    )
    assert not cockpit.pilot.command(GotoBehaviour(from_home_m=(10.0, 0.0))).done()


async def test_a_refusal_leaves_the_current_behaviour_flying():
    cockpit = Cockpit(flying())
    future = await engaged(cockpit)
    assert cockpit.pilot.command(TakeoffBehaviour()).done()
    await cockpit.turn(0.2)
    assert not future.done()
    assert cockpit.pilot.phase == "offboard"


async def test_before_the_first_update_every_command_is_refused():
    cockpit = Cockpit(flying())
    assert "not known" in cockpit.pilot.command(HoldBehaviour()).result().reason


class Daring(Behaviour):
    name = "daring"
    requirements = frozenset({Requirement.ON_GROUND})

    def update(self, dt_s, situation):
        return ModeRequest(FlightMode.LAND, arm=True)


async def test_only_a_takeoff_arms():
    cockpit = Cockpit(parked())
    await cockpit.turn(0.1)
    cockpit.pilot.command(Daring())
    await cockpit.turn(1.0)
    assert "arm" not in cockpit.autopilot.requests
