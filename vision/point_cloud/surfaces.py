"""Local shape of a point cloud: normals and key points; and its ground plane."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vision.point_cloud.cloud import PointCloud
from vision.point_cloud.neighbours import Pairs, neighbour_pairs

# Small products are written out: `@` wakes OpenBLAS's threads,
# which on a busy computer takes three times as long.

# Planes that are tried, and points they are tried on: with 30 % of the points on the plane, one of the
# triples is on it with a probability of 0.999 (Fischler and Bolles 1981).
_TRIPLES, _SAMPLED = 256, 1000
_REFINEMENTS = 3


@dataclass(frozen=True, slots=True, eq=False)
class Plane:
    """A plane: `normal @ p + offset_m = 0`, `normal` of length 1.

    Attributes:
        normal: (3,) float64. offset_m: signed distance of the origin.
        inliers: (N,) bool, the points within the tolerance.
    """

    normal: NDArray[np.float64]
    offset_m: float
    inliers: NDArray[np.bool_]

    def heights_m(self, points: NDArray[np.float32]) -> NDArray[np.float32]:
        """(N,) signed distance of points, positive on the normal's side."""
        x, y, z = self.normal.astype(np.float32)
        heights: NDArray[np.float32] = points[:, 0] * x + points[:, 1] * y + points[:, 2] * z
        heights += np.float32(self.offset_m)
        return heights


def ground_plane(
    cloud: PointCloud,
    down: NDArray[np.float64],
    *,
    tolerance_m: float = 0.1,
    max_tilt_rad: float = math.radians(20.0),
    seed: int = 0,
) -> Plane | None:
    """The plane with the most points within the tolerance, of those that are level enough.

    RANSAC with a fixed number of trials on a sample of the points, then least squares on all inliers.

    Args:
        down: (3,) unit vector of gravity in the cloud's frame. The plane's normal points up.
        max_tilt_rad: of the plane.
        seed: of the trials; the same seed gives the same plane.

    Returns:
        None: fewer than three points lie on such a plane.
    """
    rng = np.random.default_rng(seed)
    points = cloud.points
    if len(points) < 3:
        return None
    sample = points[rng.choice(len(points), min(_SAMPLED, len(points)), replace=False)].astype(np.float64)
    triples = sample[rng.integers(0, len(sample), (_TRIPLES, 3))]
    normals = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    lengths = np.sqrt((normals * normals).sum(axis=1))
    usable = lengths > 1e-9
    normals, origins = normals[usable] / lengths[usable, None], triples[usable, 0]
    normals *= -np.sign(normals @ down)[:, None]
    level = normals @ down <= -math.cos(max_tilt_rad)
    normals, origins = normals[level], origins[level]
    if not len(normals):
        return None
    offsets = -(normals * origins).sum(axis=1)
    heights = offsets[:, None] + normals[:, :1] * sample[:, 0]
    heights += normals[:, 1:2] * sample[:, 1]
    heights += normals[:, 2:] * sample[:, 2]
    best = int((np.abs(heights) <= tolerance_m).sum(axis=1).argmax())
    plane = _plane(points, normals[best], float(offsets[best]), tolerance_m)
    for _ in range(_REFINEMENTS):
        inside = points[plane.inliers]
        if len(inside) < 3:
            return None
        centre = inside.mean(axis=0, dtype=np.float64)
        offset = inside - centre.astype(np.float32)
        normal = np.linalg.eigh(np.einsum("ni,nj->ij", offset, offset).astype(np.float64))[1][:, 0]
        normal = -normal if normal @ down > 0.0 else normal
        if normal @ down > -math.cos(max_tilt_rad):
            break
        plane = _plane(points, normal, -float(normal @ centre), tolerance_m)
    return plane


def _plane(
    points: NDArray[np.float32], normal: NDArray[np.float64], offset_m: float, tolerance_m: float
) -> Plane:
    plane = Plane(normal, offset_m, np.zeros(0, bool))
    return Plane(normal, offset_m, np.abs(plane.heights_m(points)) <= tolerance_m)


