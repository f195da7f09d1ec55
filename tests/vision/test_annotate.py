"""Drawing: what must appear in the image, and what must not change."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from vision.annotate import NOT_LEVEL, annotate, annotate_level, class_colour
from vision.detections import NO_TRACK, Detections
from vision.frame import Frame

NAMES = ("person", "bicycle", "car")


def seen(
    boxes: list[list[float]], class_ids: list[int] | None = None, depths_m: list[float] | None = None
) -> Detections:
    count = len(boxes)
    return Detections(
        np.array(boxes, np.float32).reshape(-1, 4),
        np.linspace(0.9, 0.4, count, dtype=np.float32),
        np.array(class_ids or [2] * count, np.int64),
        NAMES,
        np.array([[0.0, 0.0, depth_m] for depth_m in depths_m or [np.nan] * count], np.float32).reshape(
            -1, 3
        ),
    )


def make_image(width: int = 640, height: int = 480, value: int = 90) -> np.ndarray:
    return np.full((height, width, 3), value, np.uint8)


def changed(before: np.ndarray, after: np.ndarray) -> tuple[int, int, int, int]:
    """Left, top, right, bottom of the changed area."""
    rows, columns = np.nonzero((before != after).any(axis=2))
    return int(columns.min()), int(rows.min()), int(columns.max()), int(rows.max())


def test_input_image_is_not_modified() -> None:
    image = make_image()
    before = image.copy()
    drawn = annotate(image, seen([[100, 100, 300, 200]]), lines=["hello"], highlight=0)
    np.testing.assert_array_equal(image, before)
    assert drawn.shape == image.shape
    assert drawn.dtype == np.uint8
    assert (drawn != image).any()


def test_no_detections_and_lines_draw_nothing() -> None:
    image = make_image()
    np.testing.assert_array_equal(annotate(image, Detections.empty(NAMES)), image)


def test_box_is_drawn_in_its_class_colour() -> None:
    drawn = annotate(make_image(), seen([[100, 150, 300, 250]]))
    for x, y in ((100, 200), (300, 200), (200, 250)):
        assert tuple(int(value) for value in drawn[y, x]) == class_colour(2)
    assert tuple(drawn[200, 200]) == (90, 90, 90)


def test_the_range_makes_the_label_longer() -> None:
    box = [[100.0, 150.0, 120.0, 170.0]]
    without = changed(make_image(), annotate(make_image(), seen(box)))
    with_range = changed(make_image(), annotate(make_image(), seen(box, depths_m=[12.3])))
    assert with_range[2] > without[2]


def test_lines_are_drawn_on_a_translucent_panel() -> None:
    image = make_image(value=200)
    drawn = annotate(image, Detections.empty(NAMES), lines=["OFFBOARD", "1.5 m/s"])
    left, top, right, bottom = changed(image, drawn)
    assert right < 320
    assert bottom < 240
    backdrop = drawn[top + 1, left + 1]
    assert (backdrop > 60).all()
    assert (backdrop < 130).all()
    assert (drawn[top:bottom, left:right] > 220).any()  # letters


def test_long_line_is_scaled_not_cut() -> None:
    image = make_image(320, 240)
    drawn = annotate(image, Detections.empty(NAMES), lines=["a very long line " * 6])
    left, _, right, _ = changed(image, drawn)
    assert left > 0
    assert right < 319


def test_drawing_scales_with_the_image() -> None:
    small, large = make_image(320, 240), make_image(1920, 1440)
    _, top, _, bottom = changed(small, annotate(small, Detections.empty(NAMES), lines=["x"]))
    _, large_top, _, large_bottom = changed(large, annotate(large, Detections.empty(NAMES), lines=["x"]))
    assert large_bottom - large_top > 3 * (bottom - top)


def test_highlighted_detection_looks_different() -> None:
    image = make_image()
    boxes = seen([[100, 150, 200, 250], [300, 150, 400, 250]])
    plain, marked = annotate(image, boxes), annotate(image, boxes, highlight=1)
    assert (plain[200, 350] != marked[200, 350]).any()
    np.testing.assert_array_equal(plain[200, 150], marked[200, 150])


def test_labels_of_neighbours_do_not_hide_each_other() -> None:
    image = make_image()
    boxes = [[200.0, 200.0, 240.0, 260.0], [215.0, 200.0, 255.0, 260.0]]
    alone = [annotate(image, seen([box])) for box in boxes]
    colour = np.array(class_colour(2))
    areas = [int((drawn == colour).all(axis=2).sum()) for drawn in alone]
    together = int((annotate(image, seen(boxes)) == colour).all(axis=2).sum())
    assert together > 0.9 * sum(areas)


def test_label_marks_unconfirmed_tracks() -> None:
    image = make_image()
    plain = seen([[200, 200, 240, 260]])

    def plate(track_id: int, confirmed: bool) -> int:
        tracked = replace(
            plain,
            track_id=np.array([track_id]),
            track_score=np.array([0.5], np.float32),
            track_confirmed=np.array([confirmed]),
        )
        left, _, right, _ = changed(image, annotate(image, tracked))
        return right - left

    without = plate(NO_TRACK, False)
    assert without < plate(7, True) < plate(7, False) < plate(7777, False)
    left, _, right, _ = changed(image, annotate(image, plain))
    assert right - left == without


def test_neighbouring_classes_have_colours_far_apart() -> None:
    colours = np.array([class_colour(index) for index in range(12)], float)
    for one, other in itertools.pairwise(colours):
        assert np.abs(one - other).max() > 80


@settings(max_examples=80, deadline=None)
@given(
    st.integers(1, 200),
    st.integers(1, 200),
    arrays.arrays(np.float32, (3, 4), elements=st.floats(-300, 500, width=32)),
    st.lists(st.text(max_size=30), max_size=4),
    st.sampled_from([None, 0, 2]),
)
def test_any_box_and_text_can_be_drawn(
    width: int, height: int, boxes: np.ndarray, lines: list[str], highlight: int | None
) -> None:
    drawn = annotate(make_image(width, height), seen(boxes.tolist()), lines=lines, highlight=highlight)
    assert drawn.shape == (height, width, 3)


def test_depth_at_the_centre_is_a_red_point_and_a_number() -> None:
    image = make_image()
    drawn = annotate(image, seen([]), centre_m=3.42)
    assert drawn[240, 320].tolist() == [0, 0, 255]
    left, top, right, bottom = changed(image, drawn)
    assert 310 <= left < 320
    assert top > 225
    assert bottom < 260
    assert 350 < right < 420  # the number is to the right of the point
    unknown = annotate(image, seen([]), centre_m=float("nan"))
    assert unknown[240, 320].tolist() == [0, 0, 255]
    assert (unknown != drawn).any()
    np.testing.assert_array_equal(annotate(image, seen([])), image)


def test_boxes_are_levelled_with_the_image_and_lines_are_not() -> None:
    frame, boxes = Frame(make_image(), 1, 0), seen([[100, 200, 200, 300]])
    lines = ("height 5.0 m",)

    def level(levelled: Frame, image: np.ndarray) -> np.ndarray:
        assert levelled is frame
        return np.ascontiguousarray(image[::-1])

    drawn = annotate_level(frame, boxes, level, lines=lines)
    expected = annotate(annotate(frame.image, boxes)[::-1].copy(), seen([]), lines=lines)
    assert np.array_equal(drawn, expected)


def test_image_that_cannot_be_levelled_says_so() -> None:
    frame, boxes = Frame(make_image(), 1, 0), seen([[300, 200, 400, 300]])
    drawn = annotate_level(frame, boxes, lambda frame, image: None, lines=("a",))
    assert np.array_equal(drawn, annotate(annotate(frame.image, boxes), seen([]), lines=("a", NOT_LEVEL)))
    assert np.array_equal(annotate_level(frame, boxes, None), annotate(frame.image, boxes))
