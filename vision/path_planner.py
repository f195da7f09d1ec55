"""Paths around obstacles on an occupancy grid: A*, shortcuts, rounded corners. Local NED, metres.

Cells nearer to an occupied cell than the clearance are blocked. Cells that were never observed may be crossed
at a higher cost; how far a path is observed free is part of the result, and only that far may be flown.
"""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from vision.occupancy_grid import CELL_M, SIZE, OccupancyGrid, Point

# Cost per metre: 1, plus these.
UNKNOWN_COST = 1.0
# Near obstacles: falls to 0 at this distance beyond the clearance.
NEAR_COST, NEAR_M = 1.0, 0.6
# Away from the reference, per metre up to the limit: a path is followed where it is free.
AWAY_COST_PER_M, AWAY_LIMIT_M = 0.7, 2.0
# The search uses every second cell in each direction.
STRIDE = 2
# A vehicle inside the clearance first flies out of it, to a cell within this distance.
ESCAPE_M = 2.0
# The path ends at the last point of the reference that can be reached, at least this far from the vehicle.
LEAST_M = 2.0
BORDER_M = 1.0
# The camera does not see the ground beside the vehicle: so near, cells need not be observed.
UNSEEN_M = 1.5
SPACING_M = 0.1
# Of the way out of the clearance: finite, and more than any detour.
BLOCKED_COST = 1e4
_NEIGHBOURS = [(dn, de) for dn in (-1, 0, 1) for de in (-1, 0, 1) if (dn, de) != (0, 0)]


@dataclass(frozen=True, slots=True)
class PathRequest:
    """What to plan.

    Attributes:
        reference: (north, east) metres, the line that would be flown without obstacles, from about the
            vehicle on; its last point is the goal.
        clearance_m: least distance of the vehicle's centre from an obstacle.
        number: of what is flown; its paths have the same.
    """

    reference: tuple[Point, ...]
    clearance_m: float
    number: int = 0


@dataclass(frozen=True, slots=True)
class PlannedPath:
    """A path, or why there is none.

    Attributes:
        captured_ns: stamp of the newest depth image that it uses.
        points: (north, east) metres, from the vehicle on; empty: no way.
        free_m: length of its beginning that was observed to be free.
        reason: why there is no way; empty if there is one.
        number: of the request.
    """

    captured_ns: int
    points: tuple[Point, ...]
    free_m: float = 0.0
    reason: str = ""
    number: int = 0


def plan_path(grid: OccupancyGrid, request: PathRequest, position: Point) -> PlannedPath:
    """Plan from the vehicle's position along the reference.

    Raises:
        ValueError: the reference has no points.
    """
    if not request.reference:
        raise ValueError("a path request needs at least one point")
    field = _Field(grid, request)
    try:
        start, ends = field.start(position), field.ends(position)
        end = field.last_reached(start, ends)
    except _NoWayError as why:
        return PlannedPath(grid.captured_ns, (), reason=str(why), number=request.number)
    cells = field.search(start, field.cell(end))
    points = np.vstack((position, grid.points(np.array(cells[1:-1] or [start])), end))
    points = field.rounded(field.shortened(points))
    free_m = field.free_length(points)
    path = tuple((float(north), float(east)) for north, east in points)
    return PlannedPath(grid.captured_ns, path, free_m, number=request.number)


class _NoWayError(Exception):
    """There is no path; the message says why."""


