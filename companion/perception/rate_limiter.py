"""How many attitudes go on to a worker: telemetry may bring more than it needs."""

from __future__ import annotations

# At most 50 attitudes a second go to the worker; the tolerance is for telemetry of 50 Hz, which jitters.
ATTITUDE_PERIOD_S, ATTITUDE_JITTER_S = 0.02, 0.005


class RateLimiter:
    """Lets through at most 50 a second of one row of attitudes."""

    def __init__(self) -> None:
        self._due_ns = 0

    def due(self, stamp_ns: int) -> bool:
        """Whether the attitude of this stamp (CLOCK_MONOTONIC ns) goes on; the next one's turn follows."""
        if self._due_ns - stamp_ns > ATTITUDE_JITTER_S * 1e9:
            return False
        self._due_ns = max(
            self._due_ns + round(ATTITUDE_PERIOD_S * 1e9), stamp_ns + round(2 * ATTITUDE_JITTER_S * 1e9)
        )
        return True
