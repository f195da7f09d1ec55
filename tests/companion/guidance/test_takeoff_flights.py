"""How a take-off ends, in lockstep with the simulated vehicle."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

from companion.bench.lockstep_flight import LockstepFlight, plain_settings
from companion.bench.simulated_driver import RATES_HZ, SimulatedDriver
from companion.guidance.behaviour import Outcome
from companion.guidance.behaviours.takeoff import SIDEWAYS_MPS
from companion.vehicle.autopilot_profile import Px4Profile
from companion.vehicle.driver import CommandRefusedError
from companion.vehicle.state import FlightMode, LandedState, VehicleState
from mavlink_sim.lockstep import LockstepVehicle
from mavlink_sim.wire.messages import dialect
from tests.companion.guidance.guidance_harness import assert_failed, assert_succeeded, known

OLDER = ("1.14", "1.15", "1.16", "1.18")


def on_ground(px4: str | None = None, *, seed: int = 9, **parameters: float) -> LockstepFlight:
    vehicle = LockstepVehicle({"onboard": RATES_HZ}, seed=seed, parameters=parameters, px4=px4)
    flight = LockstepFlight(SimulatedDriver(vehicle), plain_settings())
    assert flight.run_until(lambda: flight.state.ready_to_arm, 30.0)
    return flight


@pytest.mark.parametrize(
    ("height_m", "parameters"),
    [(6.0, {"NAV_MC_ALT_RAD": 1.6}), (2.5, {})],
    ids=["PX4 ends it 1.3 m short", "2.5 m"],
)
def test_takeoff_reaches_its_height(height_m: float, parameters: dict[str, Any]) -> None:
    flight = on_ground(**parameters)
    assert_succeeded(flight.fly(f"takeoff {height_m}", 90.0).outcome)
    assert flight.state.altitude_m == pytest.approx(height_m, abs=0.3)


def pilot_selects(flight: LockstepFlight, auto_mode: int) -> None:
    """A ground station requests an AUTO mode of PX4: 3 is HOLD, 6 is LAND."""
    request = dialect.MAVLink_command_long_message(
        1, 1, dialect.MAV_CMD_DO_SET_MODE, 0, 1, 4, auto_mode, 0, 0, 0, 0
    )
    flight.vehicle.send(request, source=(255, 190))


def held_in_climb(flight: LockstepFlight, wanted_m: float, hold_m: float) -> tuple[float, Outcome]:
    """A pilot's HOLD at a height of a take-off: how far it was short when it showed, and the outcome."""
    identifier = flight.command(f"takeoff {wanted_m}")
    assert flight.run_until(lambda: (flight.state.altitude_m or 0.0) > hold_m, 30.0)
    assert flight.state.mode is FlightMode.TAKEOFF
    pilot_selects(flight, 3)
    assert flight.run_until(lambda: flight.state.mode is FlightMode.HOLD, 5.0)
    short_m = wanted_m - (flight.state.altitude_m or 0.0)
    assert flight.run_until(lambda: flight.outcome(identifier), 60.0)
    outcome = known(flight.outcome(identifier))
    return short_m, outcome


PILOT = "the pilot took over: hold mode"
SOMEONE = "m short: a pilot or the autopilot changed to hold mode"


@pytest.mark.parametrize(
    ("acceptance_m", "wanted_m", "hold_m", "reason"),
    [
        (1.6, 6.0, 2.5, PILOT),
        (None, 6.0, 2.5, SOMEONE),
        *((not_used, 2.5, 0.5, SOMEONE) for not_used in (math.inf, math.nan, -1.0)),
        pytest.param(2.1, 4.0, 0.5, SOMEONE, marks=pytest.mark.slow),
        (2.0, 3.6, 1.2, SOMEONE),  # inside the radius, but less than half of the climb
        (0.8, 2.5, 0.5, PILOT),
    ],
)
def test_hold_in_mid_takeoff_ends_the_command(
    acceptance_m: float | None, wanted_m: float, hold_m: float, reason: str
) -> None:
    flight = on_ground()
    values = () if acceptance_m is None else (("NAV_MC_ALT_RAD", acceptance_m),)
    flight.inputs.parameters = replace(flight.inputs.parameters, values=values)
    _, outcome = held_in_climb(flight, wanted_m, hold_m)
    assert not outcome.success
    assert outcome.reason.endswith(reason)
    assert flight.state.mode is FlightMode.HOLD


