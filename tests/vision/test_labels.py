"""Labels of boxes: none covers another, and each has a place as long as there is space."""

from __future__ import annotations

import itertools

from hypothesis import given, settings
from hypothesis import strategies as st

from vision.labels import MOST_LABELS, Rectangle, place_label

IMAGE = (64, 48)
coordinate = st.integers(-5, 70)


def boxes(count: int) -> st.SearchStrategy[list[Rectangle]]:
    def ordered(value: tuple[int, int, int, int]) -> Rectangle:
        left, right = sorted((min(max(value[0], 0), 63), min(max(value[2], 0), 63)))
        top, bottom = sorted((min(max(value[1], 0), 47), min(max(value[3], 0), 47)))
        return left, top, right, bottom

    one = st.tuples(coordinate, coordinate, coordinate, coordinate).map(ordered)
    return st.lists(one, min_size=1, max_size=count)


def overlapping(one: Rectangle, other: Rectangle) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


def has_room(size: tuple[int, int], occupied: list[Rectangle]) -> bool:
    """By trying every pixel."""
    across, down = range(IMAGE[0] - size[0] + 1), range(IMAGE[1] - size[1] + 1)
    return any(
        not any(overlapping((x, y, x + size[0], y + size[1]), other) for other in occupied)
        for x, y in itertools.product(across, down)
    )


@settings(max_examples=150, deadline=None)
@given(boxes(25), st.integers(3, 30), st.integers(3, 12))
def test_no_label_covers_another_while_there_is_room(found: list[Rectangle], width: int, height: int) -> None:
    placed: list[Rectangle] = []
    for box in found:
        label = place_label(box, (width, height), IMAGE, placed)
        if label is None:
            assert not has_room((width, height), placed)
            continue
        assert (label[2] - label[0], label[3] - label[1]) == (width, height)
        assert label[0] >= 0
        assert label[1] >= 0
        assert label[2] <= IMAGE[0]
        assert label[3] <= IMAGE[1]
        assert not any(overlapping(label, other) for other in placed)
        placed.append(label)


def test_label_is_above_its_box_where_that_is_free() -> None:
    assert place_label((10, 20, 60, 40), (20, 6), IMAGE, []) == (9, 14, 29, 20)
    near = place_label((10, 20, 60, 40), (20, 6), IMAGE, [(0, 14, 64, 20)])
    assert near == (9, 20, 29, 26)


def test_no_more_labels_than_a_person_reads() -> None:
    occupied = [(0, 0, 1, 1)] * MOST_LABELS
    assert place_label((10, 20, 30, 40), (5, 5), IMAGE, occupied) is None
    assert place_label((10, 20, 30, 40), (65, 5), IMAGE, []) is None
