"""Checks the queries on the command key before they reach the loop: size, text and rate.

A refused query is answered on zenoh's thread, so it costs the guidance loop nothing.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

LARGEST_COMMAND_BYTES = 160 * 1024
"""A line, and for a mission its file."""
COMMANDS_PER_S, BURST = 20.0, 40
"""Of all senders together; zenoh does not identify them. `stop` has a separate allowance of the same size."""
SEPARATE_ALLOWANCE = b"stop"


class CommandIntake:
    """Accepts or refuses queries. Called from any thread.

    Args:
        clock_s: a monotonic clock, seconds.

    Attributes:
        refused: number of refused queries.
    """

    def __init__(self, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._others, self._stops = Allowance(clock_s=clock_s), Allowance(clock_s=clock_s)
        self._lock = threading.Lock()
        self.refused = 0

    def read(self, size: int, payload: Callable[[], bytes]) -> tuple[str | None, str]:
        """Return the command's text, or None and the reason of the refusal.

        Args:
            size: of the payload, bytes. payload: called only if the size is allowed.
        """
        if size > LARGEST_COMMAND_BYTES:
            return self._refuse(f"{size} bytes, at most {LARGEST_COMMAND_BYTES} are accepted")
        data = payload()
        with self._lock:
            allowance = self._stops if data.strip().lower() == SEPARATE_ALLOWANCE else self._others
            accepted = allowance.take()
        if not accepted:
            return self._refuse(f"more than {COMMANDS_PER_S:g} commands a second; send it again later")
        try:
            return data.decode("utf-8"), ""
        except UnicodeDecodeError as error:
            return self._refuse(f"not UTF-8 text: byte {error.start} is 0x{data[error.start]:02x}")

    def _refuse(self, reason: str) -> tuple[None, str]:
        with self._lock:
            self.refused += 1
        return None, f"command refused: {reason}"


class Allowance:
    """A token bucket: `per_s`, and `burst` at once."""

    def __init__(
        self, per_s: float = COMMANDS_PER_S, burst: int = BURST, clock_s: Callable[[], float] = time.monotonic
    ) -> None:
        self._per_s, self._burst, self._clock_s = per_s, float(burst), clock_s
        self._tokens, self._filled_s = self._burst, clock_s()

    def take(self) -> bool:
        """Whether one more is allowed now."""
        now_s = self._clock_s()
        self._tokens = min(self._burst, self._tokens + self._per_s * (now_s - self._filled_s))
        self._filled_s = now_s
        if self._tokens < 1.0:
            return False
        self._tokens -= 1.0
        return True
