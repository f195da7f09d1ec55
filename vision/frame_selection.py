"""Which frames are processed: those up to a rate. The others are counted."""

from __future__ import annotations

from vision.frame import Frame


class FrameSelector:
    """Decides for each frame whether to process it, and counts the skipped ones.

    Args:
        rate_hz: at most this many a second, by capture stamp; None: all.

    Attributes:
        skipped: frames so far.

    Raises:
        ValueError: `rate_hz` is not above 0.
    """

    def __init__(self, rate_hz: float | None = None) -> None:
        if rate_hz is not None and not rate_hz > 0:
            raise ValueError(f"rate_hz must be above 0, got {rate_hz}")
        self._period_ns = None if rate_hz is None else round(1e9 / rate_hz)
        self._due_ns = 0
        self.skipped = 0

    def accept(self, frame: Frame) -> bool:
        """Whether to process this frame."""
        if self._period_ns is None:
            return True
        # Frames jitter: one that arrives up to a quarter of a period early is the one that was due.
        if frame.captured_ns < self._due_ns - self._period_ns // 4:
            self.skipped += 1
            return False
        # Counted from the due time, so that the rate holds on average; after a gap, from this frame.
        next_ns = self._due_ns + self._period_ns
        self._due_ns = next_ns if next_ns > frame.captured_ns else frame.captured_ns + self._period_ns
        return True
