from collections.abc import Callable

import pytest

from companion.guidance.behaviour import Behaviour
from companion.guidance.behaviours.hold import HoldBehaviour
from companion.guidance.behaviours.land import LandBehaviour, ReturnBehaviour
from companion.guidance.behaviours.orbit import Orbit, OrbitBehaviour
from companion.guidance.behaviours.stop import StopBehaviour
from companion.guidance.command import NO_CONTEXT
from companion.guidance.core import GuidanceOptions
from companion.guidance.grammar import parse
from companion.guidance.interface import EventKind
from companion.guidance.limits.battery import BATTERY_MAX_AGE_S, BatteryAction, BatteryMinimum
from companion.vehicle.state import FlightMode, LandedState, VehicleState
from companion.vehicle.telemetry import apply_message
from tests.companion.guidance.guidance_harness import GuidanceHarness, Pending
from tests.companion.guidance.kinematic_vehicle import KinematicVehicle

MINIMUM = BatteryMinimum(0.15)


def flying(battery: BatteryMinimum = MINIMUM) -> GuidanceHarness:
    return GuidanceHarness(KinematicVehicle(mode=FlightMode.HOLD), options=GuidanceOptions(battery=battery))


def orbiting(harness: GuidanceHarness) -> Pending:
    harness.run(0.1)
    future = harness.command(OrbitBehaviour(Orbit()))
    harness.until(lambda: harness.guidance.phase == "offboard", 5.0)
    harness.run(1.0)
    return future


def battery_events(harness: GuidanceHarness) -> list[str]:
    return [event.message for event in harness.events if event.kind is EventKind.BATTERY]


@pytest.mark.parametrize("text", ["hold", "orbit", "takeoff"])
def test_low_battery_refuses_behaviours_that_fly(text: str) -> None:
    harness = flying()
    if text == "takeoff":
        harness.vehicle.landed = LandedState.ON_GROUND
    harness.autopilot.battery_fraction = 0.14
    harness.run(0.1)
    reason = harness.command(parse(text).build(NO_CONTEXT)).result().reason
    assert "14%; guidance.min_battery_percent" in reason
    assert not harness.guidance.in_command


@pytest.mark.parametrize("behaviour", [LandBehaviour, ReturnBehaviour, StopBehaviour])
def test_landing_and_stop_need_no_charge(behaviour: Callable[[], Behaviour]) -> None:
    harness = flying()
    harness.autopilot.battery_fraction = 0.01
    harness.run(0.1)
    assert not harness.command(behaviour()).done()


def test_missing_battery_state_is_refused() -> None:
    harness = flying()
    harness.autopilot.battery_fraction = None
    harness.run(0.1)
    reason = harness.command(HoldBehaviour()).result().reason
    assert "not received" in reason


def test_stale_battery_state_is_refused_with_its_age() -> None:
    harness = flying()
    harness.autopilot.battery_alive = False
    harness.run(BATTERY_MAX_AGE_S + 1.0)
    reason = harness.command(HoldBehaviour()).result().reason
    assert "stale (7 s)" in reason


def test_minimum_of_zero_disables_the_check() -> None:
    harness = flying(BatteryMinimum(0.0))
    harness.autopilot.battery_fraction = None
    harness.run(0.1)
    assert not harness.command(HoldBehaviour()).done()


@pytest.mark.parametrize(("action", "mode"), [("rtl", FlightMode.RETURN), ("land", FlightMode.LAND)])
def test_low_battery_in_flight_brakes_and_starts_the_action(action: BatteryAction, mode: FlightMode) -> None:
    harness = flying(BatteryMinimum(0.15, action))
    future = orbiting(harness)
    harness.autopilot.battery_fraction = 0.14
    before = len(harness.autopilot.setpoints)
    harness.until(future.done, 3.0)
    assert not future.result().success
    assert "guidance.min_battery_percent = 15" in future.result().reason
    harness.until(lambda: harness.autopilot.state.mode is mode, 3.0)
    last = harness.autopilot.setpoints[before:][-1]
    assert last.velocity_ned_mps == (0.0, 0.0, 0.0)
    harness.until(lambda: not harness.guidance.in_command, 60.0)
    assert not harness.autopilot.state.armed
    harness.run()  # so that its end is logged
    low, ended = battery_events(harness)
    assert "battery at 14%" in low
    assert ended.startswith(f"{action} after ")
    assert "low battery: " in ended


def test_hold_after_low_battery_keeps_command() -> None:
    harness = flying(BatteryMinimum(0.15, "hold"))
    future = orbiting(harness)
    harness.autopilot.battery_fraction = 0.14
    harness.until(future.done, 3.0)
    harness.run(5.0)
    assert harness.guidance.phase == "offboard"
    assert isinstance(harness.guidance.behaviour, HoldBehaviour)
    assert len(battery_events(harness)) == 1


def test_low_battery_ends_the_hold_after_a_command() -> None:
    harness = flying()
    harness.run(0.1)
    future = harness.command(HoldBehaviour(0.5))
    harness.until(future.done, 5.0)
    harness.autopilot.battery_fraction = 0.1
    harness.until(lambda: harness.autopilot.state.mode is FlightMode.RETURN, 5.0)


def test_short_dip_of_the_charge_is_ignored() -> None:
    harness = flying()
    future = orbiting(harness)
    for _ in range(3):
        harness.autopilot.battery_fraction = 0.1
        harness.run(0.6)
        harness.autopilot.battery_fraction = 0.2
        harness.run(0.2)
    assert not future.done()


def test_stale_battery_in_flight_is_logged_once() -> None:
    harness = flying()
    future = orbiting(harness)
    harness.autopilot.battery_alive = False
    harness.run(15.0)
    assert not future.done()
    assert len(battery_events(harness)) == 1
    assert "stale" in battery_events(harness)[0]


def test_low_battery_while_engaging_starts_the_return() -> None:
    harness = flying()
    harness.autopilot.lag_s = 1.5
    harness.run(0.1)
    future = harness.command(OrbitBehaviour(Orbit()))
    harness.run(0.06)
    harness.autopilot.battery_fraction = 0.1
    harness.until(future.done, 4.0)
    harness.until(lambda: harness.autopilot.state.mode is FlightMode.RETURN, 5.0)


def test_both_battery_messages_set_the_stamp() -> None:
    state = apply_message(VehicleState(), "BATTERY_STATUS", {"id": 0, "battery_remaining": 40}, 5)
    assert (state.battery_fraction, state.battery_ns) == (0.4, 5)
    sensors = {"onboard_control_sensors_present": 0, "onboard_control_sensors_health": 0}
    fields = {**sensors, "battery_remaining": 39}
    state = apply_message(state, "SYS_STATUS", fields, 9)
    assert (state.battery_fraction, state.battery_ns) == (0.39, 9)
    unknown = apply_message(state, "BATTERY_STATUS", {"id": 0, "battery_remaining": -1}, 20)
    assert unknown.battery_ns == 9


@pytest.mark.parametrize(("fraction", "action"), [(1.5, "rtl"), (-0.1, "rtl"), (0.2, "dive")])
def test_invalid_minimum_is_rejected(fraction: float, action: str) -> None:
    with pytest.raises(ValueError, match="must be"):
        BatteryMinimum(fraction, action)  # type: ignore[arg-type]  # one action is invalid
