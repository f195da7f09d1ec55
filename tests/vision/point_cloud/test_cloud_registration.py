from __future__ import annotations

import builtins
import math
from typing import Any

import numpy as np
import pytest

from benchmarks.cloud_alignment import angle_deg, pair
from vision.point_cloud import PointCloud, RegistrationError, align


@pytest.mark.parametrize("seed", [101, *(pytest.param(n, marks=pytest.mark.slow) for n in (102, 103, 104))])
def test_alignment_recovers_the_motion_of_a_rendered_camera(seed: int) -> None:
    views = pair("obstacle_course", seed)
    methods: tuple[Any, ...] = ("plane_icp", "gicp")
    for method in methods:
        found = align(views.source, views.target, method=method)
        assert found.converged, method
        assert found.inlier_share > 0.9
        assert found.determined
        assert angle_deg(found.rotation, views.rotation) < 0.3
        assert np.linalg.norm(found.translation_m - views.translation_m) < 0.05


@pytest.mark.parametrize("method", ["plane_icp", "gicp"])
def test_flat_ground_does_not_determine_the_motion(method: Any) -> None:
    rng = np.random.default_rng(6)
    flat = np.column_stack([rng.uniform(0, 10, (6_000, 2)), rng.normal(2.0, 0.002, 6_000)])
    cloud = PointCloud(flat.astype(np.float32))
    found = align(cloud, cloud.transformed(np.eye(3), np.array([0.2, 0.1, 0.1])), method=method)
    assert not found.determined
    assert found.observability < 0.003
    assert found.translation_m[2] == pytest.approx(0.1, abs=0.01)


def test_point_to_point_recovers_an_exact_motion_from_a_start() -> None:
    views = pair("obstacle_course", 104)
    target, rotation, translation_m = views.target, views.rotation, views.translation_m
    source = target.transformed(rotation.T, -rotation.T @ translation_m)
    found = align(
        source,
        target,
        method="icp",
        rotation=rotation,
        translation_m=translation_m + 0.02,
        max_distance_m=0.3,
    )
    assert math.isnan(found.observability)
    assert not found.determined
    assert np.abs(found.rotation - rotation).max() < 0.005
    assert np.linalg.norm(found.translation_m - translation_m) < 0.03


def test_a_missing_library_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    imported = builtins.__import__

    def without(name: str, *arguments: Any, **options: Any) -> Any:
        if name == "small_gicp":
            raise ModuleNotFoundError(name)
        return imported(name, *arguments, **options)

    monkeypatch.setattr(builtins, "__import__", without)
    few = PointCloud(np.eye(3, dtype=np.float32))
    with pytest.raises(RegistrationError, match=r"mavlink-companion\[cameras\]"):
        align(few, few)
