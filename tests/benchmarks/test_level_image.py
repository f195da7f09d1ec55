"""The horizon of an orbit at 5 m/s in levelled images: `benchmarks.level_image`, one seed each."""

from __future__ import annotations

import pytest

from benchmarks.level_image import pairs

LEVEL_DEG = 0.5


@pytest.mark.parametrize(
    "rolling_shutter_s", [pytest.param(0.0, marks=pytest.mark.slow), 0.03], ids=["global", "rolling"]
)
def test_horizon_of_an_orbit_is_level_within_half_a_degree(rolling_shutter_s: float) -> None:
    taken = list(pairs(11, rolling_shutter_s, count=2))
    assert max(abs(pair.tilted.slope_deg) for pair in taken) > 10.0
    assert max(pair.tilted.bend_deg for pair in taken) > 0.4, "by the lens"
    for pair in taken:
        assert abs(pair.level.slope_deg) < LEVEL_DEG
        assert abs(pair.level.offset_deg) < LEVEL_DEG
        assert pair.level.bend_deg < 0.2
        assert abs(pair.exact.slope_deg) < 0.05, "the rest is the autopilot's error"
