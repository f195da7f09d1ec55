"""What of the queries on the command key is a command at all: size, text and rate, judged before the loop.

A refused query is answered on zenoh's thread: it costs the loop that flies nothing, however many come.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

LARGEST_COMMAND_BYTES = 160 * 1024
"""A line, and for a mission its file."""
COMMANDS_PER_S, BURST = 20.0, 40
"""Of all senders together; zenoh does not tell who asks. `stop` has an allowance of its own, as large."""
ALWAYS_HEARD = b"stop"


class CommandIntake:
    """Says of each query why it is not taken. Called from any thread.

    Args:
        clock_s: seconds that never go back.

    Attributes:
        refused: how many were not taken.
    """

    def __init__(self, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._others, self._stops = _Allowance(clock_s), _Allowance(clock_s)
        self._lock = threading.Lock()
        self.refused = 0

    def read(self, size: int, payload: Callable[[], bytes]) -> tuple[str | None, str]:
        """The command's text, or None and why it is not taken.

        Args:
            size: of the payload, bytes. payload: called only where the size is allowed.
        """
        if size > LARGEST_COMMAND_BYTES:
            why = f"it is {size} bytes long; {LARGEST_COMMAND_BYTES} are taken at most"
            return self._refuse(why)
        data = payload()
        with self._lock:
            allowance = self._stops if data.strip().lower() == ALWAYS_HEARD else self._others
            taken = allowance.take()
        if not taken:
            return self._refuse(f"more than {COMMANDS_PER_S:g} commands a second came; send it again later")
        try:
            return data.decode("utf-8"), ""
        except UnicodeDecodeError as error:
            return self._refuse(f"it is not UTF-8 text: byte {error.start} is 0x{data[error.start]:02x}")

    def _refuse(self, why: str) -> tuple[None, str]:
        with self._lock:
            self.refused += 1
        return None, f"the command was not taken: {why}"


class _Allowance:
    """A token bucket."""

    def __init__(self, clock_s: Callable[[], float]) -> None:
        self._clock_s, self._tokens, self._filled_s = clock_s, float(BURST), clock_s()

    def take(self) -> bool:
        now_s = self._clock_s()
        self._tokens = min(float(BURST), self._tokens + COMMANDS_PER_S * (now_s - self._filled_s))
        self._filled_s = now_s
        if self._tokens < 1.0:
            return False
        self._tokens -= 1.0
        return True
