"""The correlation filters: position, size, and the ratio that shows a loss."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from vision.tracking.correlation_filter import Box, CorrelationFilter

Image = NDArray[np.uint8]
GROUND = cv2.GaussianBlur(np.random.default_rng(3).integers(0, 255, (480, 640), np.uint8), (0, 0), 3)
THING = cv2.GaussianBlur(np.random.default_rng(4).integers(0, 255, (256, 256), np.uint8), (0, 0), 8)
THING = cv2.normalize(THING, None, 0, 255, cv2.NORM_MINMAX)  # type: ignore[call-overload]


def image(x: float, y: float, width: float, height: float) -> Image:
    """The thing around a centre, on the ground."""
    back = np.array([[width / 256, 0, x - width / 2], [0, height / 256, y - height / 2]])
    size = (640, 480)
    drawn = cv2.warpAffine(THING, back, size)
    mask = cv2.warpAffine(np.full_like(THING, 255), back, size) > 127
    return np.where(mask, drawn, GROUND).astype(np.uint8)


def box(x: float, y: float, width: float, height: float) -> Box:
    return x - width / 2, y - height / 2, x + width / 2, y + height / 2


@pytest.mark.parametrize(("width", "height"), [(20.0, 20.0), (60.0, 40.0), (24.0, 70.0), (300.0, 200.0)])
def test_follows_a_moving_rectangle(width: float, height: float) -> None:
    follower = CorrelationFilter(image(300, 240, width, height), box(300, 240, width, height))
    at = box(300, 240, width, height)
    for number in range(1, 20):
        x, y = 300 + 0.3 * width * math.sin(number / 4), 240 + 0.2 * height * math.sin(number / 3)
        match = follower.search(image(x, y, width, height), at)
        follower.learn()
        at = match.box
        assert match.ratio > 12.0
        assert at == pytest.approx(box(x, y, width, height), abs=0.07 * max(width, height))


@pytest.mark.parametrize("growth", [1.02, 0.98])
def test_follows_a_rectangle_that_changes_its_size(growth: float) -> None:
    side = 60.0
    follower, at = CorrelationFilter(image(320, 240, side, side), box(320, 240, side, side)), None
    at = box(320, 240, side, side)
    for _ in range(40):
        side *= growth
        at = follower.search(image(320, 240, side, side), at).box
        follower.learn()
    assert at[2] - at[0] == pytest.approx(side, rel=0.1)


def test_ratio_is_low_where_the_rectangle_is_gone() -> None:
    follower = CorrelationFilter(image(300, 240, 50, 50), box(300, 240, 50, 50))
    there = follower.search(image(304, 238, 50, 50), box(300, 240, 50, 50)).ratio
    assert there > 15.0
    # The ground around it is still there.
    assert follower.search(image(100, 100, 50, 50), box(300, 240, 50, 50)).ratio < 0.5 * there


def test_search_alone_learns_nothing() -> None:
    follower = CorrelationFilter(image(300, 240, 50, 50), box(300, 240, 50, 50))
    before = follower.search(image(302, 240, 50, 50), box(300, 240, 50, 50))
    follower.search(image(100, 100, 50, 50), box(300, 240, 50, 50))
    assert follower.search(image(302, 240, 50, 50), box(300, 240, 50, 50)) == before


def test_rectangle_at_the_edge_of_the_image_is_followed() -> None:
    at = box(620, 460, 60, 60)
    follower = CorrelationFilter(image(620, 460, 60, 60), at)
    assert follower.search(image(612, 452, 60, 60), at).box == pytest.approx(box(612, 452, 60, 60), abs=4.0)
