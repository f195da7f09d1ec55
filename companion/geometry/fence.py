"""A geofence of horizontal polygons: at most one inclusion, any number of exclusions.

The velocity towards an edge is limited to the speed from which the vehicle stops before it. Motion along the
edge or away from it is not limited. Point in polygon is tested by the crossing number (Shimrat 1962,
"Position of point relative to polygon").
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

Point = tuple[float, float]
Polygon = tuple[Point, ...]
Area = tuple[Polygon, bool]  # True: inclusion, False: exclusion
Constraint = tuple[float, float, float]  # unit direction (north, east), and the speed allowed in it, m/s

# Distance kept to an edge: covers the position estimate's error and the vehicle's delay.
MARGIN_M = 0.5
ON_EDGE_M = 1e-6
# Of the speed that constraints below zero ask for: the largest share that the other constraints allow.
_SHARES = (1.0, 0.75, 0.5, 0.25, 0.0)


@dataclass(frozen=True, slots=True)
class Fence:
    """Polygons with corners (north, east) of home, metres; the last corner is joined to the first.

    Attributes:
        include: inclusion polygon; empty: no inclusion limit.
        exclude: exclusion polygons.

    Raises:
        ValueError: fewer than three corners, a corner that is not finite, or edges that cross.
    """

    include: Polygon = ()
    exclude: tuple[Polygon, ...] = ()

    def __post_init__(self) -> None:
        for polygon, _ in self._areas():
            if len(polygon) < 3:
                raise ValueError(f"a fence polygon needs at least 3 corners, got {len(polygon)}")
            for north_m, east_m in polygon:
                if not (math.isfinite(north_m) and math.isfinite(east_m)):
                    raise ValueError(
                        f"every corner of a fence polygon must be finite, got {north_m:g},{east_m:g}"
                    )
            if crossing := _crossing_edges(polygon):
                raise ValueError(f"the edges of a fence polygon must not cross; those from {crossing} do")

    def contains(self, position: Point) -> bool:
        """Whether a point lies inside the inclusion and outside every exclusion."""
        return not any(_breached(area, position) for area in self._areas())

    def limit_velocity(
        self,
        velocity: Point,
        position: Point,
        speed_towards: Callable[[float], float],
        also: Iterable[Constraint] = (),
    ) -> Point:
        """Limit a horizontal velocity so that the vehicle stays inside the fence.

        Args:
            velocity: (north, east) m/s. position: (north, east) of home, metres.
            speed_towards: maps the distance left to an edge, metres (0 or less at the edge), to the speed
                allowed towards it, m/s.
            also: further constraints.

        Returns:
            The nearest velocity that satisfies every constraint, never faster than the input unless one of
            `also` is below zero. Outside the fence: no component further out. Constraints below zero (back
            away) may contradict the others; they are reduced until all can be satisfied.
        """
        top = math.hypot(*velocity)
        constraints = [*also, *self._constraints_at(position, speed_towards)]
        most = math.hypot(top, min((0.0, *(allowed for _, _, allowed in constraints))))
        for share in _SHARES:
            shared = [
                (north, east, allowed * (share if allowed < 0.0 else 1.0))
                for north, east, allowed in constraints
            ]
            nearest = _nearest_velocity(velocity, shared)
            if nearest is not None and math.hypot(*nearest) <= most + 1e-6:
                return nearest
        return (0.0, 0.0)

    def clip(self, start: Point, goal: Point) -> Point:
        """The last allowed point on the straight line to `goal`, `MARGIN_M` before the first edge crossed.

        From a start outside the fence: `goal` if it is allowed and no other edge is crossed, else `start`.
        """
        length = math.dist(start, goal)
        satisfied = [area for area in self._areas() if not _breached(area, start)]
        if length == 0.0 or any(_breached(area, goal) for area in self._areas() if area not in satisfied):
            return start
        first = min(
            (fraction for polygon, _ in satisfied for fraction in _crossings(start, goal, polygon)),
            default=None,
        )
        if first is None:
            return goal if self.contains(goal) else start
        fraction = max(0.0, first - MARGIN_M / length)
        return (start[0] + fraction * (goal[0] - start[0]), start[1] + fraction * (goal[1] - start[1]))

    def _areas(self) -> list[Area]:
        outside = [(polygon, False) for polygon in self.exclude]
        return [(self.include, True), *outside] if self.include else outside

    def _constraints_at(
        self, position: Point, speed_towards: Callable[[float], float]
    ) -> Iterator[Constraint]:
        """Constraints towards the edges of satisfied areas, and back towards the edge of violated ones."""
        for area in self._areas():
            polygon, _ = area
            nearest = [_nearest(a, b, position) for a, b in _edges(polygon)]
            away = [math.dist(there, position) for there in nearest]
            if _breached(area, position) and min(away) > ON_EDGE_M:
                at = away.index(min(away))
                north, east = ((nearest[at][axis] - position[axis]) / away[at] for axis in range(2))
                yield (-north, -east, 0.0)
                continue
            for (a, b), there, distance in zip(_edges(polygon), nearest, away, strict=True):
                if distance > ON_EDGE_M:
                    north, east = ((there[axis] - position[axis]) / distance for axis in range(2))
                    yield (north, east, speed_towards(distance - MARGIN_M))
                    continue
                # On the edge itself: perpendicular to it, towards the forbidden side.
                length = math.dist(a, b)
                north, east = (b[1] - a[1]) / length, -(b[0] - a[0]) / length
                if not _breached(area, (position[0] + 1e-3 * north, position[1] + 1e-3 * east)):
                    north, east = -north, -east
                yield (north, east, 0.0)


def _nearest_velocity(wanted: Point, constraints: Sequence[Constraint]) -> Point | None:
    """The velocity nearest to `wanted` that satisfies all; None: they contradict each other.

    One constraint after the other: where it is violated, the nearest velocity lies on its line, between the
    crossings with the earlier ones (Seidel 1991, "Small-dimensional linear programming made easy").
    """
    velocity = wanted
    for index, (north, east, allowed) in enumerate(constraints):
        if velocity[0] * north + velocity[1] * east <= allowed:
            continue
        low, high = -math.inf, math.inf
        for other_north, other_east, other_allowed in constraints[:index]:
            slope = north * other_east - east * other_north
            left = other_allowed - allowed * (north * other_north + east * other_east)
            if abs(slope) < 1e-9:
                if left < -1e-6:
                    return None
            elif slope > 0.0:
                high = min(high, left / slope)
            else:
                low = max(low, left / slope)
        if low > high + 1e-6:
            return None
        along = max(low, min(high, wanted[1] * north - wanted[0] * east))
        velocity = (allowed * north - along * east, allowed * east + along * north)
    return velocity


def _breached(area: Area, position: Point) -> bool:
    polygon, is_inclusion = area
    return _inside(polygon, position) is not is_inclusion


def _edges(polygon: Polygon) -> Iterator[tuple[Point, Point]]:
    return pairwise((*polygon, polygon[0]))


def _inside(polygon: Polygon, position: Point) -> bool:
    north, east = position
    inside = False
    for (a_north, a_east), (b_north, b_east) in _edges(polygon):
        if (a_east > east) is not (b_east > east):
            crossed_at = a_north + (east - a_east) / (b_east - a_east) * (b_north - a_north)
            inside ^= north < crossed_at
    return inside


def _nearest(a: Point, b: Point, point: Point) -> Point:
    """The point of the segment from a to b that is nearest to `point`."""
    north, east = b[0] - a[0], b[1] - a[1]
    square = north * north + east * east
    if square == 0.0:
        return a
    fraction = ((point[0] - a[0]) * north + (point[1] - a[1]) * east) / square
    fraction = min(max(fraction, 0.0), 1.0)
    return (a[0] + fraction * north, a[1] + fraction * east)


def _crossings(start: Point, goal: Point, polygon: Polygon) -> Iterator[float]:
    """Where the segment from start to goal crosses edges, as fractions of its length."""
    for a, b in _edges(polygon):
        fraction = _crossing(start, goal, a, b)
        if fraction is not None:
            yield fraction


def _crossing(start: Point, goal: Point, a: Point, b: Point) -> float | None:
    path, edge = (goal[0] - start[0], goal[1] - start[1]), (b[0] - a[0], b[1] - a[1])
    turn = path[0] * edge[1] - path[1] * edge[0]
    if turn == 0.0:
        return None
    offset = (a[0] - start[0], a[1] - start[1])
    fraction = (offset[0] * edge[1] - offset[1] * edge[0]) / turn
    along = (offset[0] * path[1] - offset[1] * path[0]) / turn
    return fraction if 0.0 <= fraction <= 1.0 and 0.0 <= along <= 1.0 else None


def _crossing_edges(polygon: Polygon) -> str:
    """Start corners of two edges that cross or overlap, in words; empty: none do."""
    edges = list(_edges(polygon))
    for first, (a, b) in enumerate(edges):
        if a == b:
            return f"{a} and the same corner"
        for second in range(first + 1, len(edges)):
            neighbours = second == first + 1 or (first == 0 and second == len(edges) - 1)
            c, d = edges[second]
            if not neighbours and _crossing(a, b, c, d) is not None:
                return f"{a} and {c}"
    return ""
