"""Selection of the frames to process: every Nth, up to a rate, up to an age. Skipped frames are counted."""

from __future__ import annotations

from dataclasses import dataclass

from vision.frame import Frame

EVERY, RATE, TOO_OLD = "every", "rate", "too_old"
"""Why a frame was skipped: not an Nth frame, above the rate, captured too long ago."""


@dataclass(frozen=True, slots=True)
class Selection:
    """Which frames to process.

    Attributes:
        every: process every Nth frame read.
        rate_hz: process at most this many per second, by capture stamp; None: no limit.
        max_age_s: skip frames captured longer ago; None: no limit.
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
    """Decides for each frame whether to process it, and counts the skipped ones.

    Attributes:
        frames_skipped: reason → frames so far.
    """

    def __init__(self, selection: Selection) -> None:
        self._selection = selection
        self._read = 0
        self._due_ns = 0
        self.frames_skipped = {EVERY: 0, RATE: 0, TOO_OLD: 0}

    def accept(self, frame: Frame, now_ns: int) -> bool:
        """Whether to process this frame, read at `now_ns` of CLOCK_MONOTONIC."""
        reason = self._skip_reason(frame, now_ns)
        self._read += 1
        if reason is not None:
            self.frames_skipped[reason] += 1
            return False
        return True

    def _skip_reason(self, frame: Frame, now_ns: int) -> str | None:
        selection = self._selection
        if self._read % selection.every:
            return EVERY
        if selection.max_age_s is not None and now_ns - frame.captured_ns > selection.max_age_s * 1e9:
            return TOO_OLD
        if selection.rate_hz is not None:
            period_ns = round(1e9 / selection.rate_hz)
            # Frames jitter: one that arrives up to a quarter of a period early is the one that was due.
            if frame.captured_ns < self._due_ns - period_ns // 4:
                return RATE
            # Counted from the due time, so that the rate holds on average; after a gap, from this frame.
            next_ns = self._due_ns + period_ns
            self._due_ns = next_ns if next_ns > frame.captured_ns else frame.captured_ns + period_ns
        return None
