"""A rolling occupancy grid around the vehicle: level, local NED, in the height band of the obstacle sectors.

Each depth image gives the nearest obstacle in 360 directions (`nearest_ranges`). Cells before it become free,
cells at it occupied (log-odds; Moravec and Elfes 1985, "High resolution maps from wide angle sonar").
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from vision.obstacle_sectors import ABOVE_M, BELOW_M

CELL_M = 0.2
# Cells on a side: 40 m.
SIZE = 200
# The grid moves by so many cells, so that blocks of them, the nodes of a path search, keep their positions.
BLOCK = 2
DIRECTIONS = 360
# Farther than this a small stereo camera's error (1 m at 10 m) is larger than the obstacles.
RANGE_M = 10.0
# Cells within this distance before an obstacle stay as they are: its range may be too large by that.
BEFORE_M = 0.3
# Log-odds of one observation. A hit from farther than NEAR_M counts less.
HIT, FAR_HIT, NEAR_M = 0.9, 0.45, 5.0
MISS = 0.4
LOWEST, HIGHEST = -2.0, 3.0
OCCUPIED, FREE = 0.6, -0.6
# At another height the band shows other obstacles. A free cell is unknown where the vehicle would leave the
# band that was observed; in gusts it moves by half a metre. An occupied one is unknown where the bands do not
# overlap.
FREE_HEIGHT_M, OCCUPIED_HEIGHT_M = 0.6, ABOVE_M + BELOW_M

Point = tuple[float, float]


class OccupancyGrid:
    """The grid.

    Attributes:
        log_odds: (SIZE, SIZE) float32, axes north and east; 0: never observed.
        corner: (north, east) of the first cell, in whole cells from the local origin; multiples of `BLOCK`.
        captured_ns: stamp of the newest image; 0 before the first.
    """

    def __init__(self) -> None:
        self.log_odds: NDArray[np.float32] = np.zeros((SIZE, SIZE), np.float32)
        self.corner = (0, 0)
        self.captured_ns = 0
        self._down_m = 0.0
        self._seen_down_m: NDArray[np.float32] = np.zeros((SIZE, SIZE), np.float32)

    @property
    def occupied(self) -> NDArray[np.bool_]:
        """(SIZE, SIZE): cells with an obstacle at the vehicle's height."""
        return (self.log_odds > OCCUPIED) & (self._other_height_m() <= OCCUPIED_HEIGHT_M)

    @property
    def free(self) -> NDArray[np.bool_]:
        """(SIZE, SIZE): cells that were observed to be free at the vehicle's height."""
        return (self.log_odds < FREE) & (self._other_height_m() <= FREE_HEIGHT_M)

    def update(
        self, ranges_m: NDArray[np.float64], position_ned_m: tuple[float, float, float], captured_ns: int
    ) -> None:
        """Add one image.

        Args:
            ranges_m: (DIRECTIONS,) from `nearest_ranges`, clockwise from north.
            position_ned_m: of the vehicle at the capture.
        """
        north_m, east_m, self._down_m = position_ned_m
        self._centre(north_m, east_m)
        self.captured_ns = captured_ns

        reach = math.ceil(RANGE_M / CELL_M)
        row, column = (int(index) for index in self.cells(np.array([[north_m, east_m]]))[0])
        window = (slice(row - reach, row + reach + 1), slice(column - reach, column + reach + 1))
        steps = (np.arange(-reach, reach + 1) + 0.5) * CELL_M
        north = steps + (self.corner[0] + row) * CELL_M - north_m
        east = steps + (self.corner[1] + column) * CELL_M - east_m
        away_m = np.hypot(north[:, None], east[None, :])
        bearing = np.arctan2(east[None, :], north[:, None]) * (DIRECTIONS / math.tau)
        seen_m = ranges_m[np.rint(bearing).astype(np.int64) % DIRECTIONS]
        with np.errstate(invalid="ignore"):  # unobserved directions are NaN
            before = away_m < np.minimum(seen_m - BEFORE_M, RANGE_M)
        change = np.float32(-MISS) * before

        hit = np.flatnonzero(ranges_m < RANGE_M)
        angle, range_m = hit * (math.tau / DIRECTIONS), ranges_m[hit]
        points = np.column_stack((north_m + range_m * np.cos(angle), east_m + range_m * np.sin(angle)))
        rows, columns = (self.cells(points) - (row - reach, column - reach)).T
        # Twice in one image counts once: near obstacles fill many directions.
        change[rows, columns] += np.where(range_m < NEAR_M, HIT, FAR_HIT)

        observed, log_odds, down = change != 0.0, self.log_odds[window], self._seen_down_m[window]
        valid_m = np.where(log_odds < 0.0, FREE_HEIGHT_M, OCCUPIED_HEIGHT_M)
        log_odds[observed & (np.abs(down - self._down_m) > valid_m)] = 0.0
        down[observed] = self._down_m
        np.clip(log_odds + change, LOWEST, HIGHEST, out=log_odds)

    def cells(self, points: NDArray[np.float64]) -> NDArray[np.int64]:
        """(N, 2) indices of (N, 2) points north, east in metres; outside 0..SIZE-1: not in the grid."""
        indices: NDArray[np.int64] = np.floor(points / CELL_M).astype(np.int64) - self.corner
        return indices

    def points(self, cells: NDArray[np.int64]) -> NDArray[np.float64]:
        """(N, 2) metres north, east of the centres of (N, 2) cells."""
        points: NDArray[np.float64] = np.asarray((cells + self.corner + 0.5) * CELL_M, np.float64)
        return points

    def _centre(self, north_m: float, east_m: float) -> None:
        """Move the grid by whole blocks so that the vehicle is in its middle."""
        corner = tuple(
            BLOCK * math.floor(value / (BLOCK * CELL_M)) - SIZE // 2 for value in (north_m, east_m)
        )
        moved = (corner[0] - self.corner[0], corner[1] - self.corner[1])
        self.corner = (corner[0], corner[1])
        if max(map(abs, moved)) >= SIZE:
            self.log_odds[:] = 0.0
        elif moved != (0, 0):
            for grid in (self.log_odds, self._seen_down_m):
                grid[:] = np.roll(grid, (-moved[0], -moved[1]), (0, 1))
            for axis, by in enumerate(moved):
                entered = slice(SIZE - by, SIZE) if by > 0 else slice(0, -by)
                self.log_odds[(entered, slice(None)) if axis == 0 else (slice(None), entered)] = 0.0

    def _other_height_m(self) -> NDArray[np.float32]:
        """(SIZE, SIZE): difference of the vehicle's height from that at which a cell was observed."""
        other_m: NDArray[np.float32] = np.abs(self._seen_down_m - np.float32(self._down_m))
        return other_m
