"""Groups of points that belong together, and their boxes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vision.point_cloud.cloud import PointCloud
from vision.point_cloud.filters import remove_outliers, voxel_grid
from vision.point_cloud.neighbours import connected, neighbour_pairs
from vision.point_cloud.surfaces import Plane, ground_plane


@dataclass(frozen=True, slots=True, eq=False)
class Cluster:
    """One group of points, in the cloud's frame.

    Attributes:
        indices: (M,) int64, its points, ascending.
        low_m, high_m: (3,) float32 corners of the axis-aligned box.
        centre_m: (3,) float64 centre of the oriented box.
        axes: (3, 3) float64, its directions in columns, a rotation: those of the points' largest, middle and
            smallest variance; the third one is vertical if `down` was given.
        size_m: (3,) float64, its extent along them.
    """

    indices: NDArray[np.int64]
    low_m: NDArray[np.float32]
    high_m: NDArray[np.float32]
    centre_m: NDArray[np.float64]
    axes: NDArray[np.float64]
    size_m: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.indices)

    def corners_m(self) -> NDArray[np.float64]:
        """(8, 3) corners of the oriented box; bit 2, 1, 0 of the index is the side along axis 0, 1, 2."""
        signs = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
        corners: NDArray[np.float64] = self.centre_m + (signs * self.size_m) @ self.axes.T
        return corners


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """What stands on the ground.

    Attributes:
        voxels: the reduced cloud, ground included.
        ground: None: no level plane was found.
        objects: the points above the ground, without outliers.
        clusters: of `objects`, largest first.
    """

    voxels: PointCloud
    ground: Plane | None
    objects: PointCloud
    clusters: list[Cluster]


def scene_of(
    cloud: PointCloud, down: NDArray[np.float64], *, voxel_m: float = 0.1, min_points: int = 10
) -> Scene:
    """Voxel grid, ground plane, statistical outliers and clusters in one step, at the scale of the voxels.

    Points count as ground within 1.5 voxels of the plane and below it, neighbours of a point are those within
    2.5 voxels, and clusters are 3 voxels apart. Average the depth of a stereo camera first
    (`cloud_from_depth`): beyond some metres its steps of depth are larger than that.

    Args:
        down: (3,) unit vector of gravity in the cloud's frame.
        min_points: of a cluster.
    """
    voxels = voxel_grid(cloud, voxel_m)
    ground = ground_plane(voxels, down, tolerance_m=1.5 * voxel_m)
    above = voxels if ground is None else voxels.select(ground.heights_m(voxels.points) > 1.5 * voxel_m)
    objects = remove_outliers(above, 2.5 * voxel_m)
    return Scene(voxels, ground, objects, euclidean_clusters(objects, 3.0 * voxel_m, min_points, down=down))


def euclidean_clusters(
    cloud: PointCloud,
    tolerance_m: float,
    min_points: int = 10,
    max_points: int | None = None,
    down: NDArray[np.float64] | None = None,
) -> list[Cluster]:
    """Groups in which each point is at most `tolerance_m` from another one, largest first (Rusu 2009).

    Args:
        min_points, max_points: smaller and larger groups are left out.
        down: (3,) unit vector of gravity: oriented boxes stand upright. None: they may lean.

    Raises:
        ValueError: the tolerance is not above zero or too large for the cloud.
    """
    labels = connected(neighbour_pairs(cloud.points, tolerance_m))
    sizes = np.bincount(labels, minlength=1)
    largest = len(labels) if max_points is None else max_points
    parts = np.flatnonzero((sizes >= max(min_points, 1)) & (sizes <= largest))
    if not len(parts):
        return []
    parts = parts[np.argsort(-sizes[parts], kind="stable")]
    number = np.full(len(sizes), len(parts))
    number[parts] = np.arange(len(parts))
    indices = np.argsort(number[labels], kind="stable")[: sizes[parts].sum()]
    return _with_boxes(cloud.points[indices], indices, sizes[parts], down)


def _with_boxes(
    points: NDArray[np.float32],
    indices: NDArray[np.int64],
    sizes: NDArray[np.int64],
    down: NDArray[np.float64] | None,
) -> list[Cluster]:
    """The clusters of points that are sorted by cluster; all boxes at once."""
    starts = np.cumsum(sizes) - sizes
    part = np.repeat(np.arange(len(sizes)), sizes)
    low_m, high_m = np.minimum.reduceat(points, starts), np.maximum.reduceat(points, starts)
    mean = np.add.reduceat(points.astype(np.float64), starts) / sizes[:, None]
    offset = points - mean[part]
    spread = np.add.reduceat(offset[:, :, None] * offset[:, None, :], starts)
    if down is not None:
        level = np.eye(3) - np.outer(down, down)
        # Negative along gravity, so that this is the last axis even where the points are on a line.
        spread = level @ spread @ level - np.outer(down, down)
    axes = np.linalg.eigh(spread)[1][:, :, ::-1].copy()
    axes[:, :, 2] *= np.sign(np.linalg.det(axes))[:, None]
    along = np.einsum("ni,nij->nj", offset, axes[part])
    first, last = np.minimum.reduceat(along, starts), np.maximum.reduceat(along, starts)
    centre = mean + np.einsum("kij,kj->ki", axes, (first + last) / 2)
    return [
        Cluster(indices[begin : begin + size], low_m[k], high_m[k], centre[k], axes[k], last[k] - first[k])
        for k, (begin, size) in enumerate(zip(starts.tolist(), sizes.tolist(), strict=True))
    ]
