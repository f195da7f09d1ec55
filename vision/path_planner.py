"""Paths around obstacles on an occupancy grid: A*, shortcuts, rounded corners. Local NED, metres.

Cells nearer to an occupied cell than the clearance are blocked. Cells that were never observed may be crossed
at a higher cost; how far a path is observed free is part of the result, and only that far may be flown. Where
no point of the reference can be reached, the path leads to the reachable cell nearest to its end.
"""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from vision.obstacle_sectors import SECTOR_RAD, SECTORS
from vision.occupancy_grid import BLOCK, CELL_M, SIZE, OccupancyGrid, Point

# Cost per metre: 1, plus these.
UNKNOWN_COST = 1.0
# Near obstacles: falls to 0 at this distance beyond the clearance.
NEAR_COST, NEAR_M = 1.0, 0.6
# Away from the reference, per metre up to the limit: a path is followed where it is free.
AWAY_COST_PER_M, AWAY_LIMIT_M = 0.7, 2.0
# Away from the newest path: of two ways of about the same cost the vehicle stays on the one it has begun.
SWITCH_COST, SWITCH_M = 0.4, 1.0
# A vehicle inside the clearance first flies out of it, to a cell within this distance.
ESCAPE_M = 2.0
# Inside by more: deviations from a path are smaller, and the obstacle limits' margin begins here.
INSIDE_M = 0.2
NEARBY_M = 3.0
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
        number: of the active behaviour; its paths have the same.
    """

    reference: tuple[Point, ...]
    clearance_m: float
    number: int = 0


@dataclass(frozen=True, slots=True)
class PlannedPath:
    """A path, or why there is none.

    Attributes:
        captured_ns: stamp of the newest depth image that it uses.
        points: (north, east) metres, two or more from the vehicle on; empty: no way.
        free_m: length of its beginning that was observed to be free.
        reason: why there is no way; empty if there is one.
        number: of the request.
        inside: the vehicle is nearer to an obstacle than the clearance by more than `INSIDE_M`; the path's
            first leg leads away from it.
        near: (north, east) metres, the nearest occupied cell within `NEARBY_M` of the vehicle in each of 72
            directions.
    """

    captured_ns: int
    points: tuple[Point, ...]
    free_m: float = 0.0
    reason: str = ""
    number: int = 0
    inside: bool = False
    near: tuple[Point, ...] = ()


def plan_path(
    grid: OccupancyGrid, request: PathRequest, position: Point, newest: PlannedPath | None = None
) -> PlannedPath:
    """Plan from the vehicle's position along the reference.

    Args:
        newest: the path before, of the same request number; None: there is none.

    Raises:
        ValueError: the reference has no points.
    """
    if not request.reference:
        raise ValueError("a path request needs at least one point")
    field = _Field(grid, request, () if newest is None else newest.points)
    near = _nearby(grid, position)
    try:
        start = field.start(position)
        end = field.end(start, position)
    except _NoWayError as why:
        return PlannedPath(grid.captured_ns, (), reason=str(why), number=request.number, near=near)
    nodes = field.search(start, field.node(end))
    points = np.vstack((position, field.positions(nodes[1:-1] or [start]), end))
    points = field.rounded(field.shortened(points))
    free_m = field.free_length(points)
    path = tuple((float(north), float(east)) for north, east in points)
    return PlannedPath(grid.captured_ns, path, free_m, "", request.number, field.inside(position), near)


class _NoWayError(Exception):
    """There is no path; the message says why."""


class _Field:
    """Clearance and cost of every cell for one request."""

    def __init__(self, grid: OccupancyGrid, request: PathRequest, newest: Sequence[Point]) -> None:
        self._grid, self._clearance_m = grid, request.clearance_m
        self.reference = np.array(request.reference, np.float64)
        blocked = grid.occupied.astype(np.uint8)
        self._gap_m = cv2.distanceTransform(1 - blocked, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) * CELL_M
        self.passable = self._gap_m >= self._clearance_m
        near = np.clip(1.0 - (self._gap_m - self._clearance_m) / NEAR_M, 0.0, 1.0)
        away = np.minimum(self._away_m(self.reference), AWAY_LIMIT_M)
        unknown = ~(grid.free | grid.occupied)
        self.cost = 1.0 + UNKNOWN_COST * unknown + NEAR_COST * near + AWAY_COST_PER_M * away
        if newest:
            self.cost += SWITCH_COST * np.minimum(self._away_m(np.array(newest)) / SWITCH_M, 1.0)
        self._cells = _freest_cells(self._gap_m)
        nodes = self.passable[self._cells[..., 0], self._cells[..., 1]].astype(np.uint8)
        _, self._region = cv2.connectedComponents(nodes, connectivity=8)

    def inside(self, position: Point) -> bool:
        """Whether the vehicle is inside the clearance by more than the deviation from a path."""
        row, column = self._grid.cells(np.array([position]))[0]
        return bool(self._gap_m[row, column] < self._clearance_m - INSIDE_M)

    def start(self, position: Point) -> tuple[int, int]:
        """The passable node nearest to the vehicle, of those to which a straight line leads out.

        The line enters no occupied cell, and until the clearance is reached the gap does not shrink by more
        than a cell. Raises _NoWayError.
        """
        nodes = np.argwhere(self._region)
        away_m = np.hypot(*(self.positions(nodes) - position).T)
        order = np.argsort(away_m, kind="stable")[: np.count_nonzero(away_m <= ESCAPE_M)]
        spans = self.positions(nodes[order]) - position
        share = np.linspace(0.0, 1.0, math.ceil(ESCAPE_M / SPACING_M) + 1)
        rows, columns = self._grid.cells((position + share[:, None, None] * spans).reshape(-1, 2)).T
        gap_m = self._gap_m[rows, columns].reshape(len(share), -1)
        most_m = np.maximum.accumulate(gap_m, axis=0)
        out = (gap_m >= np.minimum(most_m, self._clearance_m) - CELL_M) & ((gap_m > 0.0) | (most_m == 0.0))
        leads_out = np.flatnonzero(out.all(axis=0))
        if not len(leads_out):
            row, column = self._grid.cells(np.array([position]))[0]
            raise _NoWayError(
                f"obstacles on all sides, the nearest {self._gap_m[row, column]:.1f} m away; "
                f"{self._clearance_m:g} m are needed"
            )
        row, column = nodes[order[leads_out[0]]]
        return int(row), int(column)

    def end(self, start: tuple[int, int], position: Point) -> NDArray[np.float64]:
        """Where the path may end: the last point of the reference that can be reached. Raises _NoWayError."""
        points = _sampled(self.reference, CELL_M)
        cells = self._grid.cells(points)
        border = math.ceil(BORDER_M / CELL_M)
        inside = ((cells >= border) & (cells < SIZE - border)).all(axis=1)
        far = np.hypot(*(points - position).T) >= LEAST_M
        far[-1] = True  # the goal itself may be near
        points, cells = points[inside & far], cells[inside & far]
        if not len(points):
            raise _NoWayError("the path to follow is outside the map around the vehicle")
        passable = self.passable[cells[:, 0], cells[:, 1]]
        here = self._region[start]
        reached = np.flatnonzero(passable & (self._region[*(cells // BLOCK).T] == here))
        if len(reached):
            end: NDArray[np.float64] = points[reached[-1]]
            return end
        part = self._grid.points(self._cells[self._region == here])
        left_m = np.hypot(*(part - self.reference[-1]).T)
        if left_m.min() < math.dist(position, self.reference[-1]) - LEAST_M:
            nearest: NDArray[np.float64] = part[np.argmin(left_m)]
            return nearest
        if passable[-1]:
            raise _NoWayError(f"no gap of {2 * self._clearance_m:.1f} m between the obstacles seen")
        gap_m = self._gap_m[cells[-1][0], cells[-1][1]]
        raise _NoWayError(f"an obstacle is {gap_m:.1f} m from the goal; {self._clearance_m:g} m are needed")

    def node(self, point: NDArray[np.float64]) -> tuple[int, int]:
        """The node at a point."""
        row, column = self._grid.cells(point[None, :])[0] // BLOCK
        return int(row), int(column)

    def positions(self, nodes: NDArray[np.int64] | Sequence[tuple[int, int]]) -> NDArray[np.float64]:
        """(N, 2) metres north, east of (N, 2) nodes."""
        rows, columns = np.asarray(nodes).T
        return self._grid.points(self._cells[rows, columns])

    def search(self, start: tuple[int, int], end: tuple[int, int]) -> list[tuple[int, int]]:
        """A*: the nodes of the cheapest path, both ends included; they must be connected."""
        # Plain lists with a blocked border: element access is several times faster than in an array.
        cost = self.cost[self._cells[..., 0], self._cells[..., 1]]
        half = np.pad(np.where(self._region == 0, math.inf, cost) / 2.0, 1)
        half[[0, -1], :] = half[:, [0, -1]] = math.inf
        side = len(half)
        rows, columns = np.indices(half.shape)
        left = np.hypot(rows - end[0] - 1, columns - end[1] - 1).ravel().tolist()
        costs: list[float] = half.ravel().tolist()
        first, goal = ((row + 1) * side + column + 1 for row, column in (start, end))
        moves = [(down * side + right, math.hypot(down, right)) for down, right in _NEIGHBOURS]
        best, before = [math.inf] * len(costs), [first] * len(costs)
        best[first] = 0.0
        queue = [(left[first], first)]
        done = bytearray(len(costs))
        while queue:
            _, here = heapq.heappop(queue)
            if here == goal:
                break
            if done[here]:
                continue
            done[here] = 1
            so_far, here_cost = best[here], costs[here]
            for by, length in moves:
                there = here + by
                total = so_far + length * (here_cost + costs[there])
                if total < best[there]:
                    best[there], before[there] = total, here
                    heapq.heappush(queue, (total + left[there], there))
        path = [goal]
        while path[-1] != first:
            path.append(before[path[-1]])
        return [(at // side - 1, at % side - 1) for at in reversed(path)]

    def shortened(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """The same path with straight lines wherever these are passable and cost no more."""
        legs = np.minimum(self._costs(points[:-1], points[1:]), BLOCKED_COST)
        along = np.concatenate(([0.0], np.cumsum(legs)))
        kept = [0]
        while (index := kept[-1]) < len(points) - 1:
            costs = self._costs(points[index], points[index + 1 :])
            costs[0] = -math.inf  # the next one always is passable
            kept.append(
                index + 1 + int(np.flatnonzero(costs <= 1.02 * (along[index + 1 :] - along[index]))[-1])
            )
        return points[kept]

    def rounded(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """The path with its corners cut twice (Chaikin 1974), where the cut is passable."""
        for _ in range(2):
            corners = points[1:-1]
            entries, leavings = (corners + 0.25 * (other - corners) for other in (points[:-2], points[2:]))
            cut = np.isfinite(self._costs(entries, leavings))
            parts = [
                (entry, leaving) if passable else (corner,)
                for entry, corner, leaving, passable in zip(entries, corners, leavings, cut, strict=True)
            ]
            points = np.array([points[0], *itertools.chain(*parts), points[-1]])
        return points

    def free_length(self, points: NDArray[np.float64]) -> float:
        """Length of the path's beginning that was observed to be free."""
        sampled = _sampled(points, SPACING_M)
        along = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(sampled, axis=0).T))))
        cells = self._grid.cells(sampled)
        unseen = ~self._grid.free[cells[:, 0], cells[:, 1]] & (along > UNSEEN_M)
        return float(along[np.argmax(unseen)] if unseen.any() else along[-1])

    def _costs(self, starts: NDArray[np.float64], ends: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N,) costs of straight lines between points, (N, 2) or (2,); infinite where one is blocked."""
        spans = ends - starts
        lengths = np.hypot(spans[:, 0], spans[:, 1])
        share = np.linspace(0.0, 1.0, max(2, math.ceil(lengths.max(initial=0.0) / SPACING_M) + 1))
        points = (starts + share[:, None, None] * spans).reshape(-1, 2)
        rows, columns = self._grid.cells(points).T
        shape = (len(share), len(spans))
        passable = self.passable[rows, columns].reshape(shape).all(axis=0)
        mean = self.cost[rows, columns].reshape(shape).mean(axis=0)
        return np.where(passable, mean * lengths, math.inf)

    def _away_m(self, points: NDArray[np.float64]) -> NDArray[np.float32]:
        """Distance of every cell from a line."""
        line = np.ones((SIZE, SIZE), np.uint8)
        cells = self._grid.cells(points)[:, ::-1]  # OpenCV's x is the column
        cv2.polylines(line, [cells.astype(np.int32)], False, 0)
        away: NDArray[np.float32] = cv2.distanceTransform(line, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) * CELL_M
        return away


def _freest_cells(gap_m: NDArray[np.float32]) -> NDArray[np.int64]:
    """(N, N, 2): of every block the cell farthest from obstacles.

    It is the search's node: with a fixed cell of each block, a gap of one cell would be open or closed.
    """
    count = SIZE // BLOCK
    blocks = gap_m.reshape(count, BLOCK, count, BLOCK).swapaxes(1, 2).reshape(count, count, BLOCK * BLOCK)
    within = np.stack(np.divmod(blocks.argmax(axis=2), BLOCK), axis=-1)
    corners = np.moveaxis(np.indices((count, count)), 0, -1) * BLOCK
    cells: NDArray[np.int64] = corners + within
    return cells


def _nearby(grid: OccupancyGrid, position: Point) -> tuple[Point, ...]:
    """`PlannedPath.near`."""
    points = grid.points(np.argwhere(grid.occupied))
    north, east = (points - position).T
    away_m = np.hypot(north, east)
    order = np.argsort(away_m, kind="stable")[: np.count_nonzero(away_m <= NEARBY_M)]
    _, first = np.unique(
        np.rint(np.arctan2(east[order], north[order]) / SECTOR_RAD) % SECTORS, return_index=True
    )
    return tuple((float(north), float(east)) for north, east in points[order[first]])


def _sampled(points: NDArray[np.float64], spacing_m: float) -> NDArray[np.float64]:
    """The polyline with a point at least every `spacing_m`, its first and last included."""
    lengths = np.hypot(*np.diff(points, axis=0).T) if len(points) > 1 else np.zeros(0)
    along = np.concatenate(([0.0], np.cumsum(lengths)))
    wanted = np.linspace(0.0, along[-1], max(2, math.ceil(along[-1] / spacing_m) + 1))
    return np.column_stack([np.interp(wanted, along, points[:, axis]) for axis in (0, 1)])
