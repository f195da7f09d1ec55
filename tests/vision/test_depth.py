from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vision.depth import CENTRAL_FRACTION, NEAR_PERCENTILE, range_of_boxes

HEIGHT, WIDTH = 48, 64


def depth_of(background_m: float) -> np.ndarray:
    return np.full((HEIGHT, WIDTH), background_m, np.float32)


def test_the_range_is_that_of_the_object_and_not_of_what_is_behind_it() -> None:
    depth_m = depth_of(30.0)
    depth_m[10:30, 20:40] = 7.0
    # A box a third larger than the object on every side.
    assert range_of_boxes(depth_m, np.array([[13, 3, 47, 37]])) == pytest.approx([7.0])


def test_a_thin_object_is_nearer_than_what_is_seen_through_it() -> None:
    depth_m = depth_of(30.0)
    depth_m[:, 28:32] = 5.0
    assert range_of_boxes(depth_m, np.array([[22, 0, 38, 48]])) == pytest.approx([5.0])


def test_unknown_pixels_do_not_count() -> None:
    depth_m = depth_of(9.0)
    depth_m[::2] = np.nan
    depth_m[1::4] = 0.0
    depth_m[3, :] = np.inf
    assert range_of_boxes(depth_m, np.array([[0, 0, 64, 48]])) == pytest.approx([9.0])


def test_single_wrong_near_pixels_do_not_decide() -> None:
    depth_m = depth_of(12.0)
    depth_m[20:24, 30:34] = 0.3
    assert range_of_boxes(depth_m, np.array([[10, 5, 54, 43]])) == pytest.approx([12.0])


def test_a_box_of_almost_unknown_depth_has_no_range() -> None:
    depth_m = depth_of(np.nan)
    depth_m[24, 32] = 4.0
    assert np.isnan(range_of_boxes(depth_m, np.array([[0, 0, 64, 48]]))).all()


def test_boxes_outside_the_image_or_not_finite_have_no_range() -> None:
    boxes = np.array([[100, 100, 120, 120], [-50, -50, -10, -10], [np.nan, 0, 10, 10], [0, 0, np.inf, 10]])
    assert np.isnan(range_of_boxes(depth_of(5.0), boxes)).all()


def test_no_boxes_give_no_ranges() -> None:
    ranges = range_of_boxes(depth_of(5.0), np.zeros((0, 4), np.float32))
    assert ranges.shape == (0,)
    assert ranges.dtype == np.float32


def test_a_box_of_one_pixel_has_that_pixels_range() -> None:
    depth_m = depth_of(5.0)
    depth_m[7, 9] = 2.5
    assert range_of_boxes(depth_m, np.array([[9.2, 7.2, 9.8, 7.8]])) == pytest.approx([2.5])


corner = st.floats(-100, 200)


@given(st.tuples(corner, corner, corner, corner), st.floats(0.125, 100, width=32))
def test_in_front_of_a_wall_every_box_that_meets_the_image_has_the_walls_range_or_none(
    box: tuple[float, float, float, float], wall_m: float
) -> None:
    (range_m,) = range_of_boxes(depth_of(wall_m), np.array([box]))
    assert np.isnan(range_m) or range_m == pytest.approx(wall_m)
    x, y = (box[0] + box[2]) / 2, (box[1] + box[3]) / 2
    if 0 <= x < WIDTH - 1 and 0 <= y < HEIGHT - 1:
        assert range_m == pytest.approx(wall_m)


@given(st.integers(1, 40), st.integers(0, 2**32 - 1))
def test_it_is_numpys_percentile_of_the_middle(side: int, seed: int) -> None:
    depth = np.random.default_rng(seed).uniform(0.5, 60.0, (side, side)).astype(np.float32)
    box = np.array([[-side / 2, -side / 2, side * 1.5, side * 1.5]])  # the picture is its middle half
    assert CENTRAL_FRACTION == 0.5
    (range_m,) = range_of_boxes(depth, box)
    assert range_m == pytest.approx(np.percentile(depth, NEAR_PERCENTILE), rel=1e-6)
