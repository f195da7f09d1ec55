"""What ends our command of the vehicle: a pilot, the autopilot, a lost link, a loop that hung."""

import pytest
from scripted_autopilot import Cockpit, engaged, flying, kinds, parked

from companion.guidance.behaviour import Outcome
from companion.guidance.hold import HoldBehaviour
from companion.guidance.land import LandBehaviour
from companion.guidance.orbit import OrbitBehaviour
from companion.guidance.pilot_event import PilotEventKind
from companion.guidance.takeoff import TakeoffBehaviour
from companion.vehicle.state import FlightMode

OTHER_MODES = [
    FlightMode.POSITION,
    FlightMode.ALTITUDE,
    FlightMode.HOLD,
    FlightMode.LAND,
    FlightMode.RETURN,
    FlightMode.MISSION,
]


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
    assert cockpit.streamer.last_sent.yaw_rad is not None  # a hold's; a brake has a yaw rate
    cockpit.autopilot.change_mode(FlightMode.POSITION)
    await cockpit.turn(0.04)
    sent = len(cockpit.autopilot.setpoints)
    await cockpit.turn(1.0)
    assert len(cockpit.autopilot.setpoints) == sent
    assert cockpit.events[-1].kind is PilotEventKind.LOST


async def test_a_pilot_who_stops_a_takeoff_half_way_wins():
    cockpit = Cockpit(parked())
    await cockpit.turn(0.2)
    future = cockpit.pilot.command(TakeoffBehaviour(10.0))
    await cockpit.until(lambda: cockpit.vehicle.position[2] < -3.0)
    cockpit.autopilot.change_mode(FlightMode.HOLD)
    outcome = await cockpit.outcome(future, 2.0)
    assert outcome.reason == "the pilot took over: hold mode"
    assert cockpit.autopilot.setpoints == []


async def test_a_pilot_who_catches_a_landing_wins():
    cockpit = Cockpit(flying())
    await engaged(cockpit)
    future = cockpit.pilot.command(LandBehaviour())
    await cockpit.until(lambda: cockpit.vehicle.position[2] > -3.0)
    cockpit.autopilot.change_mode(FlightMode.POSITION)
    assert (await cockpit.outcome(future, 2.0)).reason == "the pilot took over: position mode"


async def test_a_streamer_that_does_not_run_is_noticed():
    cockpit = Cockpit(flying())
    cockpit.streaming = False
    await cockpit.turn(0.1)
    outcome = await cockpit.outcome(cockpit.pilot.command(HoldBehaviour()), 10.0)
    assert "no setpoint left" in outcome.reason


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
