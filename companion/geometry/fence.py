"""A fence of polygons, level with the ground: one to stay inside of, any number to stay out of.

An edge is approached by slowing down: towards it no more speed is left than the way to it allows to stop in;
along it and back the vehicle flies as it likes. Inside and outside are told by the crossing number
(Shimrat 1962, "Position of point relative to polygon").
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise

Place = tuple[float, float]
Polygon = tuple[Place, ...]
Area = tuple[Polygon, bool]  # with whether to stay inside of it, else out of it
Row = tuple[float, float, float]  # a direction (north, east), and the speed allowed in it

# So far before an edge the vehicle stops: it is led by an estimate, and answers late.
MARGIN_M = 0.5
ON_EDGE_M = 1e-6
# What slows down for one edge may push towards another: so often it is taken back.
_ROUNDS = 20


@dataclass(frozen=True, slots=True)
class Fence:
    """Corners are (north, east) of home, metres; the last is joined to the first.

    Attributes:
        include: to stay inside of; empty: anywhere.
        exclude: to stay out of.

    Raises:
        ValueError: fewer than three corners, a corner that is not finite, or edges that cross.
    """

    include: Polygon = ()
    exclude: tuple[Polygon, ...] = ()

    def __post_init__(self) -> None:
        for polygon, _ in self._areas():
            if len(polygon) < 3:
                raise ValueError(f"a fence needs three corners or more, got {len(polygon)}")
            if not all(math.isfinite(value) for corner in polygon for value in corner):
                raise ValueError("every corner of a fence must be finite")
            if crossing := _crossing_edges(polygon):
                raise ValueError(f"the edges of a fence may not cross; those from {crossing} do")

    def holds(self, place: Place) -> bool:
        """Whether the vehicle may be there."""
        return not any(_breached(area, place) for area in self._areas())

    def slowed(
        self,
        velocity: Place,
        place: Place,
        speed_towards: Callable[[float], float],
        also: Iterable[Row] = (),
    ) -> Place:
        """What is left of a velocity over ground so that the vehicle stays inside.

        Args:
            velocity: (north, east) m/s. place: (north, east) of home, metres.
            speed_towards: from the way that is left before an edge, metres (0 or less: none), to the speed
                that may be flown towards it.
            also: more limits of the kind: (north, east) unit direction, and the speed allowed in it.

        Returns:
            The velocity, no faster than it came. Where a fence is broken already: what leads no further.
        """
        top = math.hypot(*velocity)
        rows = [row for row in (*also, *self._rows_at(place, speed_towards)) if row[2] < top]
        for _ in range(_ROUNDS):
            before = velocity
            for north, east, allowed in rows:
                excess = velocity[0] * north + velocity[1] * east - allowed
                if excess > 0.0:
                    velocity = (velocity[0] - excess * north, velocity[1] - excess * east)
            if velocity == before:
                return velocity
        # Standing still keeps every limit, so what still breaks one is shortened towards that.
        share = 1.0
        for north, east, allowed in rows:
            towards = velocity[0] * north + velocity[1] * east
            if towards > allowed + 1e-6:
                share = min(share, allowed / towards)
        return (velocity[0] * share, velocity[1] * share)

    def clipped(self, start: Place, goal: Place) -> Place:
        """The farthest place on the straight way to `goal` that lies inside, half a metre of way before it.

        From outside only a goal that is right is flown to, and only if nothing else lies in between.
        """
        length = math.dist(start, goal)
        held = [area for area in self._areas() if not _breached(area, start)]
        if length == 0.0 or any(_breached(area, goal) for area in self._areas() if area not in held):
            return start
        first = min(
            (share for polygon, _ in held for share in _crossings(start, goal, polygon)), default=None
        )
        if first is None:
            return goal if self.holds(goal) else start
        share = max(0.0, first - MARGIN_M / length)
        return (start[0] + share * (goal[0] - start[0]), start[1] + share * (goal[1] - start[1]))

    def _areas(self) -> list[Area]:
        outside = [(polygon, False) for polygon in self.exclude]
        return [(self.include, True), *outside] if self.include else outside

    def _rows_at(self, place: Place, speed_towards: Callable[[float], float]) -> Iterator[Row]:
        """The limits there: towards the edges of what holds, and away from what is broken."""
        for area in self._areas():
            polygon, _ = area
            nearest = [_nearest(a, b, place) for a, b in _edges(polygon)]
            away = [math.dist(there, place) for there in nearest]
            if _breached(area, place) and min(away) > ON_EDGE_M:
                at = away.index(min(away))
                north, east = ((nearest[at][axis] - place[axis]) / away[at] for axis in range(2))
                yield (-north, -east, 0.0)
                continue
            for (a, b), there, distance in zip(_edges(polygon), nearest, away, strict=True):
                if distance > ON_EDGE_M:
                    north, east = ((there[axis] - place[axis]) / distance for axis in range(2))
                    yield (north, east, speed_towards(distance - MARGIN_M))
                    continue
                # On the edge itself: straight across it, to the side that is not allowed.
                length = math.dist(a, b)
                north, east = (b[1] - a[1]) / length, -(b[0] - a[0]) / length
                if not _breached(area, (place[0] + 1e-3 * north, place[1] + 1e-3 * east)):
                    north, east = -north, -east
                yield (north, east, 0.0)


def _breached(area: Area, place: Place) -> bool:
    polygon, to_stay_inside = area
    return _inside(polygon, place) is not to_stay_inside


def _edges(polygon: Polygon) -> Iterator[tuple[Place, Place]]:
    return pairwise((*polygon, polygon[0]))


def _inside(polygon: Polygon, place: Place) -> bool:
    north, east = place
    inside = False
    for (a_north, a_east), (b_north, b_east) in _edges(polygon):
        if (a_east > east) is not (b_east > east):
            crossed_at = a_north + (east - a_east) / (b_east - a_east) * (b_north - a_north)
            inside ^= north < crossed_at
    return inside


def _nearest(a: Place, b: Place, place: Place) -> Place:
    """The place on the line from a to b that is nearest to `place`."""
    north, east = b[0] - a[0], b[1] - a[1]
    square = north * north + east * east
    if square == 0.0:
        return a
    share = ((place[0] - a[0]) * north + (place[1] - a[1]) * east) / square
    share = min(max(share, 0.0), 1.0)
    return (a[0] + share * north, a[1] + share * east)


def _crossings(start: Place, goal: Place, polygon: Polygon) -> Iterator[float]:
    """Where the way from start to goal crosses edges, as shares of it."""
    for a, b in _edges(polygon):
        share = _crossing(start, goal, a, b)
        if share is not None:
            yield share


def _crossing(start: Place, goal: Place, a: Place, b: Place) -> float | None:
    way, edge = (goal[0] - start[0], goal[1] - start[1]), (b[0] - a[0], b[1] - a[1])
    turn = way[0] * edge[1] - way[1] * edge[0]
    if turn == 0.0:
        return None
    offset = (a[0] - start[0], a[1] - start[1])
    share = (offset[0] * edge[1] - offset[1] * edge[0]) / turn
    along = (offset[0] * way[1] - offset[1] * way[0]) / turn
    return share if 0.0 <= share <= 1.0 and 0.0 <= along <= 1.0 else None


def _crossing_edges(polygon: Polygon) -> str:
    """The beginnings of two edges that cross each other, or lie on each other; empty: none do."""
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
