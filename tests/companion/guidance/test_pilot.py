import asyncio
import math

import pytest
from kinematic_vehicle import KinematicVehicle
from scripted_autopilot import Cockpit

from companion.geometry.fence import Fence
from companion.guidance.behaviour import Behaviour, ModeRequest, Outcome, Requirement
from companion.guidance.envelope import Envelope, Limits
from companion.guidance.figure_eight import FigureEightBehaviour
from companion.guidance.follow_path import FollowPathBehaviour
from companion.guidance.goto import GotoBehaviour
from companion.guidance.hold import HoldBehaviour
from companion.guidance.land import LandBehaviour, ReturnBehaviour
from companion.guidance.orbit import OrbitBehaviour
from companion.guidance.patrol import PatrolBehaviour
from companion.guidance.pilot_event import PilotEventKind
from companion.guidance.seek import SeekBehaviour
from companion.guidance.stop import StopBehaviour
from companion.guidance.takeoff import TakeoffBehaviour
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import FlightMode, LandedState

OTHER_MODES = [
    FlightMode.POSITION,
    FlightMode.ALTITUDE,
    FlightMode.HOLD,
    FlightMode.LAND,
    FlightMode.RETURN,
    FlightMode.MISSION,
]


def flying(mode=FlightMode.HOLD):
    return KinematicVehicle(mode=mode)


def parked(mode=FlightMode.HOLD):
    return KinematicVehicle(position=[0.0, 0.0, 0.0], mode=mode, armed=False, landed=LandedState.ON_GROUND)


async def engaged(cockpit, behaviour=None):
    """Flying a behaviour in OFFBOARD."""
    await cockpit.turn(0.1)
    future = cockpit.pilot.command(behaviour or HoldBehaviour())
    await cockpit.until(lambda: cockpit.pilot.phase == "offboard", 5.0)
    await cockpit.turn(0.5)
    return future


def kinds(cockpit):
    return [event.kind for event in cockpit.events]


@pytest.mark.parametrize("lag_s", [0.0, 0.05, 1.0])
async def test_setpoints_leave_before_offboard_is_asked_for(lag_s):
    cockpit = Cockpit(flying(), lag_s)
    await cockpit.turn(0.1 + lag_s)
    cockpit.pilot.command(HoldBehaviour())
    await cockpit.until(lambda: "offboard" in cockpit.autopilot.requests, 5.0)
    assert len(cockpit.autopilot.setpoints) >= 2
    await cockpit.until(lambda: cockpit.pilot.phase == "offboard", 5.0)
    await cockpit.turn(3.0)
    assert kinds(cockpit) == [PilotEventKind.STARTED, PilotEventKind.ENGAGED]
    assert cockpit.autopilot.setpoints[-1].position_ned_m == pytest.approx((0, 0, -5), abs=0.05)
    assert "arm" not in cockpit.autopilot.requests


@pytest.mark.parametrize("lag_s", [0.0, 1.0])
@pytest.mark.parametrize("mode", OTHER_MODES)
async def test_a_mode_we_did_not_ask_for_ends_our_command_at_once_and_for_good(mode, lag_s):
    cockpit = Cockpit(flying(), lag_s)
    future = await engaged(cockpit, OrbitBehaviour())
    cockpit.autopilot.change_mode(mode)
    await cockpit.until(lambda: cockpit.autopilot.state.mode is mode, 2.0)
    sent = len(cockpit.autopilot.setpoints)
    outcome = future.result()
    assert outcome == Outcome(False, f"the pilot took over: {mode.value} mode")
    assert kinds(cockpit)[-1] is PilotEventKind.LOST
    await cockpit.turn(2.0)
    cockpit.autopilot.change_mode(FlightMode.OFFBOARD)  # PX4 does this when setpoints come back
    await cockpit.turn(3.0)
    assert len(cockpit.autopilot.setpoints) == sent
    assert not cockpit.pilot.in_command
    assert cockpit.pilot.sent is None
    # Only an operator's command resumes.
    cockpit.autopilot.change_mode(FlightMode.POSITION)
    await cockpit.turn(1.2)
    cockpit.pilot.command(HoldBehaviour())
    await cockpit.until(lambda: cockpit.pilot.phase == "offboard", 5.0)
    assert len(cockpit.autopilot.setpoints) > sent


async def test_a_pilot_who_takes_over_during_the_request_for_offboard_wins():
    cockpit = Cockpit(flying(), lag_s=1.0)
    await cockpit.turn(1.2)
    future = cockpit.pilot.command(HoldBehaviour())
    await cockpit.until(lambda: "offboard" in cockpit.autopilot.requests, 2.0)
    cockpit.autopilot.change_mode(FlightMode.POSITION)
    outcome = await cockpit.outcome(future, 5.0)
    assert outcome.reason == "the pilot took over: position mode"
    sent = len(cockpit.autopilot.setpoints)
    await cockpit.turn(3.0)
    assert len(cockpit.autopilot.setpoints) == sent


