"""When what ended by itself is started again: soon at first, then every 30 s, without end."""

from __future__ import annotations

from dataclasses import dataclass

SOON_S = (0.2, 1.0, 2.0, 4.0, 8.0)
LATER_S = 30.0
# What lasted so long had no fault from its beginning.
LASTED_S = 30.0
# The same reason again is reported with every so many tries that are not soon.
_REPORTED_TRIES = 10


@dataclass(frozen=True, slots=True)
class Restart:
    """The next start.

    Attributes:
        pause_s: until then, seconds. count: of ends since it last lasted.
        reported: whether to report the end: it is a new one, or was not reported for several tries.
    """

    pause_s: float
    count: int
    reported: bool = True

    @property
    def later(self) -> bool:
        """Whether starting soon did not help."""
        return self.count > len(SOON_S)

    def __str__(self) -> str:
        if self.later:
            return f"tried again every {LATER_S:g} s, {self.count} failures so far"
        return f"restarting ({self.count} of {len(SOON_S)})"


class Restarts:
    """Counts the ends of one program or task.

    >>> restarts = Restarts()
    >>> [restarts.after(lasted_s=1.0).pause_s for _ in range(7)]
    [0.2, 1.0, 2.0, 4.0, 8.0, 30.0, 30.0]
    >>> str(restarts.after(lasted_s=100.0))
    'restarting (1 of 5)'
    """

    def __init__(self) -> None:
        self._count = 0
        self._reported = ("", 0)

    def after(self, lasted_s: float, reason: str = "") -> Restart:
        """Return the next start of what has ended after `lasted_s` seconds, for a reason."""
        self._count = count = 1 if lasted_s >= LASTED_S else self._count + 1
        if count <= len(SOON_S):
            return Restart(SOON_S[count - 1], count)
        before, reported_count = self._reported
        reported = reason != before or not 0 <= count - reported_count < _REPORTED_TRIES
        if reported:
            self._reported = (reason, count)
        return Restart(LATER_S, count, reported)
