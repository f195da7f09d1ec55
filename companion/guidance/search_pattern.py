"""Ways that bring a camera over a whole area: the expanding square and the parallel track.

Both are those of the International Aeronautical and Maritime Search and Rescue Manual (IAMSAR, volume II,
chapter 5). Metres north and east of the middle of the area; what lies half a spacing beside the way is seen.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

# Neighbouring strips overlap by a fifth: gusts carry the vehicle about, and boxes at the edge are cut.
OVERLAP = 0.2
# Farther than this a camera that looks to the horizon is not counted on to see an object.
FARTHEST_M = 25.0
NARROWEST_M = 1.0
# What a camera sees across at least, where nobody says what it does.
NARROW_FIELD_RAD = math.radians(40.0)


@dataclass(frozen=True, slots=True)
class Footprint:
    """What a camera sees of the ground.

    Attributes:
        horizontal_fov_rad: from its left edge to its right.
        depression_rad: of its axis below the horizon, with the vehicle level.
    """

    horizontal_fov_rad: float
    depression_rad: float

    def spacing_m(self, height_m: float) -> float:
        """How far apart strips may be, flown at a height above flat ground."""
        down = math.sin(self.depression_rad)
        range_m = min(FARTHEST_M, height_m / down) if down > 0.0 else FARTHEST_M
        width_m = 2.0 * range_m * math.tan(self.horizontal_fov_rad / 2.0)
        return max(NARROWEST_M, (1.0 - OVERLAP) * width_m)


def expanding_square(radius_m: float, spacing_m: float) -> list[tuple[float, float]]:
    """From the middle outwards, over the square whose sides are `2 · radius_m` long."""
    north = east = 0.0
    points = [(north, east)]
    rings = max(0, math.ceil((radius_m - spacing_m / 2.0) / spacing_m - 1e-9))
    # One leg more than two of each length: the last ring is closed.
    lengths = [leg // 2 + 1 for leg in range(4 * rings)] + ([2 * rings] if rings else [])
    for turn, length in enumerate(lengths):
        ahead = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[turn % 4]
        north += ahead[0] * length * spacing_m
        east += ahead[1] * length * spacing_m
        points.append((north, east))
    return points


def lawnmower(width_m: float, height_m: float, spacing_m: float) -> list[tuple[float, float]]:
    """To and fro along the longer side of an area: `width_m` west to east, `height_m` south to north."""
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
    """What the steering camera sees across, radians; NARROW_FIELD_RAD where that is not known."""
    return NARROW_FIELD_RAD if footprint is None else footprint.horizontal_fov_rad