async def test_the_idle_hold_yields_to_the_pilot_as_well():
    cockpit = Cockpit(flying())
    future = await engaged(cockpit, HoldBehaviour(duration_s=1.0))
    assert (await cockpit.outcome(future)).success
    await cockpit.turn(1.0)
    assert cockpit.streamer.last_sent.position_ned_m is not None
    cockpit.autopilot.change_mode(FlightMode.POSITION)
    await cockpit.turn(0.04)
    sent = len(cockpit.autopilot.setpoints)
    await cockpit.turn(1.0)
    assert len(cockpit.autopilot.setpoints) == sent
    assert cockpit.events[-1].kind is PilotEventKind.LOST


async def test_after_a_behaviour_a_hold_goes_on_until_the_next_command():
    cockpit = Cockpit(flying())
    future = await engaged(cockpit, HoldBehaviour(duration_s=1.0))
    assert (await cockpit.outcome(future)).success
    sent = len(cockpit.autopilot.setpoints)
    await cockpit.turn(2.0)
    assert len(cockpit.autopilot.setpoints) >= sent + 99
    assert cockpit.pilot.behaviour.name == "hold"
    assert not cockpit.pilot.busy
    assert "no command" in cockpit.pilot.status


async def test_a_new_command_replaces_the_current_one_without_leaving_offboard():
    cockpit = Cockpit(flying())
    future = await engaged(cockpit, HoldBehaviour())
    second = cockpit.pilot.command(OrbitBehaviour(10.0, 2.0))
    assert future.result() == Outcome(False, "replaced by orbit")
    await cockpit.turn(3.0)
    assert cockpit.autopilot.requests.count("offboard") == 1
    assert not second.done()
    assert math.hypot(*cockpit.vehicle.velocity) > 1.0


@pytest.mark.parametrize("lag_s", [0.0, 1.0])
@pytest.mark.parametrize("mode", [FlightMode.HOLD, FlightMode.OFFBOARD])
async def test_takeoff_arms_climbs_and_leaves_the_holding_to_the_autopilot(mode, lag_s):
    cockpit = Cockpit(parked(mode), lag_s)
    await cockpit.turn(1.2)
    assert cockpit.autopilot.requests == []
    outcome = await cockpit.outcome(cockpit.pilot.command(TakeoffBehaviour(5.0)))
    assert outcome.success, outcome.reason
    assert cockpit.autopilot.requests[-2:] == ["arm", "takeoff 5"]
    await cockpit.turn(2.0)
    assert cockpit.autopilot.setpoints == []
    assert not cockpit.pilot.in_command


async def test_a_takeoff_that_px4_ends_short_is_climbed_to_its_end():
    cockpit = Cockpit(parked())
    cockpit.autopilot.takeoff_short_m = 0.6
    await cockpit.turn(0.2)
    outcome = await cockpit.outcome(cockpit.pilot.command(TakeoffBehaviour(2.5)))
    assert outcome.success, outcome.reason
    assert "offboard" in cockpit.autopilot.requests
    await cockpit.turn(5.0)
    assert cockpit.vehicle.position[2] == pytest.approx(-2.5, abs=0.45)
    assert cockpit.pilot.phase == "offboard"


async def test_a_pilot_who_stops_a_takeoff_half_way_wins():
    cockpit = Cockpit(parked())
    await cockpit.turn(0.2)
    future = cockpit.pilot.command(TakeoffBehaviour(10.0))
    await cockpit.until(lambda: cockpit.vehicle.position[2] < -3.0)
    cockpit.autopilot.change_mode(FlightMode.HOLD)
    outcome = await cockpit.outcome(future, 2.0)
    assert outcome.reason == "the pilot took over: hold mode"
    assert cockpit.autopilot.setpoints == []


@pytest.mark.parametrize("lag_s", [0.0, 1.0])
@pytest.mark.parametrize("behaviour", [LandBehaviour, ReturnBehaviour])
async def test_landing_from_offboard_ends_disarmed_with_nothing_sent_after_it(behaviour, lag_s):
    cockpit = Cockpit(flying(), lag_s)
    await engaged(cockpit)
    outcome = await cockpit.outcome(cockpit.pilot.command(behaviour()))
    assert outcome.success, outcome.reason
    assert "disarmed" in outcome.reason
    assert not cockpit.autopilot.state.armed
    sent = len(cockpit.autopilot.setpoints)
    await cockpit.turn(2.0)
    assert len(cockpit.autopilot.setpoints) == sent
    assert PilotEventKind.LOST not in kinds(cockpit)


