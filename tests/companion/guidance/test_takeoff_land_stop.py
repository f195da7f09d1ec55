"""Outputs and outcomes of takeoff, land, rtl and stop. Their execution is tested with the guidance core."""

from dataclasses import replace
from typing import Any

import pytest

from companion.guidance.authority import Authority
from companion.guidance.behaviour import BehaviourContext, ModeRequest, Outcome
from companion.guidance.behaviours.land import LandBehaviour, ReturnBehaviour
from companion.guidance.behaviours.stop import StopBehaviour
from companion.guidance.behaviours.takeoff import TakeoffBehaviour
from companion.vehicle.state import FlightMode, LandedState, VehicleState
from tests.companion.guidance.guidance_harness import assert_failed, assert_succeeded
from tests.companion.guidance.kinematic_vehicle import START_NS, KinematicVehicle

PARKED = replace(
    KinematicVehicle(position=[0.0, 0.0, 0.0], armed=False, landed=LandedState.ON_GROUND).state,
    mode=FlightMode.HOLD,
)


def context(seconds: float, state: VehicleState = PARKED, **changes: Any) -> BehaviourContext:
    now_ns = START_NS + round(seconds * 1e9)
    return BehaviourContext(now_ns, replace(state, attitude_ns=now_ns, position_ns=now_ns, **changes))


def climbing(
    altitude_m: float, mode: FlightMode = FlightMode.TAKEOFF, landed: LandedState = LandedState.TAKING_OFF
) -> dict[str, Any]:
    return {"armed": True, "mode": mode, "landed": landed, "position_ned_m": (0.0, 0.0, -altitude_m)}


def test_takeoff_requests_the_mode_until_near_the_height() -> None:
    behaviour = TakeoffBehaviour(5.0)
    behaviour.on_activate(context(0))
    request = ModeRequest(FlightMode.TAKEOFF, 5.0, arm=True)
    assert behaviour.update(0.0, context(0)) == request
    assert behaviour.update(0.02, context(5, **climbing(4.8))) == request
    holding = climbing(4.8, FlightMode.HOLD, LandedState.IN_AIR)
    rising = holding | {"velocity_ned_mps": (0.0, 0.0, -0.5)}
    assert behaviour.update(0.02, context(6, **rising)) == request
    assert behaviour.update(0.02, context(7, **holding)) == request
    outcome = behaviour.update(0.02, context(7.5, **holding))
    assert isinstance(outcome, Outcome)
    assert (outcome.success, outcome.goal_ned_m) == (True, (0.0, 0.0, -5.0))
    assert "4.8 m" in outcome.reason


def test_takeoff_times_out_with_the_height_reached() -> None:
    behaviour = TakeoffBehaviour(5.0)
    behaviour.on_activate(context(0))
    assert_failed(behaviour.update(0.02, context(60, armed=True, mode=FlightMode.TAKEOFF)), "0.0 m of 5 m")


@pytest.mark.parametrize(("cut", "altitude_m"), [(True, 9.65), (False, 9.65), (True, 8.9)])
def test_takeoff_to_a_limit_that_slows_it_down_has_succeeded(cut: bool, altitude_m: float) -> None:
    behaviour = TakeoffBehaviour(10.0)
    behaviour.on_activate(context(0))
    below = climbing(altitude_m, FlightMode.HOLD, LandedState.IN_AIR)
    behaviour.update(0.02, context(5.0, **below))
    behaviour.update(0.02, context(6.5, **below))
    outcome = behaviour.update(0.02, replace(context(90, **below), held_at_height=cut))
    assert isinstance(outcome, Outcome)
    assert outcome.success is (cut and altitude_m > 9.0)


LANDING = replace(PARKED, armed=True, mode=FlightMode.LAND, landed=LandedState.IN_AIR, heartbeat_ns=START_NS)
PILOT = "the pilot took over: offboard mode"


