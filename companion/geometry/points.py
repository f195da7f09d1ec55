"""Parser for lists of points in commands and settings."""

from __future__ import annotations

import math


def points_from(text: str) -> tuple[tuple[float, ...], ...]:
    """Parse points `north,east[,height]` (metres), separated by spaces or semicolons.

    Raises:
        ValueError: the text contains something else; the message names it.
    """
    points = []
    for word in text.replace(";", " ").split():
        try:
            point = tuple(float(value) for value in word.split(","))
        except ValueError:
            point = ()
        if len(point) not in (2, 3) or not all(map(math.isfinite, point)):
            raise ValueError(f"a point must be north,east or north,east,height in metres, got {word!r}")
        points.append(point)
    return tuple(points)
