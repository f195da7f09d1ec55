"""Warns of a behaviour whose update is slow.

While an update blocks, nothing is sent, and the autopilot's failsafe acts.
"""

from __future__ import annotations

from collections.abc import Callable

from companion.host.load import busy_text

# A longer step delays the setpoints of the 50 Hz stream: processor time, and wall-clock time (larger, because
# other programs may have the processor).
SLOW_STEP_NS, STALLED_STEP_NS = 5_000_000, 50_000_000
# Minimum interval of this warning for one behaviour.
SLOW_AGAIN_NS = 10_000_000_000


class SlowUpdates:
    """Reports the steps of guidance that took too long. `on_event`: called with (level, text)."""

    def __init__(self, on_event: Callable[[str, str], None]) -> None:
        self._on_event = on_event
        self._newest: tuple[str, int] = ("", 0)

    def update(self, behaviour: str, used_ns: int, passed_ns: int, now_ns: int) -> None:
        """Report a step if it was slow.

        Args:
            behaviour: its name. used_ns: processor time. passed_ns: on the clock.
        """
        if used_ns < SLOW_STEP_NS and passed_ns < STALLED_STEP_NS:
            return
        last, warned_ns = self._newest
        if behaviour != last or now_ns - warned_ns >= SLOW_AGAIN_NS:
            self._newest = (behaviour, now_ns)
            text = f"{used_ns / 1e6:.0f} ms of processor time, {passed_ns / 1e6:.0f} ms elapsed"
            # Its own processor time is not the fault of others.
            why = busy_text() if used_ns < SLOW_STEP_NS else ""
            self._on_event("warning", f"{behaviour}: slow update ({text}); expected at most 5 ms{why}")