class _Field:
    """Clearance and cost of every cell for one request."""

    def __init__(self, grid: OccupancyGrid, request: PathRequest) -> None:
        self._grid, self._clearance_m = grid, request.clearance_m
        self.reference = np.array(request.reference, np.float64)
        blocked = grid.occupied.astype(np.uint8)
        self._gap_m = cv2.distanceTransform(1 - blocked, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) * CELL_M
        self.passable = self._gap_m >= self._clearance_m
        near = np.clip(1.0 - (self._gap_m - self._clearance_m) / NEAR_M, 0.0, 1.0)
        away = np.minimum(self._away_m(), AWAY_LIMIT_M)
        unknown = ~(grid.free | grid.occupied)
        self.cost = 1.0 + UNKNOWN_COST * unknown + NEAR_COST * near + AWAY_COST_PER_M * away
        coarse = np.ascontiguousarray(self.passable[::STRIDE, ::STRIDE]).astype(np.uint8)
        _, self._region = cv2.connectedComponents(coarse, connectivity=8)

    def start(self, position: Point) -> tuple[int, int]:
        """The passable cell (of the search) nearest to the vehicle. Raises _NoWayError."""
        cells = np.argwhere(self.passable[::STRIDE, ::STRIDE]) * STRIDE
        away_m = np.hypot(*(self._grid.points(cells) - position).T)
        if not len(cells) or away_m.min() > ESCAPE_M:
            row, column = self.cell(np.array(position))
            raise _NoWayError(
                f"obstacles on all sides, the nearest {self._gap_m[row, column]:.1f} m away; "
                f"{self._clearance_m:g} m are needed"
            )
        row, column = cells[int(np.argmin(away_m))]
        return int(row), int(column)

    def ends(self, position: Point) -> NDArray[np.float64]:
        """(N, 2) points of the reference in the grid where the path may end, in order. Raises _NoWayError."""
        points = _sampled(self.reference, CELL_M)
        cells = self._grid.cells(points)
        border = math.ceil(BORDER_M / CELL_M)
        inside = ((cells >= border) & (cells < SIZE - border)).all(axis=1)
        far = np.hypot(*(points - position).T) >= LEAST_M
        far[-1] = True  # the goal itself may be near
        ends: NDArray[np.float64] = points[inside & far]
        if not len(ends):
            raise _NoWayError("the path to follow is outside the map around the vehicle")
        return ends

    def last_reached(self, start: tuple[int, int], ends: NDArray[np.float64]) -> NDArray[np.float64]:
        """The last of the points that is passable and connected with the start. Raises _NoWayError."""
        cells = self._grid.cells(ends)
        passable = self.passable[cells[:, 0], cells[:, 1]]
        region = self._region[cells[:, 0] // STRIDE, cells[:, 1] // STRIDE]
        reached = np.flatnonzero(passable & (region == self._region[start[0] // STRIDE, start[1] // STRIDE]))
        if len(reached):
            end: NDArray[np.float64] = ends[reached[-1]]
            return end
        if passable[-1]:
            raise _NoWayError(f"no gap of {2 * self._clearance_m:.1f} m between the obstacles seen")
        gap_m = self._gap_m[cells[-1][0], cells[-1][1]]
        raise _NoWayError(f"an obstacle is {gap_m:.1f} m from the goal; {self._clearance_m:g} m are needed")

    def cell(self, point: NDArray[np.float64]) -> tuple[int, int]:
        """The search's cell at a point."""
        row, column = self._grid.cells(point[None, :])[0] // STRIDE * STRIDE
        return int(row), int(column)

    def search(self, start: tuple[int, int], end: tuple[int, int]) -> list[tuple[int, int]]:
        """A*: the cells of the cheapest path, both ends included; they must be connected."""
        cost = self.cost[::STRIDE, ::STRIDE]
        # Plain lists: element access is several times faster than in an array.
        costs: list[list[float]] = np.where(self._region == 0, math.inf, cost).tolist()
        goal = (end[0] // STRIDE, end[1] // STRIDE)
        first = (start[0] // STRIDE, start[1] // STRIDE)
        side = len(costs)
        best = {first: 0.0}
        before: dict[tuple[int, int], tuple[int, int]] = {}
        queue = [(0.0, first)]
        done: set[tuple[int, int]] = set()
        while queue:
            _, here = heapq.heappop(queue)
            if here == goal:
                break
            if here in done:
                continue
            done.add(here)
            row, column = here
            so_far, here_cost = best[here], costs[row][column]
            for down, right in _NEIGHBOURS:
                there = (row + down, column + right)
                if not (0 <= there[0] < side and 0 <= there[1] < side):
                    continue
                length = math.sqrt(2.0) if down and right else 1.0
                total = so_far + length * 0.5 * (here_cost + costs[there[0]][there[1]])
                if total < best.get(there, math.inf):
                    best[there], before[there] = total, here
                    left = math.hypot(there[0] - goal[0], there[1] - goal[1])
                    heapq.heappush(queue, (total + left, there))
        path = [goal]
        while path[-1] != first:
            path.append(before[path[-1]])
        return [(row * STRIDE, column * STRIDE) for row, column in reversed(path)]

    def shortened(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """The same path with straight lines wherever these are passable and cost no more."""
        kept, index = [0], 0
        legs = [min(self._cost(start, end), BLOCKED_COST) for start, end in pairwise(points)]
        along = np.concatenate(([0.0], np.cumsum(legs)))
        while index < len(points) - 1:
            # The farthest of ever nearer points; the next one always is passable.
            for further in range(len(points) - 1, index, -1):
                least = 1.02 * (along[further] - along[index])
                if further == index + 1 or self._cost(points[index], points[further]) <= least:
                    break
            index = further
            kept.append(index)
        return points[kept]

    def rounded(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """The path with its corners cut twice (Chaikin 1974), where the cut is passable."""
        for _ in range(2):
            rounded = [points[0]]
            for before, corner, after in zip(points[:-2], points[1:-1], points[2:], strict=True):
                entry, leaving = corner + 0.25 * (before - corner), corner + 0.25 * (after - corner)
                cut = math.isfinite(self._cost(entry, leaving))
                rounded += [entry, leaving] if cut else [corner]
            points = np.array([*rounded, points[-1]])
        return points

    def free_length(self, points: NDArray[np.float64]) -> float:
        """Length of the path's beginning that was observed to be free."""
        sampled = _sampled(points, SPACING_M)
        along = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(sampled, axis=0).T))))
        cells = self._grid.cells(sampled)
        unseen = ~self._grid.free[cells[:, 0], cells[:, 1]] & (along > UNSEEN_M)
        return float(along[np.argmax(unseen)] if unseen.any() else along[-1])

    def _cost(self, start: NDArray[np.float64], end: NDArray[np.float64]) -> float:
        """Cost of a straight line; infinite if it is blocked."""
        cells = self._grid.cells(_sampled(np.array([start, end]), SPACING_M))
        rows, columns = cells[:, 0], cells[:, 1]
        if not self.passable[rows, columns].all():
            return math.inf
        return float(self.cost[rows, columns].mean() * math.dist(start, end))

    def _away_m(self) -> NDArray[np.float32]:
        """Distance of every cell from the reference."""
        line = np.ones((SIZE, SIZE), np.uint8)
        cells = self._grid.cells(self.reference)[:, ::-1]  # OpenCV's x is the column
        cv2.polylines(line, [cells.astype(np.int32)], False, 0)
        away: NDArray[np.float32] = cv2.distanceTransform(line, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) * CELL_M
        return away


def _sampled(points: NDArray[np.float64], spacing_m: float) -> NDArray[np.float64]:
    """The polyline with a point at least every `spacing_m`, its first and last included."""
    lengths = np.hypot(*np.diff(points, axis=0).T) if len(points) > 1 else np.zeros(0)
    along = np.concatenate(([0.0], np.cumsum(lengths)))
    wanted = np.linspace(0.0, along[-1], max(2, math.ceil(along[-1] / spacing_m) + 1))
    return np.column_stack([np.interp(wanted, along, points[:, axis]) for axis in (0, 1)])
