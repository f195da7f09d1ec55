"""Checks the queries on the command key before they reach the loop: size, text and rate.

A refused query is answered on zenoh's thread, so it costs the guidance loop nothing.
"""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Callable

from companion.bus.command_order import is_stop
from companion.host.peer_data import Payload, PeerDataError, copy_payload

LARGEST_COMMAND_BYTES = 160 * 1024
"""A line, and for a mission its file."""
COMMANDS_PER_S, BURST = 20.0, 40
"""Of each sender. `stop` has a separate allowance of the same size.

zenoh does not identify the sender of a query. It states itself in the query's attachment, as
`companion.bus.client` does; all without one count as one sender. Identifiers may be invented, so all senders
together have `ALL_SENDERS` times as much.
"""
ALL_SENDERS = 5
MAX_SENDERS = 32
"""Senders that are counted; of more, the one that was silent for the longest time is forgotten."""
MAX_SENDER_BYTES = 64
"""Longer identifiers count as none."""


class CommandIntake:
    """Accepts or refuses queries. Called from any thread.

    Args:
        clock_s: a monotonic clock, seconds.

    Attributes:
        refused: number of refused queries.
    """

    def __init__(self, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._others, self._stops = _Senders(clock_s), _Senders(clock_s)
        self._lock = threading.Lock()
        self.refused = 0

    def read(self, payload: Payload, sender: bytes = b"") -> tuple[str | None, str]:
        """Return the command's text, or None and why it is refused.

        Args:
            payload: copied only if its size is allowed.
            sender: as it states itself; empty if it does not.
        """
        try:
            data = copy_payload(payload, LARGEST_COMMAND_BYTES)
        except PeerDataError as error:
            return self._refuse(str(error))
        with self._lock:
            allowance = self._stops if is_stop(data.decode(errors="replace")) else self._others
            accepted = allowance.take(sender)
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


class _Senders:
    """The allowance of each sender, and of all together."""

    def __init__(self, clock_s: Callable[[], float]) -> None:
        self._clock_s = clock_s
        self._all = Allowance(ALL_SENDERS * COMMANDS_PER_S, ALL_SENDERS * BURST, clock_s)
        self._each: OrderedDict[bytes, Allowance] = OrderedDict()

    def take(self, sender: bytes) -> bool:
        """Whether one more of this sender is allowed now."""
        allowance = self._each.setdefault(sender, Allowance(clock_s=self._clock_s))
        self._each.move_to_end(sender)
        if len(self._each) > MAX_SENDERS:
            self._each.popitem(last=False)
        return allowance.take() and self._all.take()


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
