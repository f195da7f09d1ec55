"""Formation geometry: slot offsets, slot assignment, and the motion of a slot with its leader.

Offsets are (forward, right, down) metres in a level frame that turns with the leader's heading.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Vector3 = tuple[float, float, float]

SHAPES = ("line", "column", "wedge", "circle")
# Angle by which each arm of a wedge is swept back from line abreast.
WEDGE_SWEEP_RAD = math.pi / 4


def slots(shape: str, count: int, spacing_m: float, *, centre_taken: bool = True) -> list[Vector3]:
    """Offsets of `count` slots, at least `spacing_m` apart, in the order in which they are filled.

    * line: abreast, alternately right and left of the leader. * column: one behind the other.
    * wedge: a V open to the back, alternately right and left. * circle: about the leader, the first ahead.

    Args:
        count: number of slots, without the leader's position. spacing_m: between neighbours.
        centre_taken: the leader is a vehicle at (0, 0, 0); False: (0, 0, 0) is the first slot of line,
            column and wedge (a circle has no slot there).

    Raises:
        ValueError: unknown shape, negative count, or a spacing that is not finite and positive.
    """
    if shape not in SHAPES:
        raise ValueError(f"shape must be one of {', '.join(SHAPES)}, got {shape!r}")
    if count < 0:
        raise ValueError(f"count must be 0 or more, got {count}")
    if not (math.isfinite(spacing_m) and spacing_m > 0.0):
        raise ValueError(f"spacing_m must be finite and above 0, got {spacing_m}")
    if shape == "circle":
        return _circle(count, spacing_m)
    first = 1 if centre_taken else 0
    return [_slot(shape, number, spacing_m) for number in range(first, first + count)]


def _slot(shape: str, number: int, spacing_m: float) -> Vector3:
    """Offset of slot `number` of an open shape; 0 is the leader's position."""
    if shape == "column":
        return (-number * spacing_m, 0.0, 0.0)
    side = 1.0 if number % 2 else -1.0
    rank = (number + 1) // 2 * spacing_m
    if shape == "line":
        return (0.0, side * rank, 0.0)
    return (-rank * math.sin(WEDGE_SWEEP_RAD), side * rank * math.cos(WEDGE_SWEEP_RAD), 0.0)


def _circle(count: int, spacing_m: float) -> list[Vector3]:
    """Neighbours are `spacing_m` apart along the chord; the radius is at least `spacing_m`."""
    radius_m = spacing_m if count < 2 else max(spacing_m, spacing_m / 2.0 / math.sin(math.pi / count))
    angles = [math.tau * number / count for number in range(count)]
    return [(radius_m * math.cos(angle), radius_m * math.sin(angle), 0.0) for angle in angles]


def assign(positions: Sequence[Vector3], offsets: Sequence[Vector3]) -> list[int]:
    """Assign vehicles to slots with the least sum of squared distances.

    The straight paths then never meet. Let i fly from x to g and j from y to h. Exchanging them is no better,
    so |x-g|² + |y-h|² <= |x-h|² + |y-g|², which is (x-y)·(g-h) >= 0. After the fraction t of both paths their
    separation is (1-t)(x-y) + t(g-h); its square is at least (1-t)²|x-y|² + t²|g-h|², never less than half of
    the smaller of |x-y|² and |g-h|². Vehicles under one proportional law have covered the same fraction at
    any time (Turpin, Michael, Kumar 2014, "CAPT: Concurrent assignment and planning of trajectories for
    multiple robots").

    Args:
        positions: of the vehicles, in the frame of the offsets. offsets: at least as many slots.

    Returns:
        The slot index of every vehicle, each used once. Hungarian method (Kuhn 1955, Munkres 1957) by
        shortest augmenting paths (Jonker, Volgenant 1987): O(vehicles² · slots).

    Raises:
        ValueError: fewer slots than vehicles, or a position or offset that is not finite.
    """
    if len(positions) > len(offsets):
        raise ValueError(f"{len(positions)} vehicles need as many slots, got {len(offsets)}")
    if not positions:
        return []
    here, there = np.asarray(positions, dtype=np.float64), np.asarray(offsets, dtype=np.float64)
    if not np.isfinite(here).all() or not np.isfinite(there).all():
        raise ValueError("every position and every offset must be finite")
    cost = ((here[:, None, :] - there[None, :, :]) ** 2).sum(axis=2)
    return least_cost(cost)


def least_cost(cost: NDArray[np.float64]) -> list[int]:
    """Least-cost assignment: the column of every row of a (rows, columns) matrix, each used once.

    There are at least as many columns as rows. Ties go to the earlier column.
    """
    rows, columns = cost.shape
    row_price, column_price = np.zeros(rows), np.zeros(columns)
    row_of = np.full(columns, -1)
    for start in range(rows):
        # Dijkstra over columns; the prices keep the reduced costs non-negative.
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


def rotate(offset: Vector3, heading_rad: float) -> Vector3:
    """Rotate an offset (forward, right, down) by a heading into (north, east, down)."""
    cosine, sine = math.cos(heading_rad), math.sin(heading_rad)
    return (offset[0] * cosine - offset[1] * sine, offset[0] * sine + offset[1] * cosine, offset[2])


def slot_motion(
    leader: Vector3, velocity: Vector3, heading_rad: float, turn_rate_radps: float, offset: Vector3
) -> tuple[Vector3, Vector3]:
    """Position (NED metres) and velocity (NED m/s) of a slot.

    The velocity is the leader's plus that of its turn: omega x offset, with omega straight down.
    """
    north, east, down = rotate(offset, heading_rad)
    position = (leader[0] + north, leader[1] + east, leader[2] + down)
    moving = (velocity[0] - turn_rate_radps * east, velocity[1] + turn_rate_radps * north, velocity[2])
    return position, moving


def radius_m(offsets: Sequence[Vector3]) -> float:
    """Horizontal distance of the outermost slot, metres."""
    return max((math.hypot(offset[0], offset[1]) for offset in offsets), default=0.0)
