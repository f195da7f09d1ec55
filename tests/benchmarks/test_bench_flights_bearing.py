"""What the attitude at the moment of capture is worth to a bearing."""

import pytest

from benchmarks import flights_bearing


def test_a_banking_vehicle_does_not_swing_what_it_looks_at(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flights_bearing, "LIMIT_S", 16.0)
    flight = flights_bearing.run(1)
    assert flight.success, flight.reason
    errors = flight.values
    assert errors["leaning_p50_deg"] > 10.0
    assert errors["bearing_error_at_capture_p95_deg"] < 1.5
    assert errors["bearing_error_newest_p95_deg"] > 1.5 * errors["bearing_error_at_capture_p95_deg"]
    assert errors["bearing_error_heading_alone_p95_deg"] > 5.0 * errors["bearing_error_at_capture_p95_deg"]
