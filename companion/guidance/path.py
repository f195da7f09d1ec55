"""Path following: progress along a path, speed profile, and velocity command.

A path is a list of points in local NED joined by straight lines. Speeds come from its bends: a bend of radius
r allows √(a·r), and before it the vehicle slows down by √(v² + 2·a·s).
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise

from companion.guidance.motion import MAX_CORRECTION_MPS, POSITION_GAIN, STOPPING_MPS2, stopping_speed
from companion.vehicle.state import Vector3

# Below the envelope's 2 m/s², to keep a reserve against wind.
ACCELERATION_MPS2 = 1.0
# A corner is flown as a bend: the turn of the path within this distance before and after a point.
BEND_M = 1.0
SPACING_M = 0.25
SAME_M, ABOVE_M = 0.01, 0.05
SLOWEST_MPS = 0.4
# Delay of a multirotor's velocity: the command is the path's direction that far ahead.
DELAY_S = 0.4
# The nearest point is searched no further ahead than this plus the distance flown meanwhile.
SEARCH_AHEAD_M = 3.0
# A reversal of the path counts as reached within this distance.
CORNER_M = 0.5
# Scalar product of the path's directions before and after a reversal.
TURNED_BACK = -0.1
LONGEST_M = 5_000.0
# Bends are computed from directions 2·BEND_M apart, so a shorter loop has none.
SHORTEST_LAP_M = 4.0 * BEND_M
_MOST_PARTS = 2000


@dataclass(frozen=True, slots=True)
class PathPoint:
    """A point on the path.

    Attributes:
        position_ned_m: local NED metres. direction: (north, east, down) unit vector along the path.
        speed_mps: the greatest speed there.
    """

    position_ned_m: Vector3
    direction: Vector3
    speed_mps: float


class Path:
    """A path with its speed profile.

    Args:
        points: local NED metres; repeated points are skipped. A path needs a length: of a single point it
            begins 5 cm above.
        speed_mps: along straight lines.
        closed: a loop from the last point back to the first, without slowing down for an end.

    Attributes:
        length_m: of one lap. speed_mps: as given.

    Raises:
        ValueError: no points, longer than `LONGEST_M`, or a loop shorter than `SHORTEST_LAP_M`.
    """

    def __init__(self, points: Sequence[Vector3], speed_mps: float, *, closed: bool = False) -> None:
        if not points:
            raise ValueError("a path needs a point")
        corners = [points[0]]
        for point in (*points, *points[:1]) if closed else points:
            if math.dist(point, corners[-1]) >= SAME_M:
                corners.append(point)
        if len(corners) < 2:
            corners.insert(0, (corners[0][0], corners[0][1], corners[0][2] - ABOVE_M))
        self.closed, self.speed_mps = closed, speed_mps
        length_m = sum(math.dist(a, b) for a, b in pairwise(corners))
        if not length_m <= LONGEST_M:
            raise ValueError(f"a path must be at most {LONGEST_M:g} m long, got {length_m:.0f} m")
        if closed and length_m < SHORTEST_LAP_M:
            raise ValueError(
                f"a closed path must be at least {SHORTEST_LAP_M:g} m long, got {length_m:.1f} m"
            )
        self._points = _spaced(corners, max(SPACING_M, length_m / _MOST_PARTS))
        self._at = list(accumulate((math.dist(a, b) for a, b in pairwise(self._points)), initial=0.0))
        self.length_m = self._at[-1]
        self._directions = [_direction(a, b) for a, b in pairwise(self._points)]
        self._speeds = self._allowed(speed_mps)

    def point(self, along_m: float) -> PathPoint:
        """The point `along_m` from the start; beyond an open path's end, the end."""
        index, fraction = self._part(along_m)
        before, after = self._speeds[index], self._speeds[index + 1]
        # At constant acceleration the square of the speed is linear in distance.
        speed = math.sqrt(before**2 + fraction * (after**2 - before**2))
        return PathPoint(self._between(index, fraction), self._directions[index], speed)

    def direction(self, along_m: float) -> Vector3:
        """`PathPoint.direction` there, alone."""
        return self._directions[self._segment(along_m)[0]]

    def nearest(self, position: Vector3, from_m: float, to_m: float) -> float:
        """Distance along the path of the point nearest to `position`, between `from_m` and `to_m`."""
        steps = max(2, math.ceil((to_m - from_m) / SPACING_M))
        tried = [from_m + (to_m - from_m) * step / steps for step in range(steps + 1)]
        if not self.closed:
            tried = [min(max(along, 0.0), self.length_m) for along in tried]
        best = min(tried, key=lambda along: math.dist(self._position(along), position))
        here = self.point(best)
        offset = [p - h for p, h in zip(position, here.position_ned_m, strict=True)]
        best += sum(o * d for o, d in zip(offset, here.direction, strict=True))
        return min(max(best, from_m), to_m)

    def _part(self, along_m: float) -> tuple[int, float]:
        """Index of the segment at a distance along the path, and the fraction of it."""
        index, on_path_m = self._segment(along_m)
        fraction = (on_path_m - self._at[index]) / (self._at[index + 1] - self._at[index])
        return index, min(max(fraction, 0.0), 1.0)

    def _segment(self, along_m: float) -> tuple[int, float]:
        """Index of the segment at a distance along the path, and that distance within one lap or the ends."""
        on_path_m = along_m % self.length_m if self.closed else min(max(along_m, 0.0), self.length_m)
        return min(max(bisect_right(self._at, on_path_m) - 1, 0), len(self._directions) - 1), on_path_m

    def _position(self, along_m: float) -> Vector3:
        """The position alone: `nearest` evaluates many."""
        return self._between(*self._part(along_m))

    def _between(self, index: int, fraction: float) -> Vector3:
        start, end = self._points[index], self._points[index + 1]
        return (
            start[0] + fraction * (end[0] - start[0]),
            start[1] + fraction * (end[1] - start[1]),
            start[2] + fraction * (end[2] - start[2]),
        )

    def _allowed(self, speed_mps: float) -> list[float]:
        """Greatest speed at each point: that of its bend, and from which the next one's can be reached."""
        speeds = [min(speed_mps, self._bend_speed(along)) for along in self._at]
        if not self.closed:
            speeds[-1] = 0.0
        passes = 2 if self.closed else 1  # the second pass uses the first one's start speed
        for _ in range(passes):
            if self.closed:
                speeds[-1] = speeds[0] = min(speeds[0], speeds[-1])
            for index in range(len(speeds) - 2, -1, -1):
                distance = self._at[index + 1] - self._at[index]
                speeds[index] = min(
                    speeds[index], math.sqrt(speeds[index + 1] ** 2 + 2.0 * ACCELERATION_MPS2 * distance)
                )
        return speeds

    def _bend_speed(self, along_m: float) -> float:
        if not self.closed and not BEND_M <= along_m <= self.length_m - BEND_M:
            return math.inf
        before, after = self.direction(along_m - BEND_M), self.direction(along_m + BEND_M)
        turned = math.acos(min(max(_dot(before, after), -1.0), 1.0))
        if turned < 1e-6:
            return math.inf
        return max(SLOWEST_MPS, math.sqrt(ACCELERATION_MPS2 * 2.0 * BEND_M / turned))


