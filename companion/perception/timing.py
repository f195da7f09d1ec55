"""Durations of the perception stages: quantiles of the newest results."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping

WINDOW = 200


class StageTimes:
    """Keeps each stage's newest `WINDOW` durations, milliseconds."""

    def __init__(self) -> None:
        self._times: dict[str, deque[float]] = {}

    def add(self, timing_ms: Mapping[str, float]) -> None:
        """Add one result's durations."""
        for stage, value in timing_ms.items():
            self._times.setdefault(stage, deque(maxlen=WINDOW)).append(value)

    def quantile_ms(self, share: float) -> dict[str, float]:
        """Return stage → quantile `share` (0..1) by nearest rank."""
        return {stage: _nearest_rank(sorted(values), share) for stage, values in self._times.items()}


def _nearest_rank(ascending: list[float], share: float) -> float:
    return ascending[math.ceil(share * len(ascending)) - 1]
