"""Strategies and clouds of the point cloud tests."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from vision.camera_model import CameraModel, CameraMount
from vision.point_cloud import PointCloud
from vision.rotation import matrix_from_euler

SMALL = CameraModel(40, 30, 35.0, 33.0, 19.0, 15.5, (-0.2, 0.05, 0.001, -0.002, 0.01))
angles = st.floats(-math.pi, math.pi)
rotations = st.builds(matrix_from_euler, angles, st.floats(-1.5, 1.5), angles)
offsets = st.lists(st.floats(-5, 5), min_size=3, max_size=3).map(np.array)
mounts = st.builds(
    CameraMount, *[st.floats(-1, 1)] * 3, angles, st.floats(-1.5, 1.5), angles, stabilized=st.booleans()
)
seeds = st.integers(0, 2**32 - 1)


def random_cloud(seed: int, count: int = 300, size_m: float = 2.0, *, colours: bool = True) -> PointCloud:
    """Points uniform in a cube."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-size_m, size_m, (count, 3)).astype(np.float32)
    return PointCloud(points, rng.integers(0, 256, (count, 3), np.uint8) if colours else None)


def blobs(seed: int, centres: NDArray[np.float64], count: int = 60, sigma_m: float = 0.05) -> PointCloud:
    """Normally distributed points about each centre, longest along x."""
    rng = np.random.default_rng(seed)
    spread = rng.normal(0.0, sigma_m, (len(centres), count, 3)) * (2.0, 1.0, 0.5)
    return PointCloud((centres[:, None] + spread).reshape(-1, 3).astype(np.float32))
