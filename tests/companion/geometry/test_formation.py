"""Slots, their assignment and their motion."""

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
    slot_motion,
    slots,
    turned,
)

coordinate = st.floats(-100, 100)
place = st.tuples(coordinate, coordinate, st.floats(-5, 5))


@given(st.sampled_from(SHAPES), st.integers(0, 60), st.floats(0.5, 50), st.booleans())
def test_no_two_slots_are_nearer_than_the_spacing_nor_one_to_the_leader(
    shape: str, count: int, spacing: float, taken: bool
) -> None:
    offsets = slots(shape, count, spacing, centre_taken=taken)
    assert len(offsets) == count
    occupied = [*offsets, (0.0, 0.0, 0.0)] if taken else offsets
    for a, b in itertools.combinations(occupied, 2):
        assert math.dist(a, b) >= spacing * (1 - 1e-9)


def test_the_shapes_look_as_they_are_called() -> None:
    assert slots("line", 3, 5.0) == [(0, 5, 0), (0, -5, 0), (0, 10, 0)]
    assert slots("column", 2, 4.0) == [(-4, 0, 0), (-8, 0, 0)]
    right, left = slots("wedge", 2, math.sqrt(8.0))
    assert right == pytest.approx((-2, 2, 0))
    assert left == pytest.approx((-2, -2, 0))
    assert slots("circle", 4, 5.0)[0] == pytest.approx((5.0, 0.0, 0.0))
    assert radius_m(slots("circle", 50, 5.0)) == pytest.approx(5.0 / 2 / math.sin(math.pi / 50))
    assert slots("wedge", 3, 5.0, centre_taken=False)[0] == (0, 0, 0)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("star", 3, 5.0), "shape must be one of line, column, wedge, circle, got 'star'"),
        (("line", -1, 5.0), "0 slots or more"),
        (("line", 3, 0.0), "spacing_m must be finite and above 0"),
        (("line", 3, math.nan), "spacing_m must be finite"),
    ],
)
def test_what_is_no_formation_is_refused(arguments: tuple[str, int, float], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        slots(*arguments)


@settings(max_examples=150)
@given(st.integers(1, 5).flatmap(lambda n: st.tuples(st.just(n), st.integers(n, 6))), st.randoms())
def test_the_assignment_costs_least_of_all(size: tuple[int, int], random: Random) -> None:
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
@given(st.lists(place, min_size=2, max_size=12, unique=True), st.sampled_from(SHAPES), st.floats(3, 10))
def test_on_the_way_to_their_slots_vehicles_stay_apart(
    places: list[Vector3], shape: str, spacing: float
) -> None:
    """At the same share of their ways, never nearer than 0.7 of the nearest two at either end."""
    offsets = slots(shape, len(places), spacing)
    taken = assign(places, offsets)
    goals = [offsets[index] for index in taken]
    for (x, g), (y, h) in itertools.combinations(zip(places, goals, strict=True), 2):
        least = min(math.dist(x, y), math.dist(g, h)) * math.sqrt(0.5)
        for step in range(21):
            t = step / 20
            here, there = (
                tuple(a + t * (b - a) for a, b in zip(*way, strict=True)) for way in ((x, g), (y, h))
            )
            assert math.dist(here, there) >= least - 1e-6


def test_who_is_in_a_slot_keeps_it_when_one_more_comes() -> None:
    offsets = slots("wedge", 4, 5.0)
    taken = assign([*offsets[:3], (-30.0, 2.0, 0.0)], offsets)
    assert taken == [0, 1, 2, 3]


def test_fewer_slots_than_vehicles_and_places_that_are_none_are_refused() -> None:
    with pytest.raises(ValueError, match="2 vehicles need as many slots, got 1"):
        assign([(0, 0, 0), (1, 0, 0)], [(0, 0, 0)])
    with pytest.raises(ValueError, match="finite"):
        assign([(math.nan, 0, 0)], [(0, 0, 0)])
    assert assign([], []) == []


@given(place, st.floats(-3, 3), st.floats(-1, 1), place)
def test_the_velocity_of_a_slot_is_the_change_of_its_place(
    velocity: Vector3, heading: float, rate: float, offset: Vector3
) -> None:
    dt = 1e-5
    leader = (1.0, 2.0, -5.0)
    start, moving = slot_motion(leader, velocity, heading, rate, offset)
    north, east, down = (p + dt * v for p, v in zip(leader, velocity, strict=True))
    end, _ = slot_motion((north, east, down), velocity, heading + rate * dt, rate, offset)
    for a, b, v in zip(start, end, moving, strict=True):
        assert (b - a) / dt == pytest.approx(v, abs=1e-2)


def test_offsets_turn_with_the_heading() -> None:
    assert turned((1.0, 0.0, 2.0), math.pi / 2) == pytest.approx((0.0, 1.0, 2.0))
    assert turned((0.0, 1.0, 0.0), math.pi / 2) == pytest.approx((-1.0, 0.0, 0.0))
