"""Limits the rate of attitudes sent to a worker."""

from __future__ import annotations

# At most 50 attitudes a second; the tolerance is for the jitter of telemetry at 50 Hz.
ATTITUDE_PERIOD_S, ATTITUDE_JITTER_S = 0.02, 0.005


class RateLimiter:
    """Passes at most 50 attitudes of one series a second."""

    def __init__(self) -> None:
        self._due_ns = 0

    def due(self, stamp_ns: int) -> bool:
        """Whether to send the attitude of this stamp (CLOCK_MONOTONIC ns); if so, schedules the next."""
        if self._due_ns - stamp_ns > ATTITUDE_JITTER_S * 1e9:
            return False
        self._due_ns = max(
            self._due_ns + round(ATTITUDE_PERIOD_S * 1e9), stamp_ns + round(2 * ATTITUDE_JITTER_S * 1e9)
        )
        return True
