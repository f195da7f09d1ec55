"""The detections value: slices, records, tracks and pickling."""

from __future__ import annotations

import copy
import dataclasses
import pickle
from typing import Any

import numpy as np
import pytest

from vision.detections import NO_TRACK, Detections


def three(**tracks: Any) -> Detections:
    return Detections(
        np.arange(12, dtype=np.float32).reshape(3, 4),
        np.array([0.9, 0.5, 0.2], np.float32),
        np.array([0, 1, 1]),
        ("person", "car"),
        np.array([[0.1, 0.2, 1.0], [np.nan] * 3, [0.3, 0.4, 3.0]], np.float32),
        middle_px=np.array([1.5, np.nan, 9.25], np.float32),
        **tracks,
    )


def tracked() -> Detections:
    return three(
        track_id=np.array([4, NO_TRACK, 9]),
        track_score=np.array([0.8, np.nan, 0.3], np.float32),
        track_confirmed=np.array([True, False, False]),
        track_first_ns=np.array([1, 2, 0]),
    )


@pytest.mark.parametrize(
    "index", [slice(1, 3), np.array([False, True, True]), np.array([1, 2])], ids=["slice", "mask", "indices"]
)
def test_slice_keeps_all_fields(index: Any) -> None:
    part = tracked()[index]
    assert part.names == ["car", "car"]
    assert part.track_id is not None
    assert part.track_id.tolist() == [NO_TRACK, 9]
    assert part.track_confirmed is not None
    assert part.track_confirmed.tolist() == [False, False]
    assert part.records() == tracked().records()[1:]
    untracked = three()[index]
    assert untracked.track_id is None
    assert untracked.track_score is None
    assert untracked.track_confirmed is None


def test_records_contain_the_middle_where_it_is_known() -> None:
    assert [record.get("middle_px") for record in three()] == [1.5, None, 9.25]


def test_records_contain_the_track_fields() -> None:
    tracks = [(r["track_id"], r["track_score"], r["track_state"]) for r in tracked()]
    assert tracks == [(4, 0.8, "confirmed"), (None, None, "none"), (9, 0.3, "tentative")]
    assert {(r["track_id"], r["track_score"], r["track_state"]) for r in three()} == {(None, None, None)}


@pytest.mark.parametrize(
    "detections",
    [three(), tracked(), tracked()[:0], tracked()[::2], Detections.empty(("person", "car"))],
    ids=["without tracks", "with tracks", "none left of some", "every other", "none"],
)
@pytest.mark.parametrize("copied", [lambda it: pickle.loads(pickle.dumps(it, 5)), copy.deepcopy])
def test_detections_survive_pickling(detections: Detections, copied: Any) -> None:
    again = copied(detections)
    for field in dataclasses.fields(Detections):
        before, after = getattr(detections, field.name), getattr(again, field.name)
        if isinstance(before, np.ndarray):
            np.testing.assert_array_equal(after, before)
            assert (after.dtype, after.shape) == (before.dtype, before.shape)
            assert after.flags.writeable
        else:
            assert after == before
