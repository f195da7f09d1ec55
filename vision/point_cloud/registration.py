"""Alignment of two point clouds by ICP, with `small-gicp` (the extra `cameras`)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from vision.extras import install_command
from vision.point_cloud.cloud import PointCloud

Method = Literal["icp", "plane_icp", "gicp"]
MIN_POINTS = 20
# Chosen on 16 pairs of rendered views of each of 3 scenes (`benchmarks.cloud_alignment`, seeds 500 to 515):
# those above were within 0.03 m, those below up to 0.45 m off. Others are in docs/measurements.md.
MIN_OBSERVABILITY: dict[Method, float] = {"plane_icp": 0.02, "gicp": 0.004}


class RegistrationError(ValueError):
    """Clouds cannot be aligned: the library is missing, or there are too few points."""


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """The pose of the source in the target's frame.

    Attributes:
        rotation: (3, 3) float64. translation_m: (3,) float64. `target = rotation @ source + translation_m`.
        converged: the last step was small enough. It says nothing about surfaces that do not determine it.
        observability: how well the surfaces determine the translation in the worst direction, relative to the
            best one (after Zhang, Kaess and Singh 2016, "On degeneracy of optimization-based state
            estimation"); NaN for `icp`, which does not know surfaces.
        determined: `observability` is high enough. If not, the pose may slide, as along flat ground.
        inlier_share: of the source's points (after the voxel grid), those with a partner in the target.
    """

    rotation: NDArray[np.float64]
    translation_m: NDArray[np.float64]
    converged: bool
    observability: float
    determined: bool
    inlier_share: float


def align(
    source: PointCloud,
    target: PointCloud,
    *,
    method: Method = "gicp",
    voxel_m: float = 0.1,
    max_distance_m: float = 0.5,
    rotation: NDArray[np.float64] | None = None,
    translation_m: NDArray[np.float64] | None = None,
    threads: int = 2,
) -> Alignment:
    """Move `source` onto `target`.

    Args:
        method: point to point (Besl and McKay 1992), point to plane (Chen and Medioni 1992), or generalised
            ICP (Segal, Haehnel and Thrun 2009), in which each surface has its own uncertainty.
        voxel_m: both clouds are reduced by a voxel grid of this size.
        max_distance_m: points farther apart are no partners. The start must be nearer than that.
        rotation, translation_m: of the start; None: the clouds are already near.

    Raises:
        RegistrationError: `small-gicp` is not installed, or a cloud has fewer than 20 voxels.
    """
    try:
        import small_gicp
    except ModuleNotFoundError as error:
        raise RegistrationError(
            f"alignment of point clouds needs small-gicp: {install_command('small_gicp')}"
        ) from error
    reduced = []
    for name, cloud in (("source", source), ("target", target)):
        # 10 neighbours give a point's surface in small-gicp.
        points, tree = small_gicp.preprocess_points(
            cloud.points.astype(np.float64), downsampling_resolution=voxel_m, num_threads=threads
        )
        if points.size() < MIN_POINTS:
            raise RegistrationError(
                f"the {name} has {points.size()} voxels of {voxel_m} m, alignment needs {MIN_POINTS} or more"
            )
        reduced.append((points, tree))
    (moving, _), (fixed, fixed_tree) = reduced
    start = np.eye(4)
    start[:3, :3] = np.eye(3) if rotation is None else rotation
    start[:3, 3] = np.zeros(3) if translation_m is None else translation_m
    result = small_gicp.align(
        fixed,
        moving,
        fixed_tree,
        start,
        registration_type=method.upper(),
        max_correspondence_distance=max_distance_m,
        num_threads=threads,
        max_iterations=50,
    )
    pose = np.asarray(result.T_target_source, np.float64)
    observability = math.nan if method == "icp" else _observability(np.asarray(result.H, np.float64))
    return Alignment(
        pose[:3, :3].copy(),
        pose[:3, 3].copy(),
        bool(result.converged),
        observability,
        observability >= MIN_OBSERVABILITY.get(method, math.inf),
        result.num_inliers / moving.size(),
    )


def _observability(information: NDArray[np.float64]) -> float:
    """Smallest by largest eigenvalue of the translation's information, the rotation being unknown too.

    Args:
        information: (6, 6), rotation first.
    """
    turn, both, move = information[:3, :3], information[3:, :3], information[3:, 3:]
    values = np.linalg.eigvalsh(move - both @ np.linalg.pinv(turn) @ both.T)
    return float(max(values[0], 0.0) / values[2]) if values[2] > 0.0 else 0.0
