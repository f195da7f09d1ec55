"""Detects that the computer or this process stood still, so that nothing from before takes effect afterwards.

CLOCK_MONOTONIC, and with it every timer of asyncio, stands still while the computer is suspended;
CLOCK_BOOTTIME goes on. So a step between the two is a suspend, during which everything has aged unseen: by
CLOCK_MONOTONIC a setpoint, a position or a request from before is as fresh as it was. A process that was
stopped (SIGSTOP), or whose loop was blocked, sees both clocks go on, and is detected by the time since the
last step of the loop that steers.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

# A suspend this short changes no age by more than the lifetime of a setpoint.
SUSPENDED_S = 0.3
# After a longer pause of the loop what was decided or received before is too old. Where setpoints are sent, a
# shorter one ends our command (`companion.vehicle.streamer`). A busy computer may cause one of a second.
PAUSED_S = 3.0
# What waited in this computer's buffers arrives at once. Linux repeats a TCP segment after 120 s at most.
BUFFERED_S, LATEST_S = 1.0, 120.0
_BOOTTIME = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)


def boottime_ns() -> int:
    """Return CLOCK_BOOTTIME, nanoseconds."""
    return time.clock_gettime_ns(_BOOTTIME)


def unix_offset_ns() -> int:
    """Return the system clock minus CLOCK_MONOTONIC, nanoseconds. It changes where that clock is set."""
    # A delay between the two readings makes the difference smaller.
    return max(time.time_ns() - time.monotonic_ns() for _ in range(3))


@dataclass(frozen=True, slots=True)
class Standstill:
    """The computer or this process stood still.

    Attributes:
        why: in words. seconds: for how long.
        suspended: the computer did, and its network: a sender's TCP repeats what was not received, after a
            time that doubles, so it may arrive as long after the end as the suspend lasted.
    """

    why: str
    seconds: float
    suspended: bool = False

    @property
    def long(self) -> bool:
        """Whether a command that arrives now may have been given too long ago."""
        return self.seconds > PAUSED_S

    @property
    def late_commands_s(self) -> float:
        """How long after its end commands from before it may arrive, seconds."""
        return min(max(self.seconds, BUFFERED_S), LATEST_S) if self.suspended else BUFFERED_S


@dataclass(frozen=True, slots=True)
class Observation:
    """What `StandstillWatch.observe` found.

    Attributes:
        boottime_ns: when. offset_ns: CLOCK_BOOTTIME minus CLOCK_MONOTONIC.
        standstill: since the last acknowledged observation; None: none.
    """

    boottime_ns: int
    offset_ns: int
    standstill: Standstill | None


class StandstillWatch:
    """Watches both clocks and the loop that steers.

    That loop observes at the begin of every step, and acknowledges at its end, when it has ended what was
    active before. Until then nothing that moves the vehicle may be sent, whichever task runs first.

    Args:
        boottime_ns, monotonic_ns: read the two clocks.

    >>> boot, monotonic = [5], [5]
    >>> watch = StandstillWatch(lambda: boot[0], lambda: monotonic[0])
    >>> boot[0] += 42_000_000_000
    >>> seen = watch.observe()
    >>> seen.standstill.why
    'the computer was suspended for 42.0 s'
    >>> watch.acknowledge(seen)
    >>> watch.observe().standstill is None
    True
    """

    def __init__(
        self,
        boottime_ns: Callable[[], int] = boottime_ns,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._boottime_ns, self._monotonic_ns = boottime_ns, monotonic_ns
        self._offset_ns = self._offset()
        self._stepped_ns: int | None = None

    def now_ns(self) -> int:
        """Return CLOCK_MONOTONIC plus the time suspended since the last step, nanoseconds.

        Ages by it count a suspend, as those of CLOCK_BOOTTIME do. It is comparable with CLOCK_MONOTONIC, and
        may step back to it at an acknowledgement.
        """
        return self._boottime_ns() - self._offset_ns

    def observe(self) -> Observation:
        """Return what stood still since the last acknowledged observation."""
        offset_ns, now_ns = self._offset(), self._boottime_ns()
        suspended_s = (offset_ns - self._offset_ns) / 1e9
        paused_s = 0.0 if self._stepped_ns is None else (now_ns - self._stepped_ns) / 1e9
        standstill = None
        if suspended_s > SUSPENDED_S:
            why = f"the computer was suspended for {suspended_s:.1f} s"
            standstill = Standstill(why, suspended_s, suspended=True)
        elif paused_s > PAUSED_S:
            why = f"guidance loop paused for {paused_s:.1f} s"
            standstill = Standstill(why, paused_s)
        return Observation(now_ns, offset_ns, standstill)

    def acknowledge(self, seen: Observation) -> None:
        """What was active before that observation has ended."""
        self._offset_ns, self._stepped_ns = seen.offset_ns, seen.boottime_ns

    def end_of_loop(self) -> None:
        """No loop steers any more: only a suspend is detected."""
        self._stepped_ns = None

    def _offset(self) -> int:
        # A delay between the two readings makes the difference smaller.
        return max(self._boottime_ns() - self._monotonic_ns() for _ in range(3))
