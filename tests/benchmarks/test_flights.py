"""Flights of campaigns by their names."""

from __future__ import annotations

from benchmarks.flights import flights


def test_campaign_flights_have_names() -> None:
    assert {"approach", "approach-depth", "follow", "obstacles"} <= set(flights())
