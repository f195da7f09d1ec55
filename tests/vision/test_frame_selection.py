"""Which frames are processed, and why the others are skipped."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vision.frame import Frame
from vision.frame_selection import FrameSelector, Selection

IMAGE = np.zeros((4, 6, 3), np.uint8)
MS = 1_000_000


def frame(captured_ms: float, sequence: int = 0) -> Frame:
    return Frame(IMAGE, round(captured_ms * MS), sequence)


def looked_at(
    selection: Selection, captured_ms: list[float], late_ms: float = 0.0
) -> tuple[list[int], FrameSelector]:
    selector = FrameSelector(selection)
    chosen = [
        index
        for index, stamp_ms in enumerate(captured_ms)
        if selector.accept(frame(stamp_ms, index), round((stamp_ms + late_ms) * MS))
    ]
    return chosen, selector


def test_rate_holds_on_average_at_any_camera_rate() -> None:
    thirty = [1000 + index * 1000 / 30 for index in range(300)]
    chosen, selector = looked_at(Selection(rate_hz=8), thirty)
    assert 78 <= len(chosen) <= 82
    assert selector.frames_skipped["rate"] == 300 - len(chosen)


def test_jitter_drops_nothing_at_the_requested_rate() -> None:
    jitter = np.random.default_rng(0).uniform(-8, 8, 200)
    stamps = [1000 + index * 100 + float(offset) for index, offset in enumerate(jitter)]
    chosen, _ = looked_at(Selection(rate_hz=10), stamps)
    assert len(chosen) == 200


def test_rate_restarts_after_a_gap_without_catching_up() -> None:
    stamps = [0.0, 100.0, *(5000.0 + index * 10 for index in range(50))]
    chosen, _ = looked_at(Selection(rate_hz=10), stamps)
    assert len([index for index in chosen if index >= 2]) <= 6


def test_frame_too_old_on_arrival_is_skipped() -> None:
    chosen, selector = looked_at(Selection(max_age_s=0.2), [0, 100, 200], late_ms=250)
    assert chosen == []
    assert selector.frames_skipped == {"every": 0, "rate": 0, "too_old": 3}


@given(
    every=st.integers(1, 7),
    rate_hz=st.none() | st.floats(0.5, 100),
    gaps_ms=st.lists(st.floats(0, 500), min_size=1, max_size=80),
)
def test_every_frame_is_accepted_or_counted_once(
    every: int, rate_hz: float | None, gaps_ms: list[float]
) -> None:
    stamps = list(np.cumsum(gaps_ms))
    chosen, selector = looked_at(Selection(every=every, rate_hz=rate_hz), stamps)
    assert len(chosen) + sum(selector.frames_skipped.values()) == len(stamps)
    assert all(index % every == 0 for index in chosen)


@pytest.mark.parametrize("bad", [{"every": 0}, {"rate_hz": 0.0}, {"max_age_s": -1.0}])
def test_invalid_settings_are_rejected_by_name(bad: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(bad))):
        Selection(**bad)  # type: ignore[arg-type]
