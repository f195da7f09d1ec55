"""How a take-off ends, in lockstep with the simulated vehicle."""

from __future__ import annotations

import pytest

from companion.bench.lockstep_flight import LockstepFlight, plain_settings
from companion.bench.simulated_driver import RATES_HZ, SimulatedDriver
from mavlink_sim.lockstep import LockstepVehicle
from mavlink_sim.wire.messages import dialect


def wide_acceptance() -> LockstepFlight:
    """On the ground: its take-off ends 1.3 m short of the height."""
    vehicle = LockstepVehicle({"onboard": RATES_HZ}, seed=9, parameters={"NAV_MC_ALT_RAD": 1.6})
    flight = LockstepFlight(SimulatedDriver(vehicle), plain_settings())
    assert flight.run_until(lambda: flight.state.ready_to_arm, 30.0)
    return flight


def test_takeoff_that_px4_ends_early_reaches_its_height() -> None:
    flight = wide_acceptance()
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
    flight = wide_acceptance()
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
