"""The pilot runs one behaviour at a time: how it engages, goes from one to the next, and ends."""

import asyncio
import math

import pytest
from scripted_autopilot import Cockpit, engaged, flying, kinds, parked

from companion.guidance.behaviour import Behaviour, Outcome
from companion.guidance.hold import HoldBehaviour
from companion.guidance.land import LandBehaviour, ReturnBehaviour
from companion.guidance.orbit import OrbitBehaviour
from companion.guidance.pilot_event import PilotEventKind
from companion.guidance.stop import StopBehaviour
from companion.guidance.takeoff import TakeoffBehaviour
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import FlightMode


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
    assert math.dist(cockpit.vehicle.position, (0, 0, -5)) < 0.05
    assert "arm" not in cockpit.autopilot.requests


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


async def test_nothing_is_asked_for_without_a_command():
    cockpit = Cockpit(parked())
    await cockpit.turn(5.0)
    assert cockpit.autopilot.requests == []
    assert cockpit.autopilot.setpoints == []


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
