"""Filters of a point cloud: limits, voxel grid, statistical outliers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vision.point_cloud.cloud import PointCloud
from vision.point_cloud.neighbours import Pairs, cell_keys, neighbour_pairs

# Of the distances to neighbours.
_BINS = 16
# Up to this many cells are numbered by a table, in a third of the time of sorting the points.
_TABLE_CELLS = 1 << 25


def pass_through(cloud: PointCloud, axis: int, low_m: float = -np.inf, high_m: float = np.inf) -> PointCloud:
    """The points whose coordinate along `axis` (0, 1, 2) is between the limits, metres, both included."""
    values = cloud.points[:, axis]
    return cloud.select((values >= low_m) & (values <= high_m))


def voxel_grid(cloud: PointCloud, size_m: float) -> PointCloud:
    """One point for each occupied cube of a grid: the mean of its points and of their colours.

    The grid's borders are multiples of `size_m`, so that a second use with the same size changes nothing.
    Points are in the order of their cells: x slowest, z fastest.

    Raises:
        ValueError: the size is not above zero or too small for the cloud's extent.
    """
    keys, shape = cell_keys(cloud.points, size_m)
    if not len(keys):
        return cloud
    inverse, counts = _numbered(keys, shape[0] * shape[1] * shape[2])
    points = np.empty((len(counts), 3), np.float32)
    for axis in range(3):
        points[:, axis] = np.bincount(inverse, weights=cloud.points[:, axis]) / counts
    colours = None
    if cloud.colours is not None:
        colours = np.empty((len(counts), 3), np.uint8)
        for channel in range(3):
            mean = np.bincount(inverse, weights=cloud.colours[:, channel]) / counts
            colours[:, channel] = np.rint(mean)
    return replace(cloud, points=points, colours=colours)


def _numbered(keys: NDArray[np.int64], cells: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Each key's number among the ascending different keys, and how often each of these occurs."""
    if cells > _TABLE_CELLS:
        _, inverse, counts = np.unique(keys, return_inverse=True, return_counts=True)
        return inverse, counts
    occupied = np.zeros(cells, bool)
    occupied[keys] = True
    different = np.flatnonzero(occupied)
    table = np.empty(cells, np.int32)  # only what is written is used
    table[different] = np.arange(len(different), dtype=np.int32)
    inverse = table[keys].astype(np.int64)
    return inverse, np.bincount(inverse)


def remove_outliers(
    cloud: PointCloud, radius_m: float, neighbours: int = 8, deviations: float = 2.0
) -> PointCloud:
    """Remove points whose neighbours are unusually far away (Rusu et al. 2008, statistical outliers).

    Of each point the mean distance to its nearest `neighbours` is taken, in which one farther than `radius_m`
    counts as `radius_m`. Points whose mean exceeds the mean of all by `deviations` standard deviations go.

    Args:
        radius_m: two voxels' sides, after a voxel grid.

    Raises:
        ValueError: `neighbours` is below 1, or the radius too large for the cloud.
    """
    if neighbours < 1:
        raise ValueError(f"neighbours must be 1 or more, got {neighbours}")
    distance_m = _mean_distances(neighbour_pairs(cloud.points, radius_m), radius_m, neighbours)
    if not len(distance_m):
        return cloud
    limit_m = float(distance_m.mean() + deviations * distance_m.std())
    # Rounding must not remove the points of a regular cloud, which are all at the mean.
    return cloud.select(distance_m <= limit_m + 1e-6 * radius_m)


def _mean_distances(pairs: Pairs, radius_m: float, neighbours: int) -> NDArray[np.float64]:
    """(N,) mean distance to the nearest neighbours, missing ones at the radius.

    Distances are counted in bins, which is much faster than sorting them; the mean is right to half a bin.
    Each bin adds its width for each of the `neighbours` that is not nearer than it.
    """
    bins = np.minimum(np.sqrt(pairs.squared_m2) * np.float32(_BINS / radius_m), _BINS - 1).astype(np.int64)
    cells = pairs.count * _BINS
    histogram = np.bincount(pairs.first * _BINS + bins, minlength=cells)
    histogram += np.bincount(pairs.second * _BINS + bins, minlength=cells)
    histogram = histogram.reshape(pairs.count, _BINS)
    nearer = np.cumsum(histogram, axis=1) - 0.5 * histogram
    farther = np.maximum(neighbours - nearer, 0.0).sum(axis=1)
    mean: NDArray[np.float64] = farther * (radius_m / (_BINS * neighbours))
    return mean
