"""Data types of tracking."""

from __future__ import annotations

import pickle
import statistics

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vision.tracking import Track, TrackEvent, TrackEventKind, TrackState
from vision.tracking.tracks import SCORES_KEPT, ScoreHistory


@given(st.lists(st.floats(0, 1), min_size=1, max_size=3 * SCORES_KEPT))
def test_the_median_is_that_of_the_newest_confidences(confidences: list[float]) -> None:
    scores = ScoreHistory()
    for confidence in confidences:
        scores.add(confidence)
    assert scores.median == pytest.approx(statistics.median(confidences[-SCORES_KEPT:]))


def test_median_without_confidences_is_zero() -> None:
    assert ScoreHistory().median == 0.0


def test_an_event_survives_pickling() -> None:
    track = Track(3, 1, "car", TrackState.CONFIRMED, (1.0, 2.0, 3.0, 4.0), 0.8, 0.7, 5, 100, 200)
    event = TrackEvent(TrackEventKind.LOST, 300, track)
    assert pickle.loads(pickle.dumps(event)) == event
