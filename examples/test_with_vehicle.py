"""Flights as tests: `pytest test_with_vehicle.py`. Simulated time, no sockets, deterministic."""

import math

import pytest

from companion.bench.lockstep_flight import LockstepFlight
from mavlink_sim import LockstepVehicle


def test_vehicle_takes_off_and_lands_in_wind() -> None:
    vehicle = LockstepVehicle(seed=1, wind_mps=4.0)
    vehicle.take_off(5.0)
    assert vehicle.truth.height_m == pytest.approx(5.0, abs=1.0)
    vehicle.land()
    assert not vehicle.truth.armed
    assert not vehicle.truth.crashed


def test_companion_reaches_position_within_speed() -> None:
    flight = LockstepFlight.airborne(seed=1, height_m=5.0)
    record = flight.fly("goto north=12 east=5 speed=2", limit_s=30.0)
    assert record.outcome is not None
    assert record.outcome.success, record.outcome.reason
    assert math.dist(flight.vehicle.truth.position_ned_m, (12.0, 5.0, -5.0)) < 1.0
    assert max(math.hypot(*moment.truth.velocity_ned_mps) for moment in record.moments) < 2.5
