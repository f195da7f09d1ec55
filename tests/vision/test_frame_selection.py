"""Which frames are processed, and why the others are skipped."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from vision.frame import Frame
from vision.frame_selection import FrameSelector

IMAGE = np.zeros((4, 6, 3), np.uint8)
MS = 1_000_000


def frame(captured_ms: float, sequence: int = 0) -> Frame:
    return Frame(IMAGE, round(captured_ms * MS), sequence)


def looked_at(rate_hz: float | None, captured_ms: list[float]) -> tuple[list[int], FrameSelector]:
    selector = FrameSelector(rate_hz)
    stamps = enumerate(captured_ms)
    return [index for index, stamp_ms in stamps if selector.accept(frame(stamp_ms, index))], selector


def test_rate_holds_on_average_at_any_camera_rate() -> None:
    thirty = [1000 + index * 1000 / 30 for index in range(300)]
    chosen, selector = looked_at(8, thirty)
    assert 78 <= len(chosen) <= 82
    assert selector.skipped == 300 - len(chosen)


def test_jitter_drops_nothing_at_the_requested_rate() -> None:
    jitter = np.random.default_rng(0).uniform(-8, 8, 200)
    stamps = [1000 + index * 100 + float(offset) for index, offset in enumerate(jitter)]
    chosen, _ = looked_at(10, stamps)
    assert len(chosen) == 200


def test_rate_restarts_after_a_gap_without_catching_up() -> None:
    stamps = [0.0, 100.0, *(5000.0 + index * 10 for index in range(50))]
    chosen, _ = looked_at(10, stamps)
    assert len([index for index in chosen if index >= 2]) <= 6


@given(
    rate_hz=st.none() | st.floats(0.5, 100),
    gaps_ms=st.lists(st.floats(0, 500), min_size=1, max_size=80),
)
def test_every_frame_is_accepted_or_counted_once(rate_hz: float | None, gaps_ms: list[float]) -> None:
    stamps = list(np.cumsum(gaps_ms))
    chosen, selector = looked_at(rate_hz, stamps)
    assert len(chosen) + selector.skipped == len(stamps)
    assert chosen[0] == 0
