"""Which frames are looked at: every N-th, so many a second, none that is too old. Each other is counted."""

from __future__ import annotations

from dataclasses import dataclass

from vision.frame import Frame

EVERY, RATE, TOO_OLD = "every", "rate", "too_old"
"""Why a frame was not looked at: not its turn, sooner than asked for, captured too long ago."""


@dataclass(frozen=True, slots=True)
class Selection:
    """What is asked for.

    Attributes:
        every: look at every N-th frame that was read.
        rate_hz: look at no more than so many a second, by their capture stamps; None: as they come.
        max_age_s: do not look at what was captured longer ago; None: look at everything.
    """

    every: int = 1
    rate_hz: float | None = None
    max_age_s: float | None = None

    def __post_init__(self) -> None:
        if self.every < 1:
            raise ValueError(f"every must be at least 1, got {self.every}")
        for name in ("rate_hz", "max_age_s"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ValueError(f"{name} must be above 0, got {value}")


class FrameSelector:
    """Says frame by frame whether to look at it, and counts what is left out.

    Attributes:
        frames_skipped: reason → frames so far.
    """

    def __init__(self, selection: Selection) -> None:
        self._selection = selection
        self._read = 0
        self._due_ns = 0
        self.frames_skipped = {EVERY: 0, RATE: 0, TOO_OLD: 0}

    def look_at(self, frame: Frame, now_ns: int) -> bool:
        """Whether to look at this frame, picked up at `now_ns` of CLOCK_MONOTONIC."""
        reason = self._reason_against(frame, now_ns)
        self._read += 1
        if reason is not None:
            self.frames_skipped[reason] += 1
            return False
        return True

    def _reason_against(self, frame: Frame, now_ns: int) -> str | None:
        asked = self._selection
        if self._read % asked.every:
            return EVERY
        if asked.max_age_s is not None and now_ns - frame.captured_ns > asked.max_age_s * 1e9:
            return TOO_OLD
        if asked.rate_hz is not None:
            period_ns = round(1e9 / asked.rate_hz)
            # Frames jitter: one that comes a quarter of a period early is the one that was due.
            if frame.captured_ns < self._due_ns - period_ns // 4:
                return RATE
            # From the due time on, so that the rate holds on average; after a gap, from this frame on.
            next_ns = self._due_ns + period_ns
            self._due_ns = next_ns if next_ns > frame.captured_ns else frame.captured_ns + period_ns
        return None
