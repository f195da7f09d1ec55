"""The assignment compared with every permutation; the matching compared with every pairing."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from vision.tracking.association import assign, enlarge, match, overlaps

# Integers too: ties are the difficult case of shortest paths.
costs = arrays.arrays(
    np.float64,
    st.tuples(st.integers(0, 5), st.integers(0, 5)),
    elements=st.one_of(st.integers(-3, 3).map(float), st.floats(-100, 100)),
)
likenesses = arrays.arrays(
    np.float64,
    st.tuples(st.integers(0, 4), st.integers(0, 4)),
    elements=st.one_of(st.sampled_from([0.0, 0.2, 0.5, 1.0]), st.floats(0, 1)),
)
boxes = arrays.arrays(np.float64, st.tuples(st.integers(0, 4), st.just(4)), elements=st.floats(-50, 50))


def cheapest(cost: np.ndarray) -> float:
    wide = cost if cost.shape[0] <= cost.shape[1] else cost.T
    rows = range(wide.shape[0])
    cost_of_best: float = min(
        sum(wide[row, column] for row, column in zip(rows, columns, strict=True))
        for columns in itertools.permutations(range(wide.shape[1]), wide.shape[0])
    )
    return cost_of_best


@settings(max_examples=150)
@given(costs)
def test_no_assignment_is_cheaper(cost: np.ndarray) -> None:
    pairs = assign(cost)
    assert len(pairs) == min(cost.shape)
    assert len({row for row, _ in pairs}) == len({column for _, column in pairs}) == len(pairs)
    assert pairs == sorted(pairs)
    assert sum(cost[pair] for pair in pairs) == pytest.approx(cheapest(cost), abs=1e-9)


def test_large_assignment_is_optimal_under_swaps() -> None:
    cost = np.random.default_rng(3).random((60, 75))
    pairs = assign(cost)
    assert [row for row, _ in pairs] == list(range(60))
    for (row, column), (other_row, other_column) in itertools.combinations(pairs, 2):
        kept = cost[row, column] + cost[other_row, other_column]
        assert kept <= cost[row, other_column] + cost[other_row, column] + 1e-12


def best_gain(gain: np.ndarray) -> float:
    """The best gain over every pairing of rows with columns, unpaired ones included."""
    if not gain.size:
        return 0.0
    alone = best_gain(gain[1:])
    with_one = [
        gain[0, column] + best_gain(np.delete(gain[1:], column, axis=1)) for column in range(gain.shape[1])
    ]
    return float(max(alone, *with_one))


@settings(max_examples=150)
@given(likenesses, st.sampled_from([0.0, 0.2, 0.45]))
def test_match_maximises_the_gain(likeness: np.ndarray, least: float) -> None:
    pairs = match(likeness, least)
    assert all(likeness[pair] > least for pair in pairs)
    assert len({row for row, _ in pairs}) == len({column for _, column in pairs}) == len(pairs)
    assert sum(likeness[pair] - least for pair in pairs) == pytest.approx(best_gain(likeness - least))


def test_two_good_pairs_come_before_one_that_is_best() -> None:
    likeness = np.array([[0.9, 0.8], [0.85, 0.0]])
    assert match(likeness, 0.2) == [(0, 1), (1, 0)]


def test_separate_groups_are_independent() -> None:
    likeness = np.zeros((5, 5))
    likeness[:2, 3:] = [[0.9, 0.8], [0.85, 0.3]]
    likeness[3:, :2] = [[0.5, 0.6], [0.7, 0.3]]
    assert match(likeness, 0.2) == [(0, 4), (1, 3), (3, 1), (4, 0)]


def test_overlap_is_of_areas() -> None:
    first = np.array([[0, 0, 10, 10], [0, 0, 0, 0]])
    second = np.array([[5, 0, 15, 10], [20, 20, 30, 30], [0, 0, 10, 10]])
    np.testing.assert_allclose(overlaps(first, second), [[1 / 3, 0.0, 1.0], [0.0, 0.0, 0.0]])


@given(boxes, boxes)
def test_overlap_is_bounded_and_symmetric(one: np.ndarray, other: np.ndarray) -> None:
    iou = overlaps(one, other)
    assert iou.shape == (len(one), len(other))
    assert ((iou >= 0) & (iou <= 1 + 1e-12)).all()
    np.testing.assert_allclose(iou, overlaps(other, one).T)


def test_enlarged_box_grows_by_a_share_of_its_size() -> None:
    np.testing.assert_allclose(enlarge(np.array([[10, 10, 26, 74]]), 0.5), [[-6, -6, 42, 90]])
    np.testing.assert_allclose(enlarge(np.array([[10, 10, 26, 74]]), 0.0), [[10, 10, 26, 74]])