class PathFollower:
    """Follows a path: call `velocity` at every update.

    Args:
        laps: of a closed path, after which the vehicle stops; 0: it does not stop.

    Attributes:
        along_m: progress over all laps; it never decreases.
        off_m: cross-track distance at the last update.
        end_m: distance along the path where it stops; infinite: it does not.
    """

    def __init__(self, path: Path, laps: float = 1.0) -> None:
        self.path = path
        laps = laps if path.closed else 1.0
        self.end_m = laps * path.length_m if laps else math.inf
        self.along_m = 0.0
        self.off_m = 0.0
        self._joined = not path.closed

    def velocity(self, position: Vector3, speed_mps: float) -> Vector3:
        """The velocity (NED) along the path and back onto it.

        Args:
            position: of the vehicle, local NED metres. speed_mps: its ground speed.
        """
        if not self._joined:
            start = self.path.point(0.0).position_ned_m
            to_start = [s - p for s, p in zip(start, position, strict=True)]
            self.off_m = math.hypot(*to_start)
            if self.off_m > BEND_M:
                pace = min(POSITION_GAIN, self.path.speed_mps / self.off_m)
                north, east, down = (offset * pace for offset in to_start)
                return (north, east, down)
            self._joined = True
        reach_m = self.along_m + min(SEARCH_AHEAD_M + 2.0 * speed_mps * DELAY_S, self.path.length_m / 2)
        reach_m = min(reach_m, self.end_m)
        self.along_m = self.path.nearest(position, self.along_m, self._before_turning_back(reach_m))
        here = self.path.point(self.along_m)
        ahead = self.path.point(self.along_m + DELAY_S * here.speed_mps)
        offset = [h - p for h, p in zip(here.position_ned_m, position, strict=True)]
        self.off_m = math.hypot(*offset)
        # Returning to the path has priority; progress along it gets the remaining speed.
        back_mps = min(POSITION_GAIN * self.off_m, max(MAX_CORRECTION_MPS, here.speed_mps))
        slowest = min(SLOWEST_MPS, self.path.speed_mps)
        along_mps = math.sqrt(max(0.0, max(here.speed_mps, slowest) ** 2 - back_mps**2))
        along_mps = min(along_mps, stopping_speed(self.left_m, along_mps, STOPPING_MPS2))
        scale = back_mps / self.off_m if self.off_m > 1e-6 else 0.0
        north, east, down = (d * along_mps + o * scale for d, o in zip(ahead.direction, offset, strict=True))
        return (north, east, down)

    def ahead(self, length_m: float) -> tuple[Vector3, ...]:
        """Points about a metre apart along the path from here, the last one included.

        They reach as far as `length_m`, the path's end or a reversal. A reversal within `CORNER_M` counts as
        reached.
        """
        if not self._joined:
            return (self.path.point(0.0).position_ned_m,)
        beyond_m = self.along_m + CORNER_M + SPACING_M / 2
        here, beyond = self.path.direction(self.along_m), self.path.direction(beyond_m)
        if beyond_m < self.end_m and _dot(here, beyond) < TURNED_BACK:
            self.along_m = beyond_m
        length_m = self._before_turning_back(self.along_m + min(length_m, self.left_m)) - self.along_m
        count = max(1, math.ceil(length_m))
        steps = (self.along_m + length_m * step / count for step in range(count + 1))
        return tuple(self.path.point(along_m).position_ned_m for along_m in steps)

    def _before_turning_back(self, reach_m: float) -> float:
        """Limit the search to the next reversal of the path, where both legs are equally near."""
        here, at = self.path.direction(self.along_m), self.along_m + CORNER_M
        while at < reach_m:
            at += SPACING_M / 2
            if _dot(here, self.path.direction(at)) < TURNED_BACK:
                return min(at, reach_m)
        return reach_m

    def bearing(self) -> float | None:
        """Bearing of the path ahead, radians from north; None where it goes straight up or down."""
        north, east, _ = self.path.direction(self.along_m + BEND_M)
        return math.atan2(east, north) if math.hypot(north, east) > 0.2 else None

    @property
    def left_m(self) -> float:
        """Distance left until it stops."""
        return max(0.0, self.end_m - self.along_m)

    @property
    def end_ned_m(self) -> Vector3 | None:
        """Where it stops, local NED; None: it does not stop."""
        return self.path.point(self.end_m).position_ned_m if math.isfinite(self.end_m) else None


def _dot(one: Vector3, other: Vector3) -> float:
    return one[0] * other[0] + one[1] * other[1] + one[2] * other[2]


def _direction(start: Vector3, end: Vector3) -> Vector3:
    """Unit vector from one point to another."""
    length_m = math.dist(start, end)
    return (
        (end[0] - start[0]) / length_m,
        (end[1] - start[1]) / length_m,
        (end[2] - start[2]) / length_m,
    )


def _spaced(corners: Sequence[Vector3], spacing: float) -> list[Vector3]:
    """The same path with a point at least every `spacing` metres."""
    points = [corners[0]]
    for start, end in pairwise(corners):
        count = max(1, math.ceil(math.dist(start, end) / spacing))
        for step in range(1, count + 1):
            x, y, z = (a + (b - a) * step / count for a, b in zip(start, end, strict=True))
            points.append((x, y, z))
    return points
