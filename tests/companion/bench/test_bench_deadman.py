"""How the reaction to a fault is read from the simulator's truth."""

from __future__ import annotations

import io
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from companion.bench.deadman import deadman_table, reaction


def flight(
    speeds: list[float], modes: list[str] | None = None, start_ns: int = 0, step_ns: int = 20_000_000
) -> list[dict[str, Any]]:
    """Rows of truth, 50 a second."""
    modes = modes or ["OFFBOARD"] * len(speeds)
    return [
        {"stamp_ns": start_ns + index * step_ns, "velocity_ned_mps": [0.0, speed, 0.1], "mode": mode}
        for index, (speed, mode) in enumerate(zip(speeds, modes, strict=True))
    ]


@given(
    braked=st.integers(0, 100),
    stood=st.integers(0, 100),
    left=st.integers(0, 100),
    start=st.integers(0, 10**12),
)
def test_the_first_moment_of_each_counts(braked: int, stood: int, left: int, start: int) -> None:
    slow, still = braked, braked + stood
    speeds = [2.0] * (50 + slow) + [1.0] * (still - slow) + [0.1] * 10
    modes = ["OFFBOARD"] * (50 + min(left, still)) + ["HOLD"] * (len(speeds) - 50 - min(left, still))
    figures = reaction(flight(speeds, modes, start), start + 50 * 20_000_000)
    assert figures.braking_s == pytest.approx(slow * 0.02)
    assert figures.standing_s == pytest.approx(still * 0.02)
    assert figures.failsafe_s == pytest.approx(min(left, still) * 0.02)


def test_missing_figures_are_none_and_a_late_record_is_refused() -> None:
    rows = flight([2.0] * 100)
    figures = reaction(rows, 1_000_000_000)
    assert (figures.braking_s, figures.standing_s, figures.failsafe_s) == (None, None, None)
    with pytest.raises(ValueError, match=r"record .* before"):
        reaction(rows, 10_000_000_000)


def test_table_shows_the_longest_time_and_missing_ones() -> None:
    out = io.StringIO()
    figures: dict[str, dict[str, list[float | None]]] = {
        "x": {"braking_s": [0.2, 0.35], "standing_s": [None, 1.5], "failsafe_s": [None, None]}
    }
    Console(file=out, width=100).print(deadman_table(figures))
    text = out.getvalue()
    assert "0.35" in text
    assert "1.50 (never in 1)" in text
    assert "never" in text
