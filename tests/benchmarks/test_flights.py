"""Flights of campaigns by their names."""

from __future__ import annotations

import pytest

from benchmarks.flights import UnknownFlightError, flight_named, flights, summary


def test_campaign_flights_have_names() -> None:
    assert {"approach", "approach-depth", "follow", "obstacles"} <= set(flights())
    with pytest.raises(UnknownFlightError, match="there are: "):
        flight_named("nix")
    with pytest.raises(ValueError, match="no flights"):
        summary("follow", [])
