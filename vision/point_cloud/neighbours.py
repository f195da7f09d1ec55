"""Neighbours within a radius, and what is connected by them: a grid of cells in numpy, without a tree.

Points are sorted by cell, the z axis fastest, so that the candidates of a point in cells above each other are
one range of the sorted points. The cost grows with the number of pairs: reduce a dense cloud with
`voxel_grid` first.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# More candidate pairs than this are some gigabytes: the radius is too large for the cloud.
MAX_CANDIDATES = 50_000_000
# Cells are a fourth as high as wide: those within the radius above and below are a closer range.
_FLATTER = 4
# Half of the columns of cells about a cell; the others are found from the other side.
_COLUMNS = ((0, 1), (1, -1), (1, 0), (1, 1))


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """Each pair of different points within the radius, once.

    Attributes:
        first, second: (P,) int64 indices of points.
        squared_m2: (P,) float32, their squared distance.
        count: number of points.
    """

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    squared_m2: NDArray[np.float32]
    count: int

    def counts(self) -> NDArray[np.int64]:
        """(N,) number of neighbours of each point."""
        return np.bincount(self.first, minlength=self.count) + np.bincount(self.second, minlength=self.count)


def cell_keys(
    points: NDArray[np.float32], size_m: float, flatter: int = 1
) -> tuple[NDArray[np.int64], tuple[int, int, int]]:
    """(N,) number of each point's cell, and how many cells there are along x, y, z.

    Cell borders are multiples of `size_m`. There are `flatter` empty cells around all others, so that the
    neighbour of a cell is never one at the other end.

    Args:
        flatter: height of the cells, a fraction 1 / `flatter` of `size_m`.

    Raises:
        ValueError: the size is not above zero, or the cloud has more than 2^62 cells of that size.
    """
    if not size_m > 0.0:
        raise ValueError(f"a cell's size must be above 0 m, got {size_m}")
    if not len(points):
        return np.zeros(0, np.int64), (2, 2, 2)
    per_m = (1.0 / size_m, 1.0 / size_m, flatter / size_m)
    columns = [np.floor(points[:, axis] * np.float32(per_m[axis])) for axis in range(3)]
    lowest = [int(column.min()) for column in columns]
    shape = [int(column.max()) - low + 1 + 2 * flatter for column, low in zip(columns, lowest, strict=True)]
    if shape[0] * shape[1] * shape[2] > 1 << 62 or max(map(abs, lowest)) > 1 << 62:
        raise ValueError(f"cells of {size_m} m are too small for a cloud of this extent")
    keys = np.zeros(len(points), np.int64)
    for column, low, length in zip(columns, lowest, shape, strict=True):
        keys *= length
        keys += column.astype(np.int64) - (low - flatter)
    return keys, (shape[0], shape[1], shape[2])


def neighbour_pairs(points: NDArray[np.float32], radius_m: float) -> Pairs:
    """The pairs of points at most `radius_m` apart.

    Args:
        points: (N, 3) float32 metres.

    Raises:
        ValueError: there are more than `MAX_CANDIDATES` pairs to compare.
    """
    # A little larger: rounding of a quotient must not move a neighbour two cells away.
    keys, (_, across, deep) = cell_keys(points, radius_m * 1.0001, _FLATTER)
    order = np.argsort(keys, kind="stable")
    cells, starts, sizes = np.unique(keys[order], return_index=True, return_counts=True)
    bounds = np.append(starts, len(keys))
    cell_of = np.repeat(np.arange(len(cells)), sizes)
    index = np.arange(len(keys))

    # In the own column: all later points up to the radius.
    begins, ends = [index + 1], [bounds[np.searchsorted(cells, cells + _FLATTER, "right")][cell_of]]
    for x, y in _COLUMNS:
        column = cells + (x * across + y) * deep
        begins.append(bounds[np.searchsorted(cells, column - _FLATTER)][cell_of])
        ends.append(bounds[np.searchsorted(cells, column + _FLATTER, "right")][cell_of])
    lengths = [np.maximum(end - begin, 0) for begin, end in zip(begins, ends, strict=True)]
    total = sum(int(length.sum()) for length in lengths)
    if total > MAX_CANDIDATES:
        raise ValueError(
            f"{len(points)} points have {total} pairs to compare within {radius_m} m, the limit is "
            f"{MAX_CANDIDATES}: use a smaller radius or a voxel grid first"
        )
    sorted_points = [np.ascontiguousarray(points[order, axis]) for axis in range(3)]
    parts = [
        _within(sorted_points, begin, length, np.float32(radius_m * radius_m))
        for begin, length in zip(begins, lengths, strict=True)
    ]
    first, second, squared = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return Pairs(order[first], order[second], squared, len(points))


def _within(
    points: list[NDArray[np.float32]], begin: NDArray[np.int64], length: NDArray[np.int64], limit: np.float32
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float32]]:
    """Of the candidates `begin` to `begin + length` of each sorted point: those within the limit."""
    ends = np.cumsum(length)
    first = np.repeat(np.arange(len(begin)), length)
    second = np.arange(len(first)) + np.repeat(begin - (ends - length), length)
    squared = np.zeros(len(first), np.float32)
    for values in points:
        difference = values[first] - values[second]
        squared += difference * difference
    near = np.flatnonzero(squared <= limit)
    return first[near], second[near], squared[near]


def connected(pairs: Pairs) -> NDArray[np.int64]:
    """(N,) label of each point's connected part: the lowest index in it.

    Labels are lowered along all pairs at once and then replaced by the label of the label, until nothing
    changes (after Zhang, Azad and Hu 2020, "FastSV").
    """
    labels = np.arange(pairs.count)
    first, second = pairs.first, pairs.second
    while len(first):
        one, other = labels[first], labels[second]
        apart = one != other
        if not apart.any():
            break
        one, other, first, second = one[apart], other[apart], first[apart], second[apart]
        np.minimum.at(labels, np.maximum(one, other), np.minimum(one, other))
        while True:
            above = labels[labels]
            if np.array_equal(above, labels):
                break
            labels = above
    return labels