@pytest.mark.parametrize("height_m", [0.5, 10.0])
@pytest.mark.parametrize(("armed", "reason"), [(False, None), (True, PILOT)], ids=["landed", "pilot"])
def test_mode_after_the_landing_comes_before_disarmed(
    height_m: float, armed: bool, reason: str | None
) -> None:
    """CURRENT_MODE shows it up to a second before HEARTBEAT; EXTENDED_SYS_STATE may be later still."""
    down_mps = 0.5 if height_m < 1.0 else 0.0  # at 10 m the ground is higher than home
    landing = replace(LANDING, position_ned_m=(0.0, 0.0, -height_m), velocity_ned_mps=(0.0, 0.0, down_mps))
    authority = Authority()
    authority.acquire(landing)
    assert authority.lost(landing, START_NS, flying_by_setpoint=False) is None
    changed = replace(landing, mode=FlightMode.OFFBOARD)
    now_ns = START_NS
    for after_s in (0.1, 0.9):
        now_ns = START_NS + round(after_s * 1e9)
        assert authority.lost(changed, now_ns, flying_by_setpoint=False) is None
    later = replace(changed, armed=armed, heartbeat_ns=now_ns)
    assert authority.lost(later, now_ns, flying_by_setpoint=False) == reason


def test_pilot_ends_a_descent_at_once() -> None:
    descending = replace(
        LANDING, position_ned_m=(0.0, 0.0, -10.0), velocity_ned_mps=(0.0, 0.0, 0.7), heartbeat_ns=START_NS
    )
    authority = Authority()
    authority.acquire(descending)
    changed = replace(descending, mode=FlightMode.OFFBOARD)
    assert authority.lost(changed, START_NS + 100_000_000, flying_by_setpoint=False) == PILOT


def test_pilot_ends_a_landing_that_is_being_requested_at_once() -> None:
    """Also of a vehicle that stands: the request, which would take the mode away again, ends."""
    hovering = replace(LANDING, mode=FlightMode.OFFBOARD, velocity_ned_mps=(0.0, 0.0, 0.0))
    authority = Authority()
    authority.acquire(hovering)
    authority.request(FlightMode.LAND, hovering)
    assert authority.lost(hovering, START_NS, flying_by_setpoint=False) is None
    changed = replace(hovering, mode=FlightMode.POSITION)
    reason = authority.lost(changed, START_NS + 100_000_000, flying_by_setpoint=False)
    assert reason is not None
    assert reason.startswith("the pilot ")
    assert reason.endswith(": position mode")


@pytest.mark.parametrize("kind", [LandBehaviour, ReturnBehaviour])
def test_landing_on_the_ground_succeeds_at_once(
    kind: type[LandBehaviour] | type[ReturnBehaviour],
) -> None:
    behaviour = kind()
    behaviour.on_activate(context(0))
    assert_succeeded(behaviour.update(0.0, context(0)), "the ground")


@pytest.mark.parametrize(("kind", "seconds"), [(LandBehaviour, 60), (ReturnBehaviour, 400)])
def test_land_and_rtl_time_out_with_the_landed_state(
    kind: type[LandBehaviour] | type[ReturnBehaviour], seconds: float
) -> None:
    behaviour = kind()
    aloft = climbing(5.0, FlightMode.LAND, LandedState.LANDING)
    behaviour.on_activate(context(0, **aloft))
    assert_failed(behaviour.update(0.02, context(seconds, **aloft)), "landing and ", " and armed")


def test_timeout_grows_with_height_and_distance() -> None:
    near = context(0, **climbing(5.0)).state
    far = replace(near, position_ned_m=(150.0, 0.0, -40.0))
    assert LandBehaviour().timeout_s(far) > LandBehaviour().timeout_s(near) + 50
    assert ReturnBehaviour().timeout_s(far) > ReturnBehaviour().timeout_s(near) + 50


def test_stop_requests_hold_even_if_it_shows_already() -> None:
    behaviour = StopBehaviour()
    behaviour.on_activate(context(0))
    assert behaviour.update(0.0, context(0)) == ModeRequest(FlightMode.HOLD)
    assert_succeeded(behaviour.update(0.02, context(0.1)))


def test_stop_times_out_with_the_current_mode() -> None:
    behaviour = StopBehaviour()
    behaviour.on_activate(context(0))
    outcome = assert_failed(behaviour.update(0.02, context(6, mode=FlightMode.OFFBOARD)))
    assert outcome.reason.endswith("in 5 s: offboard mode")
