"""How long a perception worker may be silent before it counts as stuck."""

from __future__ import annotations

import statistics
from collections import deque

# Loading torch and a large model from a cold card. What the source may take to open comes on top.
START_S = 90.0
# The first inference is slow, and nothing is known yet of how long one takes here.
FIRST_RESULT_S = 30.0
# From then on: so many times what is usual here, but not less and not more than these.
USUAL_STEPS, SHORTEST_S, LONGEST_S = 20.0, 3.0, 30.0


class Watchdog:
    """Listens for one worker's messages. Times are seconds of any one monotonic clock."""

    def __init__(self, now_s: float, open_timeout_s: float) -> None:
        """`open_timeout_s`: what the source may take to open."""
        self._heard_s = now_s
        self._limit_s = START_S + open_timeout_s
        self._steps_s: deque[float] = deque(maxlen=50)

    def ready(self) -> None:
        """The worker has loaded and opened everything."""
        self._limit_s = FIRST_RESULT_S

    def heard(self, now_s: float) -> None:
        """A message of any kind came."""
        self._heard_s = now_s

    def resulted(self, step_s: float) -> None:
        """The message was a result that took so long to make: the worker is silent no longer than that."""
        self._steps_s.append(step_s)
        usual_s = statistics.median(self._steps_s)
        self._limit_s = min(max(USUAL_STEPS * usual_s, SHORTEST_S), LONGEST_S)

    def forgive(self, now_s: float) -> None:
        """We did not listen until now, so nobody can be blamed for silence."""
        self._heard_s = now_s

    @property
    def stuck_after_s(self) -> float:
        """The silence that counts as stuck, at this stage."""
        return self._limit_s

    def silent_s(self, now_s: float) -> float:
        """Since when nothing came."""
        return now_s - self._heard_s