@pytest.mark.parametrize(
    ("hold_m", "least_m", "most_m", "pilots"), [(4.6, 1.3, 1.45, True), (4.75, 1.1, 1.3, False)]
)
def test_hold_outside_the_acceptance_alone_is_a_pilots(
    hold_m: float, least_m: float, most_m: float, pilots: bool
) -> None:
    flight = on_ground()
    short_m, outcome = held_in_climb(flight, 6.0, hold_m)
    assert least_m < short_m < most_m
    if pilots:
        assert outcome == Outcome(False, PILOT)
        assert flight.state.mode is FlightMode.HOLD
    else:
        assert_succeeded(outcome)
        assert flight.state.altitude_m == pytest.approx(6.0, abs=0.3)


@pytest.mark.parametrize(
    ("after", "auto_mode", "shown"),
    [
        (FlightMode.HOLD, 6, FlightMode.LAND),
        (FlightMode.OFFBOARD, 6, FlightMode.LAND),
        (FlightMode.OFFBOARD, 3, FlightMode.HOLD),
    ],
)
def test_pilot_stops_the_rest_of_a_takeoff(after: FlightMode, auto_mode: int, shown: FlightMode) -> None:
    flight = on_ground()
    identifier = flight.command("takeoff 6")
    assert flight.run_until(lambda: (flight.state.altitude_m or 0.0) > 4.75, 30.0)
    pilot_selects(flight, 3)
    assert flight.run_until(lambda: flight.state.mode is after, 10.0)
    assert flight.outcome(identifier) is None
    pilot_selects(flight, auto_mode)
    assert flight.run_until(lambda: flight.outcome(identifier), 3.0)
    outcome = known(flight.outcome(identifier))
    assert outcome.reason.startswith("the pilot ")
    assert outcome.reason.endswith(f": {shown.value} mode")
    flight.run(3.0)
    assert flight.state.mode is shown


@pytest.mark.parametrize("px4", ["1.17", *(pytest.param(name, marks=pytest.mark.slow) for name in OLDER)])
def test_twenty_low_takeoffs_reach_their_height(px4: str) -> None:
    """PX4 would end them anywhere above NAV_MC_ALT_RAD below the height, and its height drifts."""
    for number in range(20):
        wanted_m, drift_m = (1.0, 1.2, 1.5, 2.0, 2.2)[number % 5], (-0.5, 0.0, 0.3, 0.5)[number % 4]
        flight = on_ground(px4, seed=number)
        flight.vehicle.vehicle.faults.begin(f"height_drift {drift_m} over=4")
        flight.run(2.0)
        modes = set[FlightMode]()
        identifier = flight.command(f"takeoff {wanted_m}")
        for _ in range(600):
            flight.run(0.05)
            modes.add(flight.state.mode)
            if flight.outcome(identifier) is not None:
                break
        outcome = known(flight.outcome(identifier))
        assert outcome.success, (number, wanted_m, drift_m, outcome.reason)
        assert flight.state.altitude_m == pytest.approx(wanted_m, abs=0.3)
        assert FlightMode.TAKEOFF not in modes


