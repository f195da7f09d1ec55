"""How a take-off ends, in lockstep with the simulated vehicle."""

from __future__ import annotations

import pytest

from companion.bench.lockstep_flight import LockstepFlight, plain_settings
from companion.bench.simulated_driver import RATES_HZ, SimulatedDriver
from companion.vehicle.state import LandedState
from mavlink_sim.lockstep import LockstepVehicle
from mavlink_sim.wire.messages import dialect


def on_ground(**parameters: float) -> LockstepFlight:
    vehicle = LockstepVehicle({"onboard": RATES_HZ}, seed=9, parameters=parameters)
    flight = LockstepFlight(SimulatedDriver(vehicle), plain_settings())
    assert flight.run_until(lambda: flight.state.ready_to_arm, 30.0)
    return flight


def test_takeoff_that_px4_ends_early_reaches_its_height() -> None:
    flight = on_ground(NAV_MC_ALT_RAD=1.6)  # 1.3 m short
    outcome = flight.fly("takeoff 6", 90.0).outcome
    assert outcome is not None
    assert outcome.success, outcome.reason
    assert flight.state.altitude_m == pytest.approx(6.0, abs=0.3)


@pytest.mark.parametrize(
    ("acceptance_m", "reason"),
    [
        (1.6, "the pilot took over: hold mode"),
        (None, "m short: a pilot or the autopilot changed to hold mode"),
    ],
)
def test_hold_in_mid_takeoff_ends_the_command(acceptance_m: float | None, reason: str) -> None:
    flight = on_ground(NAV_MC_ALT_RAD=1.6)  # 1.3 m short
    flight.inputs.altitude_acceptance_m = acceptance_m
    identifier = flight.command("takeoff 6")
    assert flight.run_until(lambda: (flight.state.altitude_m or 0.0) > 2.5, 30.0)
    hold_mode = dialect.MAVLink_command_long_message(
        1, 1, dialect.MAV_CMD_DO_SET_MODE, 0, 1, 4, 3, 0, 0, 0, 0
    )
    flight.vehicle.send(hold_mode, source=(255, 190))
    assert flight.run_until(lambda: flight.outcome(identifier), 5.0)
    outcome = flight.outcome(identifier)
    assert outcome is not None
    assert not outcome.success
    assert outcome.reason.endswith(reason)


@pytest.mark.parametrize("up_m", [0.73, -0.73])
def test_takeoff_counts_from_home_as_moved_by_arming(up_m: float) -> None:
    flight = on_ground()
    flight.vehicle.vehicle.faults.begin(f"height_drift {up_m} over=5")
    flight.run(6.0)
    before_m = flight.state.home_altitude_amsl_m
    assert before_m is not None
    assert flight.state.altitude_m == pytest.approx(up_m, abs=0.1)  # above home as it was
    assert flight.state.landed is LandedState.ON_GROUND
    outcome = flight.fly("takeoff 5", 90.0).outcome
    assert outcome is not None
    assert outcome.success, outcome.reason
    assert flight.state.home_altitude_amsl_m == pytest.approx(before_m + up_m, abs=0.15)
    altitude_m = flight.state.altitude_m
    assert altitude_m == pytest.approx(5.0, abs=0.3)
    assert float(outcome.reason.split()[2]) == pytest.approx(altitude_m, abs=0.1)
    assert flight.vehicle.truth.height_m == pytest.approx(5.0, abs=0.4)
