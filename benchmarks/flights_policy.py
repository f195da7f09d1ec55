"""Flights of the bundled policy `approach`, without depth: as `flights_approach`."""

from __future__ import annotations

from benchmarks.flights import FlightResult
from benchmarks.flights_approach import DISTANCE_M, WITHOUT_DEPTH_M, fly


def command(class_name: str) -> str:
    """The command that is flown."""
    return f"policy approach class={class_name} distance={DISTANCE_M:g}"


def run(seed: int, *, rendered: bool = False) -> FlightResult:
    """One flight without depth."""
    return fly(seed, with_depth=False, tolerance_m=WITHOUT_DEPTH_M, rendered=rendered, command=command)
