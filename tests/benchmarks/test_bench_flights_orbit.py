"""Campaigns of orbits and of the hold after a `goto`: what their figures mean."""

import pytest

from benchmarks import flights_hold, flights_orbit, flights_orbit_calm
from benchmarks.flights import FlightResult


@pytest.mark.slow
def test_gusts_widen_an_orbit() -> None:
    gusts, calm = flights_orbit.run(1), flights_orbit_calm.run(1)
    assert gusts.success, gusts.reason
    assert calm.success, calm.reason
    for name in ("radius_error_max_m", "heading_error_p95_deg"):
        assert gusts.values[name] > calm.values[name] > 0.0
    assert 3.0 < calm.values["speed_p50_mps"] < 4.0


def test_orbit_outside_of_its_tolerance_is_no_success(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flights_orbit, "WITHIN_M", 0.05)
    result = flights_orbit.run(1)
    assert not result.success
    assert result.values["radius_error_p95_m"] > 0.05


def test_orbit_that_is_not_flown_is_no_success(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flights_orbit, "LIMIT_S", 1.0)
    result = flights_orbit.run(1)
    assert result == FlightResult(1, False, {}, result.reason)
    assert result.reason.startswith("not flown ")
    assert result.reason.endswith(" 1 s")


def test_hold_is_judged_by_the_estimate_and_by_the_truth() -> None:
    flight = flights_hold.run(3)
    assert flight.success, flight.reason
    assert 0.05 < flight.values["hold_error_max_m"] <= 0.3
    assert flight.values["true_hold_error_max_m"] != flight.values["hold_error_max_m"]
