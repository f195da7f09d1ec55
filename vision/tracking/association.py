"""Association of detections with tracks: the set of pairs with the largest total overlap.

The assignment problem is solved exactly, by shortest augmenting paths (R. Jonker, A. Volgenant, "A shortest
augmenting path algorithm for dense and sparse linear assignment problems", Computing 38, 1987).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Pairs = list[tuple[int, int]]

# Boxes of two classes that overlap by this IoU belong to one object; a rider and the bicycle overlap less.
SAME_OBJECT_IOU = 0.7


def overlaps(first: NDArray[np.floating], second: NDArray[np.floating]) -> NDArray[np.float64]:
    """Intersection over union of (N, 4) and (M, 4) boxes xyxy → (N, M); 0 where both are empty."""
    one, other = np.asarray(first, np.float64), np.asarray(second, np.float64)
    sides = np.minimum(one[:, None, 2:], other[:, 2:]) - np.maximum(one[:, None, :2], other[:, :2])
    np.maximum(sides, 0.0, out=sides)
    common = sides[..., 0] * sides[..., 1]
    union = _area(one)[:, None] + _area(other) - common
    iou: NDArray[np.float64] = np.divide(common, union, out=np.zeros_like(common), where=union > 0.0)
    return iou


def _area(boxes: NDArray[np.float64]) -> NDArray[np.float64]:
    area: NDArray[np.float64] = np.maximum(boxes[:, 2] - boxes[:, 0], 0.0) * np.maximum(
        boxes[:, 3] - boxes[:, 1], 0.0
    )
    return area


def enlarge(boxes: NDArray[np.floating], share: float) -> NDArray[np.float64]:
    """(N, 4) boxes xyxy, extended on every side by `share` of their size (geometric mean of the sides)."""
    corners = np.asarray(boxes, np.float64)
    if not share:
        return corners
    margin = share * np.sqrt(_area(corners))[:, None]
    larger: NDArray[np.float64] = np.concatenate([corners[:, :2] - margin, corners[:, 2:] + margin], axis=1)
    return larger


def match(similarity: NDArray[np.float64], least: float) -> Pairs:
    """Find the pairs (row, column) with the largest sum of `similarity - least`, without repeats.

    Args:
        similarity: (N, M).
        least: pairs with a similarity not above this are excluded.

    Returns:
        Pairs in row order.
    """
    gain = similarity - least
    possible = gain > 0.0
    # Nearly always a track overlaps one detection and that detection overlaps no other track.
    unambiguous = possible & (possible.sum(axis=1) == 1)[:, None] & (possible.sum(axis=0) == 1)[None, :]
    pairs = [(int(row), int(column)) for row, column in np.argwhere(unambiguous)]
    ambiguous = possible & ~unambiguous
    if not ambiguous.any():
        return pairs
    rows, columns = ambiguous.any(axis=1).nonzero()[0], ambiguous.any(axis=0).nonzero()[0]
    part = gain[rows[:, None], columns].clip(0.0)
    pairs += [
        (int(rows[row]), int(columns[column])) for row, column in assign(-part) if part[row, column] > 0.0
    ]
    return sorted(pairs)


def assign(cost: NDArray[np.float64]) -> Pairs:
    """Find the pairs (row, column) with the smallest total cost that use all rows or all columns.

    Args:
        cost: (N, M), finite.

    Returns:
        min(N, M) pairs in row order.

    Raises:
        ValueError: a cost is not finite.
    """
    cost = np.asarray(cost, np.float64)
    if not np.isfinite(cost).all():
        raise ValueError("every cost must be finite; give excluded pairs a large cost")
    if cost.shape[0] > cost.shape[1]:
        return sorted((row, column) for column, row in assign(cost.T))
    rows, columns = cost.shape
    # Initial assignment: each row gets its cheapest column if no earlier row has it.
    row_price, column_price = cost.min(axis=1, initial=np.inf), np.zeros(columns)
    row_of, column_of = np.full(columns, -1), np.full(rows, -1)
    for row, column in enumerate(cost.argmin(axis=1).tolist() if columns else ()):
        if row_of[column] < 0:
            row_of[column], column_of[row] = row, column
    for start in (column_of < 0).nonzero()[0].tolist():
        # The cheapest alternating path from this row to a free column (Dijkstra on reduced costs).
        distance = np.full(columns, np.inf)
        reached_from = np.full(columns, start)
        done = np.zeros(columns, np.bool_)
        row, path_cost = start, 0.0
        while True:
            through = path_cost + cost[row] - row_price[row] - column_price
            cheaper = (through < distance) & ~done
            distance[cheaper] = through[cheaper]
            reached_from[cheaper] = row
            column = int(np.argmin(np.where(done, np.inf, distance)))
            path_cost = float(distance[column])
            if row_of[column] < 0:
                break
            done[column] = True
            row = int(row_of[column])
        # Dual prices that keep every reduced cost at or above zero, and at zero for the chosen pairs.
        row_price[start] += path_cost
        row_price[row_of[done]] += path_cost - distance[done]
        column_price[done] -= path_cost - distance[done]
        while True:
            row = int(reached_from[column])
            before = int(column_of[row])
            row_of[column], column_of[row] = row, column
            if row == start:
                break
            column = before
    return [(row, int(column)) for row, column in enumerate(column_of)]