@pytest.mark.parametrize("after_s", [0.5, 1.0, 1.5, 2.0, 2.5])
def test_estimate_that_moves_at_lift_off_is_not_chased(after_s: float) -> None:
    """It drifts by a metre, without a counted reset, before the vehicle lifts off (1.9 s) or after."""
    flight = on_ground()
    at_s = flight.vehicle.vehicle.faults.now_s + after_s
    flight.vehicle.vehicle.faults.begin(f"gps_drift speed=0.6 limit=1 towards=60 at={at_s}")
    log = flight.fly("takeoff 1.5", 40.0, warm_up_s=0.0)
    assert_succeeded(log.outcome)
    standing = 0
    # In the air the correction of the estimated velocity comes on top of it.
    allowed_mps = {LandedState.TAKING_OFF: SIDEWAYS_MPS, LandedState.IN_AIR: SIDEWAYS_MPS + 0.05}
    for moment in log.moments:
        velocity = known(moment.sent.velocity_ned_mps)
        landed = moment.context.state.landed
        standing += landed is LandedState.ON_GROUND
        assert math.hypot(*velocity[:2]) <= allowed_mps.get(landed, 0.0) + 1e-6
    assert standing > 10


@pytest.mark.parametrize(("acceptance_m", "wanted_m"), [(0.8, 2.0), (200.0, 5.0), (None, 1.5)])
def test_pilots_hold_ends_a_low_takeoff_at_any_height(acceptance_m: float | None, wanted_m: float) -> None:
    for hold_m in (0.3, 0.9, 1.3):
        flight = on_ground()
        values = () if acceptance_m is None else (("NAV_MC_ALT_RAD", acceptance_m),)
        flight.inputs.parameters = replace(flight.inputs.parameters, values=values)
        identifier = flight.command(f"takeoff {wanted_m}")
        assert flight.run_until(lambda: (flight.state.altitude_m or 0.0) > hold_m, 30.0)  # noqa: B023
        before = flight.state.mode
        assert before is FlightMode.OFFBOARD
        pilot_selects(flight, 3)
        assert flight.run_until(lambda: flight.outcome(identifier), 5.0)  # noqa: B023
        outcome = known(flight.outcome(identifier))
        assert outcome.reason == PILOT
        flight.run(3.0)
        assert flight.state.mode is FlightMode.HOLD


def test_low_takeoff_without_offboard_is_disarmed_on_the_ground() -> None:
    flight = on_ground()
    flight.vehicle.vehicle.faults.begin("refuse_mode OFFBOARD")
    assert_failed(flight.fly("takeoff 1.5", 30.0).outcome, "offboard")
    assert flight.run_until(lambda: not flight.state.armed, 3.0)
    assert flight.state.landed is LandedState.ON_GROUND


@pytest.mark.parametrize("up_m", [pytest.param(0.73, marks=pytest.mark.slow), -0.73])
def test_takeoff_counts_from_home_as_moved_by_arming(up_m: float) -> None:
    flight = on_ground()
    flight.vehicle.vehicle.faults.begin(f"height_drift {up_m} over=5")
    flight.run(6.0)
    before_m = known(flight.state.home_altitude_amsl_m)
    assert flight.state.altitude_m == pytest.approx(up_m, abs=0.1)  # above home as it was
    assert flight.state.landed is LandedState.ON_GROUND
    outcome = assert_succeeded(flight.fly("takeoff 5", 90.0).outcome)
    assert flight.state.home_altitude_amsl_m == pytest.approx(before_m + up_m, abs=0.15)
    altitude_m = flight.state.altitude_m
    assert altitude_m == pytest.approx(5.0, abs=0.3)
    assert float(outcome.reason.split()[2]) == pytest.approx(altitude_m, abs=0.1)
    assert flight.vehicle.truth.height_m == pytest.approx(5.0, abs=0.4)


def test_takeoff_refused_after_arming_disarms_the_vehicle(monkeypatch: pytest.MonkeyPatch) -> None:
    flight = on_ground()

    def refuse(profile: Px4Profile, altitude_m: float, state: VehicleState) -> tuple[float, ...]:
        assert state.armed
        raise CommandRefusedError("home position not received")

    monkeypatch.setattr(Px4Profile, "takeoff_parameters", refuse)
    assert_failed(flight.fly("takeoff 4", 30.0).outcome)
    # Long before PX4 would disarm by itself (COM_DISARM_PRFLT, 10 s).
    assert flight.run_until(lambda: not flight.state.armed, 3.0)
    assert flight.state.landed is LandedState.ON_GROUND
