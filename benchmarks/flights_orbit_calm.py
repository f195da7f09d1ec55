"""Orbits without gusts: as `flights_orbit`, in steady wind."""

from __future__ import annotations

from benchmarks.flights import FlightResult
from benchmarks.flights_orbit import fly


def run(seed: int) -> FlightResult:
    """One flight in steady wind."""
    return fly(seed, 0.0)
