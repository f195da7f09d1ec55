"""Rows of points as people write them."""

from __future__ import annotations

import math


def points_from(text: str) -> tuple[tuple[float, ...], ...]:
    """Points from `north,east[,height]`, parted by spaces or semicolons.

    Raises:
        ValueError: a line that names the point that is none.
    """
    points = []
    for word in text.replace(";", " ").split():
        try:
            point = tuple(float(value) for value in word.split(","))
        except ValueError:
            point = ()
        if len(point) not in (2, 3) or not all(map(math.isfinite, point)):
            raise ValueError(f"a point is north,east or north,east,height in metres, got {word!r}")
        points.append(point)
    return tuple(points)