async def test_a_pilot_who_catches_a_landing_wins():
    cockpit = Cockpit(flying())
    await engaged(cockpit)
    future = cockpit.pilot.command(LandBehaviour())
    await cockpit.until(lambda: cockpit.vehicle.position[2] > -3.0)
    cockpit.autopilot.change_mode(FlightMode.POSITION)
    assert (await cockpit.outcome(future, 2.0)).reason == "the pilot took over: position mode"


async def test_stop_gives_the_vehicle_to_the_autopilot_and_sends_nothing():
    cockpit = Cockpit(flying(), lag_s=0.5)
    future = await engaged(cockpit)
    outcome = await cockpit.outcome(cockpit.pilot.command(StopBehaviour()), 10.0)
    assert outcome.success
    assert future.result().reason == "replaced by stop"
    sent = len(cockpit.autopilot.setpoints)
    await cockpit.turn(2.0)
    assert len(cockpit.autopilot.setpoints) == sent
    assert not cockpit.pilot.in_command
    assert PilotEventKind.LOST not in kinds(cockpit)


async def test_while_a_mode_is_asked_for_out_of_offboard_a_brake_is_sent():
    cockpit = Cockpit(flying(), lag_s=0.8)
    await engaged(cockpit, OrbitBehaviour(10.0, 3.0))
    cockpit.pilot.command(LandBehaviour())
    await cockpit.turn(0.4)
    assert cockpit.autopilot.setpoints[-1].velocity_ned_mps == (0.0, 0.0, 0.0)
    assert not cockpit.autopilot.setpoints[-1].expired(cockpit.vehicle.now_ns)


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


async def test_a_streamer_that_does_not_run_is_noticed():
    cockpit = Cockpit(flying())
    cockpit.streaming = False
    await cockpit.turn(0.1)
    outcome = await cockpit.outcome(cockpit.pilot.command(HoldBehaviour()), 10.0)
    assert "no setpoint left" in outcome.reason


async def test_a_landing_replaced_before_it_shows_is_taken_back():
    cockpit = Cockpit(flying(), lag_s=1.0)
    await engaged(cockpit)
    cockpit.pilot.command(LandBehaviour())
    await cockpit.turn(0.3)
    future = cockpit.pilot.command(HoldBehaviour())
    await cockpit.until(lambda: cockpit.pilot.phase == "offboard", 5.0)
    await cockpit.turn(3.0)
    assert not future.done()
    assert cockpit.autopilot.state.mode is FlightMode.OFFBOARD
    assert PilotEventKind.LOST not in kinds(cockpit)


async def test_a_failsafe_of_the_autopilot_ends_our_command():
    cockpit = Cockpit(flying())
    future = await engaged(cockpit)
    cockpit.autopilot.failsafe = True
    cockpit.autopilot.change_mode(FlightMode.RETURN)
    await cockpit.turn(0.04)
    assert future.result() == Outcome(False, "autopilot failsafe: return mode")
    # An operator can take it back out of the failsafe.
    cockpit.pilot.command(HoldBehaviour())
    await cockpit.until(lambda: cockpit.pilot.phase == "offboard", 5.0)


async def test_a_loop_that_hung_gives_up_its_command_and_sends_not_one_setpoint_more():
    cockpit = Cockpit(flying())
    future = await engaged(cockpit)
    sent = len(cockpit.autopilot.setpoints)
    # The whole loop stands still; the vehicle flies on, and its failsafe is not known here yet.
    cockpit.autopilot.step(2.0)
    await cockpit.turn(1.0)
    assert future.result().reason == "our own guidance stood still for 2.0 s"
    assert len(cockpit.autopilot.setpoints) == sent
    cockpit.pilot.command(HoldBehaviour())
    await cockpit.until(lambda: cockpit.pilot.phase == "offboard", 5.0)


async def test_a_lost_link_ends_our_command_and_its_return_does_not_resume_it():
    cockpit = Cockpit(flying())
    future = await engaged(cockpit)
    cockpit.autopilot.linked = False
    cockpit.autopilot.position_alive = True
    outcome = await cockpit.outcome(future, 10.0)
    assert not outcome.success
    sent = len(cockpit.autopilot.setpoints)
    cockpit.autopilot.linked = True
    await cockpit.turn(3.0)
    assert len(cockpit.autopilot.setpoints) == sent


async def test_a_landing_whose_link_is_lost_says_so():
    cockpit = Cockpit(flying())
    await cockpit.turn(0.1)
    future = cockpit.pilot.command(LandBehaviour())
    await cockpit.turn(0.5)
    cockpit.autopilot.linked = False
    outcome = await cockpit.outcome(future, 10.0)
    assert "no heartbeat for 3" in outcome.reason


