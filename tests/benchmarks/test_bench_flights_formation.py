"""Five simulated vehicles in formation through turns: the campaign `benchmarks.flights formation`."""

from __future__ import annotations

import pytest

from benchmarks.flights import fly, summary


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_five_vehicles_fly_turns_in_formation_never_too_near(seed: int) -> None:
    (result,) = fly("formation", [seed])
    assert result.success, result.reason
    assert result.values["min_separation_m"] >= 3.0
    assert result.values["slot_error_p95_m"] < 4.0
    assert summary("formation", [result])["success_rate"] == 1.0
