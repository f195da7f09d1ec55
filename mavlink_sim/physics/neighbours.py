"""The other vehicles of a fleet as the range sensors of one of them measure them: upright ellipsoids.

Everything is NED metres in the world frame.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from mavlink_sim.physics.airframe import Vector
from mavlink_sim.physics.contact import HALF_HEIGHT_M, RADIUS_M
from mavlink_sim.physics.midair import Body

if TYPE_CHECKING:
    from mavlink_sim.world.obstacles import Segment

# A horizontal section has this many sides: an error of 3 mm, where the sensor's is 20.
_CORNERS = [(math.cos(number * math.tau / 24), math.sin(number * math.tau / 24)) for number in range(25)]


class Neighbours:
    """All bodies of a world except one.

    Args:
        bodies: all; may grow later.
        own: the one with the sensor.
    """

    def __init__(self, bodies: Sequence[Body], own: Body) -> None:
        self._bodies = bodies
        self._own = own

    def _others(self) -> Iterator[Vector]:
        """From the own centre to the centre of each other body."""
        x, y, z = self._own.position_ned_m
        for body in self._bodies:
            if body is not self._own:
                north, east, down = body.position_ned_m
                yield north - x, east - y, down - z

    def range_below_m(self) -> float:
        """From the own legs along the own down axis to the first body; inf: none."""
        _, _, x, _, _, y, _, _, z = self._own.airframe.matrix
        found = min((_along(middle, (x, y, z)) for middle in self._others()), default=math.inf)
        return max(found - HALF_HEIGHT_M, 0.0)

    def outlines(self, range_m: float) -> list[Segment]:
        """The horizontal sections of bodies within a range: sides, (north, east) from the own centre."""
        sides: list[Segment] = []
        for north, east, down in self._others():
            if abs(down) >= HALF_HEIGHT_M or math.hypot(north, east) - RADIUS_M > range_m:
                continue
            radius = RADIUS_M * math.sqrt(1.0 - (down / HALF_HEIGHT_M) ** 2)
            corners = [(north + radius * x, east + radius * y) for x, y in _CORNERS]
            sides += itertools.pairwise(corners)
        return sides


def _along(middle: Vector, direction: Vector) -> float:
    """The distance along a unit vector to the ellipsoid around a point; 0 inside it, inf without a hit."""
    x, y, z = middle[0] / RADIUS_M, middle[1] / RADIUS_M, middle[2] / HALF_HEIGHT_M
    dx, dy, dz = direction[0] / RADIUS_M, direction[1] / RADIUS_M, direction[2] / HALF_HEIGHT_M
    # |t d - m| = 1
    square = dx * dx + dy * dy + dz * dz
    half = x * dx + y * dy + z * dz
    outside = x * x + y * y + z * z - 1.0
    if outside <= 0.0:
        return 0.0
    root = half * half - square * outside
    return (half - math.sqrt(root)) / square if root >= 0.0 and half > 0.0 else math.inf
