"""Formation slots: offsets, assignment, motion."""

from __future__ import annotations

import itertools
import math
from random import Random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.geometry.formation import (
    SHAPES,
    Vector3,
    assign,
    least_cost,
    radius_m,
    rotate,
    slot_motion,
    slots,
)

coordinate = st.floats(-100, 100)
position = st.tuples(coordinate, coordinate, st.floats(-5, 5))


@given(st.sampled_from(SHAPES), st.integers(0, 60), st.floats(0.5, 50), st.booleans())
def test_slots_keep_the_spacing_to_each_other_and_the_leader(
    shape: str, count: int, spacing: float, taken: bool
) -> None:
    offsets = slots(shape, count, spacing, centre_taken=taken)
    assert len(offsets) == count
    occupied = [*offsets, (0.0, 0.0, 0.0)] if taken else offsets
    for a, b in itertools.combinations(occupied, 2):
        assert math.dist(a, b) >= spacing * (1 - 1e-9)


def test_slot_offsets_of_each_shape() -> None:
    assert slots("line", 3, 5.0) == [(0, 5, 0), (0, -5, 0), (0, 10, 0)]
    assert slots("column", 2, 4.0) == [(-4, 0, 0), (-8, 0, 0)]
    right, left = slots("wedge", 2, math.sqrt(8.0))
    assert right == pytest.approx((-2, 2, 0))
    assert left == pytest.approx((-2, -2, 0))
    assert slots("circle", 4, 5.0)[0] == pytest.approx((5.0, 0.0, 0.0))
    assert radius_m(slots("circle", 50, 5.0)) == pytest.approx(5.0 / 2 / math.sin(math.pi / 50))
    assert slots("wedge", 3, 5.0, centre_taken=False)[0] == (0, 0, 0)


@settings(max_examples=150)
@given(st.integers(1, 5).flatmap(lambda n: st.tuples(st.just(n), st.integers(n, 6))), st.randoms())
def test_assignment_has_the_least_cost(size: tuple[int, int], random: Random) -> None:
    rows, columns = size
    cost = np.array(
        [[random.choice((0.0, 1.0, random.uniform(0, 9))) for _ in range(columns)] for _ in range(rows)]
    )
    found = least_cost(cost)
    assert len(set(found)) == rows
    best = min(
        sum(cost[row, column] for row, column in enumerate(columns_of))
        for columns_of in itertools.permutations(range(columns), rows)
    )
    assert sum(cost[row, column] for row, column in enumerate(found)) == pytest.approx(best, abs=1e-9)


@settings(max_examples=60)
@given(st.lists(position, min_size=2, max_size=12, unique=True), st.sampled_from(SHAPES), st.floats(3, 10))
def test_assigned_paths_stay_separated(positions: list[Vector3], shape: str, spacing: float) -> None:
    """At equal fractions of the paths, separation is at least 0.7 of the smaller end separation."""
    offsets = slots(shape, len(positions), spacing)
    taken = assign(positions, offsets)
    goals = [offsets[index] for index in taken]
    for (x, g), (y, h) in itertools.combinations(zip(positions, goals, strict=True), 2):
        least = min(math.dist(x, y), math.dist(g, h)) * math.sqrt(0.5)
        for step in range(21):
            t = step / 20
            here, there = (
                tuple(a + t * (b - a) for a, b in zip(*path, strict=True)) for path in ((x, g), (y, h))
            )
            assert math.dist(here, there) >= least - 1e-6


def test_occupied_slots_are_kept_when_a_vehicle_joins() -> None:
    offsets = slots("wedge", 4, 5.0)
    taken = assign([*offsets[:3], (-30.0, 2.0, 0.0)], offsets)
    assert taken == [0, 1, 2, 3]


def test_nobody_is_assigned_no_slot() -> None:
    assert assign([], []) == []


@given(position, st.floats(-3, 3), st.floats(-1, 1), position)
def test_slot_velocity_is_the_derivative_of_its_position(
    velocity: Vector3, heading: float, rate: float, offset: Vector3
) -> None:
    dt = 1e-5
    leader = (1.0, 2.0, -5.0)
    start, moving = slot_motion(leader, velocity, heading, rate, offset)
    north, east, down = (p + dt * v for p, v in zip(leader, velocity, strict=True))
    end, _ = slot_motion((north, east, down), velocity, heading + rate * dt, rate, offset)
    for a, b, v in zip(start, end, moving, strict=True):
        assert (b - a) / dt == pytest.approx(v, abs=1e-2)


def test_offsets_rotate_with_the_heading() -> None:
    assert rotate((1.0, 0.0, 2.0), math.pi / 2) == pytest.approx((0.0, 1.0, 2.0))
    assert rotate((0.0, 1.0, 0.0), math.pi / 2) == pytest.approx((-1.0, 0.0, 0.0))
