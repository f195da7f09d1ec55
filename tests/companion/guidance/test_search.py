"""The patterns of a search cover their area."""

import math
from collections.abc import Sequence
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.guidance.search_pattern import Footprint, expanding_square, lawnmower


def beside(point: tuple[float, float], points: Sequence[tuple[float, float]]) -> float:
    """Chebyshev distance of a point from a polyline."""
    nearest = max(abs(p - q) for p, q in zip(point, points[0], strict=True))
    for start, end in pairwise(points):
        # Legs are north or east: the nearest point is computed per axis.
        near = [min(max(p, min(a, b)), max(a, b)) for p, a, b in zip(point, start, end, strict=True)]
        nearest = min(nearest, max(abs(p - q) for p, q in zip(point, near, strict=True)))
    return nearest


unit = st.floats(-1.0, 1.0)


@given(st.floats(1, 100), st.floats(2, 40), unit, unit)
def test_square_covers_its_area_within_half_a_spacing(
    radius: float, spacing: float, north: float, east: float
) -> None:
    points = expanding_square(radius, spacing)
    assert beside((north * radius, east * radius), points) <= spacing / 2 + 1e-6
    assert all(max(map(abs, point)) <= radius + spacing / 2 + 1e-6 for point in points)


@given(st.floats(1, 200), st.floats(1, 200), st.floats(2, 40), unit, unit)
def test_lawnmower_covers_its_area_within_half_a_spacing(
    width: float, height: float, spacing: float, north: float, east: float
) -> None:
    points = lawnmower(width, height, spacing)
    assert beside((north * height / 2, east * width / 2), points) <= spacing / 2 + 1e-6
    assert all(abs(p[0]) <= height / 2 + 1e-9 and abs(p[1]) <= width / 2 + 1e-9 for p in points)


@settings(max_examples=30)
@given(st.floats(0.2, 2.5), st.floats(-0.5, 1.5), st.floats(1, 60))
def test_spacing_is_less_than_the_footprint(fov: float, depression: float, height: float) -> None:
    spacing = Footprint(fov, depression).spacing_m(height)
    assert 1.0 <= spacing <= max(1.0, 2 * 25.0 * math.tan(fov / 2))
    assert Footprint(fov, depression).spacing_m(height * 2) >= spacing


def test_steep_camera_needs_narrow_strips() -> None:
    down = Footprint(math.radians(80), math.radians(90)).spacing_m(10.0)
    assert down == pytest.approx(0.8 * 2 * 10 * math.tan(math.radians(40)))
    assert Footprint(math.radians(80), 0.0).spacing_m(10.0) == pytest.approx(
        0.8 * 2 * 25 * math.tan(math.radians(40))
    )
