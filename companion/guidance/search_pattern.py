"""Search patterns that cover an area: expanding square and parallel track (lawnmower).

Both follow the International Aeronautical and Maritime Search and Rescue Manual (IAMSAR, volume II, chapter
5). Metres north and east of the centre of the area; the camera covers half a spacing to either side.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

# Overlap of neighbouring strips: gusts displace the vehicle, and boxes at the image edge are cut.
OVERLAP = 0.2
# Assumed detection range of a camera that looks to the horizon.
FARTHEST_M = 25.0
NARROWEST_M = 1.0
# Assumed horizontal field of view of an unknown camera.
NARROW_FIELD_RAD = math.radians(40.0)


@dataclass(frozen=True, slots=True)
class Footprint:
    """The part of the ground that a camera sees.

    Attributes:
        horizontal_fov_rad: from its left edge to its right.
        depression_rad: of its axis below the horizon, with the vehicle level.
    """

    horizontal_fov_rad: float
    depression_rad: float

    def spacing_m(self, height_m: float) -> float:
        """Spacing of strips at a height above flat ground, metres."""
        down = math.sin(self.depression_rad)
        range_m = min(FARTHEST_M, height_m / down) if down > 0.0 else FARTHEST_M
        width_m = 2.0 * range_m * math.tan(self.horizontal_fov_rad / 2.0)
        return max(NARROWEST_M, (1.0 - OVERLAP) * width_m)


def expanding_square(radius_m: float, spacing_m: float) -> list[tuple[float, float]]:
    """Points from the centre outwards, over the square with sides of `2 · radius_m`."""
    north = east = 0.0
    points = [(north, east)]
    rings = max(0, math.ceil((radius_m - spacing_m / 2.0) / spacing_m - 1e-9))
    # Two legs of each length, and a third of the longest to close the last ring.
    lengths = [leg // 2 + 1 for leg in range(4 * rings)] + ([2 * rings] if rings else [])
    for turn, length in enumerate(lengths):
        ahead = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[turn % 4]
        north += ahead[0] * length * spacing_m
        east += ahead[1] * length * spacing_m
        points.append((north, east))
    return points


def lawnmower(width_m: float, height_m: float, spacing_m: float) -> list[tuple[float, float]]:
    """Points of strips along the longer side: `width_m` is west to east, `height_m` south to north."""
    across_m, along_m = sorted((width_m, height_m))
    count = max(1, math.ceil(across_m / spacing_m - 1e-9))
    points: list[tuple[float, float]] = []
    for strip in range(count):
        beside = across_m * ((strip + 0.5) / count - 0.5)
        ends = [(-along_m / 2.0, beside), (along_m / 2.0, beside)]
        points += ends if strip % 2 == 0 else reversed(ends)
    if height_m >= width_m:
        return points
    return [(beside, along) for along, beside in points]


def field_of_view_rad(footprint: Footprint | None) -> float:
    """Horizontal field of view of the steering camera, radians; NARROW_FIELD_RAD if unknown."""
    return NARROW_FIELD_RAD if footprint is None else footprint.horizontal_fov_rad
