"""The autopilot's boot clock against ours, by TIMESYNC (https://mavlink.io/en/services/timesync.html).

The delays of request and reply are unknown, so the offset's error is at most half of the round trip. The
shortest round trip of the last seconds is used (the minimum filter of D. Mills' NTP, RFC 5905, §10).
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

KEPT_S = 10.0
# Two quartz clocks, 50 ppm each: more than any flight controller's data sheet allows.
DRIFT = 100e-6
# A slower reply is no better than the arrival time of messages; a radio of 57600 baud needs 0.2 s.
LONGEST_TRIP_NS = 500_000_000
# A stamp this far from its arrival comes from another clock, not from a slow link.
WRONG_CLOCK_NS = 2_000_000_000
# `SenderDelay`: the minimum is taken over this window and the one before. 50 ppm drift by 3 ms in a minute.
_WINDOW_NS = 30 * 10**9


@dataclass(frozen=True, slots=True)
class ClockOffset:
    """Boot time minus CLOCK_MONOTONIC, and its maximum error, nanoseconds."""

    offset_ns: int
    error_ns: int


class ClockSync:
    """Estimates the offset from TIMESYNC replies; resets when the autopilot's clock jumps.

    The clock of a simulation that does not run in real time jumps constantly: its messages are then stamped
    with their arrival.
    """

    def __init__(self) -> None:
        self._samples: deque[tuple[int, ClockOffset]] = deque()  # (CLOCK_MONOTONIC ns, offset)

    def reset(self) -> None:
        """Discard all samples: the autopilot's clock has restarted."""
        self._samples.clear()

    def answer(self, asked_ns: int, boot_ns: int, received_ns: int) -> bool:
        """Add a reply: sent and received by our clock, answered at `boot_ns` by the autopilot's.

        Returns:
            False if it is unusable: the round trip is too long or negative.
        """
        trip_ns = received_ns - asked_ns
        if not 0 <= trip_ns <= LONGEST_TRIP_NS:
            return False
        sample = ClockOffset(boot_ns - (asked_ns + received_ns) // 2, trip_ns // 2)
        known = self.offset(received_ns)
        if known is not None:
            difference_ns = abs(known.offset_ns - sample.offset_ns)
            if difference_ns > known.error_ns + sample.error_ns + 1_000_000:
                self.reset()  # the clock jumped or restarted
        self._samples.append((received_ns, sample))
        while received_ns - self._samples[0][0] > KEPT_S * 1e9:
            self._samples.popleft()
        return True

    def offset(self, now_ns: int) -> ClockOffset | None:
        """Return the best offset; None before the first reply and when the last is too old."""
        best: ClockOffset | None = None
        for when_ns, sample in self._samples:
            age_ns = now_ns - when_ns
            error_ns = sample.error_ns + round(age_ns * DRIFT)
            if age_ns <= KEPT_S * 1e9 and (best is None or error_ns < best.error_ns):
                best = ClockOffset(sample.offset_ns, error_ns)
        return best

    def stamp(self, boot_ms: int, arrived_ns: int) -> int:
        """Convert a message's `boot_ms` to CLOCK_MONOTONIC ns; its arrival while the offset is unknown.

        Never later than the arrival. A stamp that contradicts the offset resets it.
        """
        known = self.offset(arrived_ns)
        if known is None:
            return arrived_ns
        # Whole milliseconds are truncated, not rounded.
        stamp_ns = boot_ms * 1_000_000 + 500_000 - known.offset_ns
        late_ns = arrived_ns - stamp_ns
        if not -known.error_ns - 1_000_000 <= late_ns <= WRONG_CLOCK_NS:
            self.reset()
            return arrived_ns
        return min(stamp_ns, arrived_ns)


class SenderDelay:
    """Delay of the messages of one sender beyond its minimum, by stamps of the sender's own clock.

    Receipt minus stamp is the unknown offset of the two clocks plus the delay. Its minimum over the last
    minute belongs to the least delayed message.
    """

    def __init__(self) -> None:
        self._began_ns: int | None = None
        self._least_ns = self._least_before_ns = 0

    def update(self, stamp_ns: int, receipt_ns: int) -> int:
        """Add a message; returns its additional delay, nanoseconds."""
        difference_ns = receipt_ns - stamp_ns
        if self._began_ns is None:
            self._began_ns, self._least_ns, self._least_before_ns = receipt_ns, difference_ns, difference_ns
        elif receipt_ns - self._began_ns > _WINDOW_NS:
            self._began_ns, self._least_before_ns, self._least_ns = receipt_ns, self._least_ns, difference_ns
        self._least_ns = min(self._least_ns, difference_ns)
        return difference_ns - min(self._least_ns, self._least_before_ns)
