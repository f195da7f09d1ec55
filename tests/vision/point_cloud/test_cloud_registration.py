from __future__ import annotations

import builtins
import math
from typing import Any

import numpy as np
import pytest

from tests.vision.point_cloud.clouds import rendered_cloud
from vision.point_cloud import PointCloud, RegistrationError, align
from vision.rotation import matrix_from_euler


def moved_pair(seed: int) -> tuple[PointCloud, PointCloud, np.ndarray, np.ndarray]:
    """Two rendered clouds, and the true pose of the second camera in the first one's frame."""
    rng = np.random.default_rng(seed)
    roll_rad, pitch_rad, yaw_rad = rng.uniform(-1, 1, 3) * (0.05, 0.05, 0.3)
    attitude = matrix_from_euler(roll_rad, pitch_rad, yaw_rad)
    position = np.array([rng.uniform(-1, 3), rng.uniform(-2, 2), rng.uniform(-4, -2)])
    turned, step = matrix_from_euler(*rng.uniform(-0.04, 0.04, 3)), rng.uniform(-0.2, 0.2, 3)
    target = rendered_cloud(position, attitude)
    source = rendered_cloud(position + attitude @ step, attitude @ turned)
    return source, target, turned, step


@pytest.mark.parametrize("method", ["plane_icp", "gicp"])
@pytest.mark.parametrize("seed", [101, 102, 103, 104])
def test_alignment_recovers_the_motion_of_a_rendered_camera(method: Any, seed: int) -> None:
    source, target, rotation, translation_m = moved_pair(seed)
    found = align(source, target, method=method)
    angle = math.acos(min(1.0, (np.trace(found.rotation.T @ rotation) - 1.0) / 2.0))
    assert found.converged
    assert found.inlier_share > 0.9
    assert math.degrees(angle) < 0.3
    assert np.linalg.norm(found.translation_m - translation_m) < 0.05


def test_point_to_point_recovers_an_exact_motion_from_a_start() -> None:
    _, target, rotation, translation_m = moved_pair(104)
    source = target.transformed(rotation.T, -rotation.T @ translation_m)
    found = align(
        source,
        target,
        method="icp",
        rotation=rotation,
        translation_m=translation_m + 0.02,
        max_distance_m=0.3,
    )
    assert np.abs(found.rotation - rotation).max() < 0.005
    assert np.linalg.norm(found.translation_m - translation_m) < 0.03


def test_a_cloud_of_few_points_is_refused() -> None:
    few = PointCloud(np.eye(3, dtype=np.float32))
    with pytest.raises(RegistrationError, match="source has 3"):
        align(few, few)


def test_a_missing_library_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    imported = builtins.__import__

    def without(name: str, *arguments: Any, **options: Any) -> Any:
        if name == "small_gicp":
            raise ModuleNotFoundError(name)
        return imported(name, *arguments, **options)

    monkeypatch.setattr(builtins, "__import__", without)
    few = PointCloud(np.eye(3, dtype=np.float32))
    with pytest.raises(RegistrationError, match=r"mavlink-companion\[cloud\]"):
        align(few, few)
