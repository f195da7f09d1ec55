"""The geometry of formations: where the slots are, who takes which, and how a slot moves with its leader.

Offsets are (forward, right, down) metres in a frame that is level and turns with the leader's heading.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Vector3 = tuple[float, float, float]

SHAPES = ("line", "column", "wedge", "circle")
# Each arm of a wedge lies so far back from straight abreast.
WEDGE_SWEEP_RAD = math.pi / 4


def slots(shape: str, count: int, spacing_m: float, *, centre_taken: bool = True) -> list[Vector3]:
    """The offsets of `count` slots, no two of them nearer than `spacing_m`, the best filled first.

    * line: abreast, alternately right and left of the leader. * column: one behind the other.
    * wedge: a V open to the back, alternately right and left. * circle: about the leader, the first ahead.

    Args:
        count: of slots, without the leader's own place. spacing_m: of neighbours.
        centre_taken: the leader is a vehicle and flies at (0, 0, 0); False: its place is the first slot of
            line, column and wedge (of a circle nobody's).

    Raises:
        ValueError: a shape that is none, a negative count, or a spacing that is not finite and positive.
    """
    if shape not in SHAPES:
        raise ValueError(f"shape must be one of {', '.join(SHAPES)}, got {shape!r}")
    if count < 0:
        raise ValueError(f"a formation has 0 slots or more, got {count}")
    if not (math.isfinite(spacing_m) and spacing_m > 0.0):
        raise ValueError(f"spacing_m must be finite and above 0, got {spacing_m}")
    if shape == "circle":
        return _circle(count, spacing_m)
    first = 1 if centre_taken else 0
    return [_slot(shape, number, spacing_m) for number in range(first, first + count)]


def _slot(shape: str, number: int, spacing_m: float) -> Vector3:
    """Slot `number` of an open shape; 0 is the leader's place."""
    if shape == "column":
        return (-number * spacing_m, 0.0, 0.0)
    side = 1.0 if number % 2 else -1.0
    rank = (number + 1) // 2 * spacing_m
    if shape == "line":
        return (0.0, side * rank, 0.0)
    return (-rank * math.sin(WEDGE_SWEEP_RAD), side * rank * math.cos(WEDGE_SWEEP_RAD), 0.0)


def _circle(count: int, spacing_m: float) -> list[Vector3]:
    """A chord between neighbours is the spacing, and so is the radius at least."""
    radius_m = spacing_m if count < 2 else max(spacing_m, spacing_m / 2.0 / math.sin(math.pi / count))
    angles = [math.tau * number / count for number in range(count)]
    return [(radius_m * math.cos(angle), radius_m * math.sin(angle), 0.0) for angle in angles]


def assign(places: Sequence[Vector3], offsets: Sequence[Vector3]) -> list[int]:
    """Which slot each vehicle takes: the least sum of squared distances.

    Then no two ways cross. Let i fly from x to g and j from y to h. Exchanging both would not be better, so
    |x-g|² + |y-h|² <= |x-h|² + |y-g|², which is (x-y)·(g-h) >= 0. Where both have done the share t of
    their straight ways they are (1-t)(x-y) + t(g-h) apart, and with that product not negative the square of
    it is at least (1-t)²|x-y|² + t²|g-h|², never less than half of the smaller of |x-y|² and |g-h|². Vehicles
    that fly to their slots by one proportional law have all done the same share at any time (Turpin, Michael,
    Kumar 2014, "CAPT: Concurrent assignment and planning of trajectories for multiple robots").

    Args:
        places: of the vehicles, in the frame of the offsets. offsets: of the slots, as many or more.

    Returns:
        For every vehicle the index of its slot, no slot twice. The way of Kuhn (1955) and Munkres (1957), by
        shortest augmenting paths (Jonker, Volgenant 1987): time grows with vehicles² · slots.

    Raises:
        ValueError: fewer slots than vehicles, or a place that is not finite.
    """
    if len(places) > len(offsets):
        raise ValueError(f"{len(places)} vehicles need as many slots, got {len(offsets)}")
    if not places:
        return []
    here, there = np.asarray(places, dtype=np.float64), np.asarray(offsets, dtype=np.float64)
    if not np.isfinite(here).all() or not np.isfinite(there).all():
        raise ValueError("every place and every offset must be finite")
    cost = ((here[:, None, :] - there[None, :, :]) ** 2).sum(axis=2)
    return least_cost(cost)


def least_cost(cost: NDArray[np.float64]) -> list[int]:
    """For every row of a (rows, columns) matrix its column, none twice, with the least sum of costs.

    There are as many columns as rows, or more. Ties go to the earlier column.
    """
    rows, columns = cost.shape
    row_price, column_price = np.zeros(rows), np.zeros(columns)
    row_of = np.full(columns, -1)
    for start in range(rows):
        # Dijkstra over columns, by costs that the prices have made non-negative.
        shortest, previous = np.full(columns, np.inf), np.full(columns, -1)
        done = np.zeros(columns, dtype=bool)
        row, column, reached = start, -1, 0.0
        tree = [(start, 0.0)]
        while row >= 0:
            reduced = reached + cost[row] - row_price[row] - column_price
            nearer = ~done & (reduced < shortest)
            shortest[nearer], previous[nearer] = reduced[nearer], column
            column = int(np.argmin(np.where(done, np.inf, shortest)))
            reached, done[column] = float(shortest[column]), True
            row = int(row_of[column])
            if row >= 0:
                tree.append((row, reached))
        for member, at in tree:
            row_price[member] += reached - at
        column_price[done] -= reached - shortest[done]
        while column >= 0:
            before = int(previous[column])
            row_of[column] = start if before < 0 else row_of[before]
            column = before
    found = [-1] * rows
    for column, row in enumerate(row_of):
        if row >= 0:
            found[row] = column
    return found


def turned(offset: Vector3, heading_rad: float) -> Vector3:
    """An offset (forward, right, down) as (north, east, down)."""
    cosine, sine = math.cos(heading_rad), math.sin(heading_rad)
    return (offset[0] * cosine - offset[1] * sine, offset[0] * sine + offset[1] * cosine, offset[2])


def slot_motion(
    leader: Vector3, velocity: Vector3, heading_rad: float, turn_rate_radps: float, offset: Vector3
) -> tuple[Vector3, Vector3]:
    """Where a slot is and how it moves: position NED metres, velocity NED m/s.

    The velocity is the leader's and what its turn adds: omega x offset, omega straight down.
    """
    north, east, down = turned(offset, heading_rad)
    position = (leader[0] + north, leader[1] + east, leader[2] + down)
    moving = (velocity[0] - turn_rate_radps * east, velocity[1] + turn_rate_radps * north, velocity[2])
    return position, moving


def radius_m(offsets: Sequence[Vector3]) -> float:
    """Of the outermost slot, over ground."""
    return max((math.hypot(offset[0], offset[1]) for offset in offsets), default=0.0)
