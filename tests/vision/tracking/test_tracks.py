"""Data types of tracking."""

from __future__ import annotations

import pickle
import statistics

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vision.tracking import Track, TrackerSettings, TrackEvent, TrackEventKind, TrackState
from vision.tracking.tracks import SCORES_KEPT, ScoreHistory


@given(st.lists(st.floats(0, 1), min_size=1, max_size=3 * SCORES_KEPT))
def test_the_median_is_that_of_the_newest_confidences(confidences: list[float]) -> None:
    scores = ScoreHistory()
    for confidence in confidences:
        scores.add(confidence)
    assert scores.median == pytest.approx(statistics.median(confidences[-SCORES_KEPT:]))


def test_median_without_confidences_is_zero() -> None:
    assert ScoreHistory().median == 0.0


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"low_confidence": 0.5, "high_confidence": 0.4}, "got 0.5 and 0.4"),
        ({"high_confidence": 1.5}, "must be 0 to 1"),
        ({"confirm_score": -0.1}, "confirm_score .*got -0.1"),
        ({"keep_confidence": 2.0}, "keep_confidence .*got 2"),
        ({"min_iou": float("nan")}, "min_iou .*got nan"),
        ({"min_hits": 0}, "min_hits .*got 0"),
        ({"coast_timeout_s": 0.0}, "coast_timeout_s"),
        ({"coast_timeout_s": 3.0, "max_age_s": 2.0}, "max_age_s, got 3 and 2"),
    ],
)
def test_contradictory_settings_are_rejected(bad: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        TrackerSettings(**bad)  # type: ignore[arg-type]


def test_an_event_survives_pickling() -> None:
    track = Track(3, 1, "car", TrackState.CONFIRMED, (1.0, 2.0, 3.0, 4.0), 0.8, 0.7, 5, 100, 200)
    event = TrackEvent(TrackEventKind.LOST, 300, track)
    assert pickle.loads(pickle.dumps(event)) == event