def estimate_normals(
    cloud: PointCloud, radius_m: float, viewpoint_m: NDArray[np.float64] | None = None
) -> NDArray[np.float32]:
    """(N, 3) float32 unit normals towards the viewpoint, from the neighbours within a radius.

    The normal is the direction of least variance (Hoppe et al. 1992). NaN with fewer than two neighbours.

    Args:
        viewpoint_m: (3,) position in the cloud's frame; None: the origin.
    """
    pairs = neighbour_pairs(cloud.points, radius_m)
    vectors = np.full((len(cloud), 3), np.nan, np.float32)
    # The point itself is one of those averaged, at the origin.
    counts = pairs.counts() + 1.0
    enough = counts >= 3.0
    if not enough.any():
        return vectors
    ones = np.ones(len(pairs.first))
    mean = _sums(pairs, _differences(cloud.points, pairs), ones) / counts[:, None]
    spread = _scatter(cloud.points, pairs, ones) / counts[:, None, None]
    spread -= mean[:, :, None] * mean[:, None, :]
    found = np.linalg.eigh(spread[enough])[1][:, :, 0]
    towards = (np.zeros(3) if viewpoint_m is None else viewpoint_m) - cloud.points[enough]
    found[(found * towards).sum(axis=1) < 0.0] *= -1.0
    vectors[enough] = found
    return vectors


def key_points(
    cloud: PointCloud,
    radius_m: float,
    *,
    ratio_21: float = 0.975,
    ratio_32: float = 0.975,
    min_neighbours: int = 5,
) -> NDArray[np.int64]:
    """Indices of key points: intrinsic shape signatures (Zhong 2009).

    A key point's surroundings vary in all three directions, and by different amounts: the smallest eigenvalue
    of its scatter matrix is the largest within the radius. Points in dense regions have less weight.

    Args:
        ratio_21, ratio_32: largest quotient of neighbouring eigenvalues, largest first.
        min_neighbours: a point with fewer within the radius is none.
    """
    pairs = neighbour_pairs(cloud.points, radius_m)
    if not len(pairs.first):
        return np.zeros(0, np.int64)
    counts = pairs.counts()
    weights = 1.0 / np.maximum(counts, 1)
    scatter = _scatter(cloud.points, pairs, weights[pairs.second], weights[pairs.first])
    total = np.bincount(pairs.first, weights[pairs.second], len(cloud))
    total += np.bincount(pairs.second, weights[pairs.first], len(cloud))
    scatter /= np.maximum(total, 1e-12)[:, None, None]
    third, second, first = np.linalg.eigvalsh(scatter).T
    salient = (
        (counts >= min_neighbours) & (second < ratio_21 * first) & (third < ratio_32 * second) & (third > 0.0)
    )
    saliency = np.where(salient, third, 0.0)
    highest = np.zeros(len(cloud))
    np.maximum.at(highest, pairs.first, saliency[pairs.second])
    np.maximum.at(highest, pairs.second, saliency[pairs.first])
    return np.flatnonzero(salient & (saliency >= highest))


def _differences(points: NDArray[np.float32], pairs: Pairs) -> list[NDArray[np.float64]]:
    """From the first point of each pair to the second, by axis."""
    return [(points[pairs.second, axis] - points[pairs.first, axis]).astype(np.float64) for axis in range(3)]


def _sums(
    pairs: Pairs, vectors: list[NDArray[np.float64]], weights: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(N, 3) sum of the vectors from each point to its neighbours."""
    sums = np.empty((pairs.count, len(vectors)))
    for axis, values in enumerate(vectors):
        weighted = values * weights
        sums[:, axis] = np.bincount(pairs.first, weighted, pairs.count)
        sums[:, axis] -= np.bincount(pairs.second, weighted, pairs.count)
    return sums


def _scatter(
    points: NDArray[np.float32],
    pairs: Pairs,
    weights: NDArray[np.float64],
    weights_back: NDArray[np.float64] | None = None,
) -> NDArray[np.float64]:
    """(N, 3, 3) sum of the weighted outer products of the vectors from each point to its neighbours."""
    vectors = _differences(points, pairs)
    back = weights if weights_back is None else weights_back
    scatter = np.empty((pairs.count, 3, 3))
    for row in range(3):
        for column in range(row + 1):
            product = vectors[row] * vectors[column]
            sums = np.bincount(pairs.first, product * weights, pairs.count)
            sums += np.bincount(pairs.second, product * back, pairs.count)
            scatter[:, row, column] = scatter[:, column, row] = sums
    return scatter
