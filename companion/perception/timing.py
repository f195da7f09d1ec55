"""How long each stage of perception takes: the median and the slow end of the newest results."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping

WINDOW = 200


class StageTimes:
    """Keeps each stage's newest `WINDOW` times, milliseconds."""

    def __init__(self) -> None:
        self._times: dict[str, deque[float]] = {}

    def add(self, timing_ms: Mapping[str, float]) -> None:
        """Take up one result's times."""
        for stage, value in timing_ms.items():
            self._times.setdefault(stage, deque(maxlen=WINDOW)).append(value)

    def quantile_ms(self, share: float) -> dict[str, float]:
        """Stage → the time that `share` of the results did not exceed, by nearest rank."""
        return {stage: _nearest_rank(sorted(values), share) for stage, values in self._times.items()}


def _nearest_rank(ascending: list[float], share: float) -> float:
    return ascending[math.ceil(share * len(ascending)) - 1]
