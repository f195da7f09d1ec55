import pytest
from kinematic_vehicle import KinematicVehicle
from scripted_autopilot import Cockpit

from companion.guidance.battery import BATTERY_MAX_AGE_S, BatteryMinimum
from companion.guidance.hold import HoldBehaviour
from companion.guidance.land import LandBehaviour, ReturnBehaviour
from companion.guidance.orbit import OrbitBehaviour
from companion.guidance.pilot_event import PilotEventKind
from companion.guidance.stop import StopBehaviour
from companion.guidance.takeoff import TakeoffBehaviour
from companion.vehicle.state import FlightMode, LandedState, VehicleState
from companion.vehicle.telemetry_fold import fold

MINIMUM = BatteryMinimum(0.15)


def flying(battery=MINIMUM):
    return Cockpit(KinematicVehicle(mode=FlightMode.HOLD), battery=battery)


async def orbiting(cockpit):
    await cockpit.turn(0.1)
    future = cockpit.pilot.command(OrbitBehaviour())
    await cockpit.until(lambda: cockpit.pilot.phase == "offboard", 5.0)
    await cockpit.turn(1.0)
    return future


def told(cockpit):
    return [event.message for event in cockpit.events if event.kind is PilotEventKind.BATTERY]


@pytest.mark.parametrize("behaviour", [HoldBehaviour, OrbitBehaviour, TakeoffBehaviour])
async def test_nothing_begins_to_fly_below_the_least_charge_and_the_refusal_names_it(behaviour):
    cockpit = flying()
    if behaviour is TakeoffBehaviour:
        cockpit.vehicle.landed = LandedState.ON_GROUND
    cockpit.autopilot.battery_fraction = 0.14
    await cockpit.turn(0.1)
    reason = (
        cockpit.pilot.command(behaviour(2.5) if behaviour is TakeoffBehaviour else behaviour())
        .result()
        .reason
    )
    assert "needs a battery above 15% (it has 14%; guidance.min_battery_percent)" in reason
    assert not cockpit.pilot.in_command


@pytest.mark.parametrize("behaviour", [LandBehaviour, ReturnBehaviour, StopBehaviour])
async def test_the_ways_down_and_handing_back_need_no_charge(behaviour):
    cockpit = flying()
    cockpit.autopilot.battery_fraction = 0.01
    await cockpit.turn(0.1)
    assert not cockpit.pilot.command(behaviour()).done()


async def test_a_charge_that_is_not_told_is_a_refusal_that_says_so():
    cockpit = flying()
    cockpit.autopilot.battery_fraction = None
    await cockpit.turn(0.1)
    reason = cockpit.pilot.command(HoldBehaviour()).result().reason
    assert "the autopilot does not tell its charge" in reason


async def test_a_charge_that_is_old_is_a_refusal_that_says_how_old():
    cockpit = flying()
    cockpit.autopilot.battery_alive = False
    await cockpit.turn(BATTERY_MAX_AGE_S + 1.0)
    reason = cockpit.pilot.command(HoldBehaviour()).result().reason
    assert "last told 7 s ago" in reason


async def test_zero_turns_it_off():
    cockpit = flying(BatteryMinimum(0.0))
    cockpit.autopilot.battery_fraction = None
    await cockpit.turn(0.1)
    assert not cockpit.pilot.command(HoldBehaviour()).done()


@pytest.mark.parametrize(("action", "mode"), [("rtl", FlightMode.RETURN), ("land", FlightMode.LAND)])
async def test_a_flight_below_it_brakes_and_goes_the_way_the_operator_chose(action, mode):
    cockpit = flying(BatteryMinimum(0.15, action))
    future = await orbiting(cockpit)
    cockpit.autopilot.battery_fraction = 0.14
    before = len(cockpit.autopilot.setpoints)
    await cockpit.until(future.done, 3.0)
    assert not future.result().success
    assert future.result().reason == "the battery has 14%, below the 15% of guidance.min_battery_percent"
    await cockpit.until(lambda: cockpit.autopilot.state.mode is mode, 3.0)
    last = cockpit.autopilot.setpoints[before:][-1]
    assert last.velocity_ned_mps == (0.0, 0.0, 0.0)
    await cockpit.until(lambda: not cockpit.pilot.in_command, 60.0)
    assert not cockpit.autopilot.state.armed
    await cockpit.turn()  # so that its end is told
    assert [line.split(":")[0] for line in told(cockpit)] == [
        "the battery has 14%, below the 15% of guidance.min_battery_percent",
        f"{action} after low battery",
    ]


async def test_hold_after_low_battery_stays_under_our_command():
    cockpit = flying(BatteryMinimum(0.15, "hold"))
    future = await orbiting(cockpit)
    cockpit.autopilot.battery_fraction = 0.14
    await cockpit.until(future.done, 3.0)
    await cockpit.turn(5.0)
    assert cockpit.pilot.phase == "offboard"
    assert isinstance(cockpit.pilot.behaviour, HoldBehaviour)
    assert len(told(cockpit)) == 1


async def test_the_hold_that_goes_on_after_a_command_is_ended_too():
    cockpit = flying()
    await cockpit.turn(0.1)
    future = cockpit.pilot.command(HoldBehaviour(0.5))
    await cockpit.until(future.done, 5.0)
    cockpit.autopilot.battery_fraction = 0.1
    await cockpit.until(lambda: cockpit.autopilot.state.mode is FlightMode.RETURN, 5.0)


async def test_a_dip_of_the_charge_ends_nothing():
    cockpit = flying()
    future = await orbiting(cockpit)
    for _ in range(3):
        cockpit.autopilot.battery_fraction = 0.1
        await cockpit.turn(0.6)
        cockpit.autopilot.battery_fraction = 0.2
        await cockpit.turn(0.2)
    assert not future.done()


async def test_a_charge_that_comes_no_more_in_flight_is_said_once_and_the_flight_goes_on():
    cockpit = flying()
    future = await orbiting(cockpit)
    cockpit.autopilot.battery_alive = False
    await cockpit.turn(15.0)
    assert not future.done()
    assert len(told(cockpit)) == 1
    assert "flying on" in told(cockpit)[0]


async def test_a_low_battery_while_offboard_is_still_asked_for_ends_in_the_return_as_well():
    cockpit = flying()
    cockpit.autopilot.lag_s = 1.5
    await cockpit.turn(0.1)
    future = cockpit.pilot.command(OrbitBehaviour())
    await cockpit.turn(0.06)
    cockpit.autopilot.battery_fraction = 0.1
    await cockpit.until(future.done, 4.0)
    await cockpit.until(lambda: cockpit.autopilot.state.mode is FlightMode.RETURN, 5.0)


def test_both_battery_messages_carry_their_stamp():
    state = fold(VehicleState(), "BATTERY_STATUS", {"id": 0, "battery_remaining": 40}, 5)
    assert (state.battery_fraction, state.battery_ns) == (0.4, 5)
    fields = {"onboard_control_sensors_health": 0, "battery_remaining": 39}
    state = fold(state, "SYS_STATUS", fields, 9)
    assert (state.battery_fraction, state.battery_ns) == (0.39, 9)
    unknown = fold(state, "BATTERY_STATUS", {"id": 0, "battery_remaining": -1}, 20)
    assert unknown.battery_ns == 9


@pytest.mark.parametrize(("fraction", "action"), [(1.5, "rtl"), (-0.1, "rtl"), (0.2, "dive")])
def test_a_minimum_that_is_none_is_refused(fraction, action):
    with pytest.raises(ValueError, match="must be"):
        BatteryMinimum(fraction, action)
