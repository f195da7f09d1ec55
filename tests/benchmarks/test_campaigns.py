"""Campaigns over many seeds, as `docs/measurements.md` reports them: `make test-slow`."""

from __future__ import annotations

import pytest

from benchmarks.flights import fly
from companion.bench.demo_flight import fly_demos

pytestmark = pytest.mark.slow

SEEDS = range(300, 308)


@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    ("name", "least"),
    [
        ("approach-depth", 8),
        ("approach", 7),
        ("obstacles", 8),
        ("bearing", 8),
        ("land", 7),
        ("follow", 6),
        ("hold", 8),
        ("orbit", 7),
    ],
)
def test_most_flights_of_a_campaign_succeed(name: str, least: int) -> None:
    results = list(fly(name, SEEDS))
    failures = {result.seed: result.reason for result in results if not result.success}
    assert len(results) - len(failures) >= least, failures


@pytest.mark.timeout(900)
def test_rendered_demonstration_succeeds_in_other_worlds() -> None:
    for flight in fly_demos(range(300, 304)):
        assert flight.success, (flight.seed, flight.failure)
        assert flight.confirmed == "car"
        assert flight.hold_range_m == pytest.approx(5.0, abs=0.5)
