"""Decides how long a perception worker may be silent before it is stuck."""

from __future__ import annotations

import statistics
from collections import deque

# Loading torch and a large model from a cold card. The source's open timeout is added.
START_S = 90.0
# The first inference is slow, and the usual duration is not known yet.
FIRST_RESULT_S = 30.0
# From then on: a multiple of the usual step, within these bounds.
USUAL_STEPS, SHORTEST_S, LONGEST_S = 20.0, 3.0, 30.0


class Watchdog:
    """Monitors one worker's messages. Times are seconds of one monotonic clock."""

    def __init__(self, now_s: float, open_timeout_s: float) -> None:
        """`open_timeout_s`: how long the source may take to open."""
        self._message_s = now_s
        self._limit_s = START_S + open_timeout_s
        self._steps_s: deque[float] = deque(maxlen=50)

    def ready(self) -> None:
        """Note that the worker has loaded and opened everything."""
        self._limit_s = FIRST_RESULT_S

    def on_message(self, now_s: float) -> None:
        """Note a message of any kind."""
        self._message_s = now_s

    def on_result(self, step_s: float) -> None:
        """Note a result and its processing time: the limit follows the usual time."""
        self._steps_s.append(step_s)
        usual_s = statistics.median(self._steps_s)
        self._limit_s = min(max(USUAL_STEPS * usual_s, SHORTEST_S), LONGEST_S)

    def reset(self, now_s: float) -> None:
        """Restart the silence: messages could not be read until now."""
        self._message_s = now_s

    @property
    def stuck_after_s(self) -> float:
        """The present limit of silence."""
        return self._limit_s

    def silent_s(self, now_s: float) -> float:
        """Time since the last message."""
        return now_s - self._message_s
