"""The autopilot's boot clock against ours, by TIMESYNC (https://mavlink.io/en/services/timesync.html).

A question and its answer take a way of unknown shares, so half of the round trip is how wrong the middle can
be: the shortest trip of the last seconds tells most (the minimum filter of D. Mills' NTP, RFC 5905, §10).
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

KEPT_S = 10.0
# Two quartz clocks: 50 ppm each is more than any flight controller's data sheet allows.
DRIFT = 100e-6
# A slower answer says no more than the arrival of messages does; a radio of 57600 baud needs 0.2 s.
LONGEST_TRIP_NS = 500_000_000
# A stamp so far from its arrival is of another clock, not of a slow link.
WRONG_CLOCK_NS = 2_000_000_000


@dataclass(frozen=True, slots=True)
class ClockOffset:
    """What to subtract from a boot stamp to have ours, and how far that may be off, nanoseconds."""

    offset_ns: int
    error_ns: int


class ClockSync:
    """Learns the offset from questions and answers; forgets it when the autopilot's clock jumps.

    A simulated autopilot that runs faster or slower than time jumps all the while: its messages then bear
    their arrival.
    """

    def __init__(self) -> None:
        self._samples: deque[tuple[int, ClockOffset]] = deque()  # (when, what), CLOCK_MONOTONIC ns

    def forget(self) -> None:
        """The autopilot's clock is not the one it was."""
        self._samples.clear()

    def answer(self, asked_ns: int, boot_ns: int, received_ns: int) -> bool:
        """Take an answer: asked and received by our clock, answered at `boot_ns` by the autopilot's.

        Returns:
            False if it is of no use: it was on its way for too long, or not after the question.
        """
        trip_ns = received_ns - asked_ns
        if not 0 <= trip_ns <= LONGEST_TRIP_NS:
            return False
        sample = ClockOffset(boot_ns - (asked_ns + received_ns) // 2, trip_ns // 2)
        known = self.offset(received_ns)
        if known is not None:
            apart_ns = abs(known.offset_ns - sample.offset_ns)
            if apart_ns > known.error_ns + sample.error_ns + 1_000_000:
                self.forget()  # it jumped, or began anew
        self._samples.append((received_ns, sample))
        while received_ns - self._samples[0][0] > KEPT_S * 1e9:
            self._samples.popleft()
        return True

    def offset(self, now_ns: int) -> ClockOffset | None:
        """The best that is known; None before the first answer and when the last is too old."""
        best: ClockOffset | None = None
        for when_ns, sample in self._samples:
            age_ns = now_ns - when_ns
            error_ns = sample.error_ns + round(age_ns * DRIFT)
            if age_ns <= KEPT_S * 1e9 and (best is None or error_ns < best.error_ns):
                best = ClockOffset(sample.offset_ns, error_ns)
        return best

    def stamp(self, boot_ms: int, arrived_ns: int) -> int:
        """When a message stamped `boot_ms` was true, by our clock; its arrival while the offset is unknown.

        Never later than the arrival. A stamp that makes no sense by what is known of the clock forgets that.
        """
        known = self.offset(arrived_ns)
        if known is None:
            return arrived_ns
        # A stamp in whole milliseconds was cut, not rounded.
        stamp_ns = boot_ms * 1_000_000 + 500_000 - known.offset_ns
        late_ns = arrived_ns - stamp_ns
        if not -known.error_ns - 1_000_000 <= late_ns <= WRONG_CLOCK_NS:
            self.forget()
            return arrived_ns
        return min(stamp_ns, arrived_ns)