async def test_without_a_position_the_vehicle_brakes_and_then_command_is_given_up():
    cockpit = Cockpit(flying())
    future = await engaged(cockpit, OrbitBehaviour())
    cockpit.autopilot.position_alive = False
    await cockpit.turn(1.0)
    assert cockpit.autopilot.setpoints[-1].velocity_ned_mps == (0.0, 0.0, 0.0)
    outcome = await cockpit.outcome(future, 5.0)
    assert "position" in outcome.reason
    sent = len(cockpit.autopilot.setpoints)
    await cockpit.turn(1.0)
    assert len(cockpit.autopilot.setpoints) == sent


async def test_a_disarmed_vehicle_is_not_ours_any_more():
    cockpit = Cockpit(flying())
    future = await engaged(cockpit)
    cockpit.vehicle.armed = False
    await cockpit.turn(0.04)
    assert future.result() == Outcome(False, "the vehicle was disarmed")


class Broken(Behaviour):
    name = "broken"

    def __init__(self, after):
        self.updates_left = after
        self.deactivated = 0

    def update(self, dt_s, situation):
        self.updates_left -= 1
        if self.updates_left < 0:
            raise ZeroDivisionError("a bug")
        return Setpoint.velocity((1.0, 0.0, 0.0), situation.now_ns)

    def on_deactivate(self):
        self.deactivated += 1


@pytest.mark.parametrize("after", [0, 20])
async def test_an_exception_in_a_behaviour_is_logged_ends_it_and_holds(after, caplog):
    cockpit = Cockpit(flying())
    await engaged(cockpit)
    behaviour = Broken(after)
    outcome = await cockpit.outcome(cockpit.pilot.command(behaviour), 5.0)
    assert outcome == Outcome(False, "broken failed: ZeroDivisionError: a bug")
    assert "Traceback" in caplog.text
    assert behaviour.deactivated == 1
    await cockpit.turn(2.0)
    assert cockpit.pilot.phase == "offboard"
    assert math.hypot(*cockpit.vehicle.velocity) < 0.1


async def test_a_listener_that_fails_does_not_disturb_the_flight():
    cockpit = Cockpit(flying())

    def fail(event):
        raise ValueError("a listener's bug")

    cockpit.pilot._on_event = fail
    await engaged(cockpit)
    assert cockpit.pilot.phase == "offboard"


class Curious(Behaviour):
    name = "curious"
    requirements = frozenset()

    def __init__(self):
        self.seen = []

    def update(self, dt_s, situation):
        self.seen.append((dt_s, situation.sent))
        return Setpoint.velocity((9.0, 0.0, 0.0), situation.now_ns)


async def test_what_was_sent_is_told_to_the_behaviour_and_published_beside_what_was_asked():
    cockpit = Cockpit(flying())
    behaviour = Curious()
    await engaged(cockpit, behaviour)
    await cockpit.turn(5.0)
    assert cockpit.pilot.asked.velocity_ned_mps == (9.0, 0.0, 0.0)
    assert cockpit.pilot.sent.velocity_ned_mps == pytest.approx((5.0, 0.0, 0.0))
    assert cockpit.pilot.limited_by
    assert behaviour.seen[-1][0] == pytest.approx(0.02)
    assert behaviour.seen[-1][1].velocity_ned_mps == pytest.approx((5.0, 0.0, 0.0))


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


async def test_nothing_is_asked_for_without_a_command():
    cockpit = Cockpit(parked())
    await cockpit.turn(5.0)
    assert cockpit.autopilot.requests == []
    assert cockpit.autopilot.setpoints == []


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


async def test_a_caller_who_stops_waiting_does_not_stop_the_behaviour():
    cockpit = Cockpit(flying())
    future = await engaged(cockpit)
    future.cancel()
    await cockpit.turn(0.5)
    assert cockpit.pilot.behaviour.name == "hold"
    cockpit.pilot.command(StopBehaviour())
    await cockpit.turn(0.5)


async def test_closing_ends_the_behaviour_and_the_stream():
    cockpit = Cockpit(flying())
    future = await engaged(cockpit)
    cockpit.pilot.close()
    assert future.result() == Outcome(False, "the service ends")
    sent = len(cockpit.autopilot.setpoints)
    await cockpit.turn(0.5)
    assert len(cockpit.autopilot.setpoints) == sent
    assert asyncio.all_tasks() == {asyncio.current_task()}


async def test_a_stream_that_fell_silent_ends_the_command_with_its_reason():
    cockpit = Cockpit(flying())
    future = await engaged(cockpit)
    cockpit.streaming = False
    await cockpit.turn(1.5)
    cockpit.streaming = True
    await cockpit.turn(0.1)
    assert future.result() == Outcome(
        False, "no setpoint left for too long, the autopilot's failsafe has the vehicle"
    )
