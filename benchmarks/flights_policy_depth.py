"""Flights of the bundled policy `approach` with a depth camera: as `flights_approach_depth`."""

from __future__ import annotations

from benchmarks.flights import FlightResult
from benchmarks.flights_approach import WITH_DEPTH_M, fly
from benchmarks.flights_policy import command


def run(seed: int, *, rendered: bool = False) -> FlightResult:
    """One flight with depth."""
    return fly(seed, with_depth=True, tolerance_m=WITH_DEPTH_M, rendered=rendered, command=command)
