"""The metrics, on sequences small enough to count by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from benchmarks.clear_mot import Labelled, MotScore, clear_mot

Frame = tuple[dict[int, float], dict[int, float]]


def score(*frames: Frame) -> MotScore:
    """Score of frames given as the x of each identity's box of 10 by 10 pixels."""
    return clear_mot((labelled(truth), labelled(tracked)) for truth, tracked in frames)


def labelled(positions: dict[int, float]) -> Labelled:
    boxes = np.array([[x, 0, x + 10, 10] for x in positions.values()], np.float64).reshape(-1, 4)
    return Labelled(list(positions), boxes)


def test_perfect_tracking_scores_one() -> None:
    result = score(({1: 0, 2: 50}, {7: 0, 8: 51}), ({1: 1, 2: 50}, {7: 1, 8: 50}))
    assert result.mota == result.idf1 == 1.0
    assert (result.objects, result.frames) == (4, 2)
    assert result.misses == result.false_positives == result.switches == result.fragmentations == 0
    assert result.iou == pytest.approx((3 + 9 / 11) / 4)


def test_misses_and_false_positives_are_counted_each_frame() -> None:
    result = score(({1: 0}, {}), ({1: 0}, {7: 0, 8: 100}), ({1: 0}, {7: 0, 8: 100}))
    assert (result.misses, result.false_positives) == (1, 2)
    assert result.mota == pytest.approx(0.0)


def test_a_new_identity_is_one_switch_however_long_it_stays() -> None:
    result = score(({1: 0}, {7: 0}), ({1: 0}, {8: 0}), ({1: 0}, {8: 0}))
    assert (result.switches, result.fragmentations) == (1, 0)
    assert result.mota == pytest.approx(2 / 3)
    assert result.idf1 == pytest.approx(2 / 3)


def test_a_swap_of_two_is_two_switches() -> None:
    assert score(({1: 0, 2: 50}, {7: 0, 8: 50}), ({1: 0, 2: 50}, {8: 0, 7: 50})).switches == 2


def test_gap_is_a_fragmentation_and_maybe_a_switch() -> None:
    same = score(({1: 0}, {7: 0}), ({1: 0}, {}), ({1: 0}, {7: 0}))
    other = score(({1: 0}, {7: 0}), ({1: 0}, {}), ({1: 0}, {8: 0}))
    assert (same.fragmentations, same.switches) == (1, 0)
    assert (other.fragmentations, other.switches) == (1, 1)


def test_absent_object_is_not_fragmented() -> None:
    result = score(({1: 0}, {7: 0}), ({}, {}), ({1: 0}, {7: 0}))
    assert (result.fragmentations, result.misses) == (0, 0)


def test_existing_pair_is_kept_over_a_better_one() -> None:
    result = score(({1: 0}, {7: 0}), ({1: 0}, {7: 2, 8: 0}))
    assert (result.switches, result.false_positives) == (0, 1)


def test_as_many_as_possible_are_paired() -> None:
    # 7 matches both, 8 matches only the first.
    result = score(({1: 0, 2: 4}, {7: 1, 8: -3}))
    assert (result.misses, result.false_positives) == (0, 0)


def test_box_with_low_iou_matches_nothing() -> None:
    result = score(({1: 0}, {7: 4}))
    assert (result.misses, result.false_positives) == (1, 1)
    assert math.isnan(result.iou)


def test_empty_sequence_has_no_score() -> None:
    result = score(({}, {}))
    assert math.isnan(result.mota)
    assert math.isnan(result.idf1)
    assert score(({}, {7: 0})).idf1 == 0.0


def test_score_as_plain_values() -> None:
    values = score(({1: 0}, {7: 0})).as_dict()
    assert values["mota"] == 1.0
    assert values["objects"] == 1
