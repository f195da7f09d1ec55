from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.vision.point_cloud.clouds import blobs, offsets, random_cloud, rotations, seeds
from vision.point_cloud import (
    PointCloud,
    estimate_normals,
    euclidean_clusters,
    ground_plane,
    key_points,
    scene_of,
)
from vision.rotation import matrix_from_euler

DOWN = np.array([0.0, 0.0, 1.0])
CENTRES = np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [0.0, 3.0, 1.0]])


def box_surface(seed: int, count: int = 1500) -> np.ndarray:
    """(N, 3) points on three visible sides of a cube of 1 m, corner at the origin."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(0.0, 1.0, (count, 3))
    points[np.arange(count), rng.integers(0, 3, count)] = 0.0
    return points.astype(np.float32)


def sloped_ground(seed: int, tilt_rad: float, above: int) -> PointCloud:
    """Points on a plane 2 m below the origin with 2 cm of noise, and others above it."""
    rng = np.random.default_rng(seed)
    flat = np.column_stack([rng.uniform(-8, 8, (600, 2)), rng.normal(2.0, 0.02, 600)])
    others = np.column_stack([rng.uniform(-8, 8, (above, 2)), rng.uniform(-2.0, 1.5, above)])
    rotation = matrix_from_euler(tilt_rad, 0.0, 0.3)
    return PointCloud((np.concatenate([flat, others]) @ rotation.T).astype(np.float32))


@given(seeds, st.floats(-0.25, 0.25), st.integers(0, 900))
@settings(max_examples=30, deadline=None)
def test_ground_plane_of_a_slope(seed: int, tilt_rad: float, above: int) -> None:
    cloud = sloped_ground(seed, tilt_rad, above)
    plane = ground_plane(cloud, DOWN, tolerance_m=0.08)
    assert plane is not None
    expected = matrix_from_euler(tilt_rad, 0.0, 0.3) @ -DOWN
    assert math.degrees(math.acos(min(1.0, float(plane.normal @ expected)))) < 0.5
    assert plane.offset_m == pytest.approx(2.0, abs=0.03)
    assert plane.inliers[:600].mean() > 0.99
    np.testing.assert_array_equal(plane.inliers, np.abs(plane.heights_m(cloud.points)) <= 0.08)


def test_ground_plane_is_the_same_for_the_same_seed() -> None:
    cloud = sloped_ground(5, 0.1, 400)
    first, again = ground_plane(cloud, DOWN, seed=3), ground_plane(cloud, DOWN, seed=3)
    assert first is not None
    assert again is not None
    assert first.offset_m == again.offset_m
    np.testing.assert_array_equal(first.normal, again.normal)


def test_a_wall_is_no_ground() -> None:
    rng = np.random.default_rng(1)
    wall = np.column_stack([np.full(500, 5.0), rng.uniform(-3, 3, (500, 2))]).astype(np.float32)
    plane = ground_plane(PointCloud(wall), DOWN, tolerance_m=0.01)
    assert plane is None or plane.inliers.mean() < 0.1
    assert ground_plane(PointCloud(wall[:2]), DOWN) is None
    assert ground_plane(PointCloud(np.ones((50, 3), np.float32)), DOWN) is None


def test_normals_of_a_sphere_point_to_the_viewpoint() -> None:
    rng = np.random.default_rng(2)
    outward = rng.normal(size=(4000, 3))
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    cloud = PointCloud((outward * 2.0).astype(np.float32))
    inward = estimate_normals(cloud, 0.3)
    np.testing.assert_allclose(np.linalg.norm(inward, axis=1), 1.0, atol=1e-5)
    assert np.degrees(np.arccos(np.clip((inward * -outward).sum(axis=1), -1, 1))).max() < 8.0
    far = np.array([0.0, 0.0, 100.0])
    seen = estimate_normals(cloud, 0.3, far)
    assert ((seen * (far - cloud.points)).sum(axis=1) >= 0.0).all()


@given(seeds, rotations, offsets)
@settings(max_examples=20, deadline=None)
def test_normals_turn_with_the_cloud(seed: int, rotation: np.ndarray, offset: np.ndarray) -> None:
    cloud = PointCloud(box_surface(seed, 400))
    viewpoint = np.array([-2.0, -2.0, -2.0])
    before = estimate_normals(cloud, 0.35, viewpoint)
    after = estimate_normals(cloud.transformed(rotation, offset), 0.35, rotation @ viewpoint + offset)
    agreement = np.abs((before @ rotation.T.astype(np.float32) * after).sum(axis=1))
    # At an edge two directions may vary equally.
    assert np.mean(agreement > 0.999) > 0.97


def test_normals_without_neighbours_are_unknown() -> None:
    points = np.array([[0, 0, 0], [5, 0, 0], [0.05, 0, 0]], np.float32)
    assert np.isnan(estimate_normals(PointCloud(points), 0.1)).all()
    assert estimate_normals(PointCloud(points[:0]), 0.1).shape == (0, 3)


@given(seeds, rotations, offsets)
@settings(max_examples=20, deadline=None)
def test_clusters_and_box_sizes_do_not_depend_on_the_pose(
    seed: int, rotation: np.ndarray, offset: np.ndarray
) -> None:
    cloud = blobs(seed, CENTRES)
    before = euclidean_clusters(cloud, 0.5)
    after = euclidean_clusters(cloud.transformed(rotation, offset), 0.5)
    assert len(before) == len(after) == len(CENTRES)
    for one, other in zip(before, after, strict=True):
        np.testing.assert_array_equal(one.indices, other.indices)
        np.testing.assert_allclose(one.size_m, other.size_m, atol=1e-3)
        np.testing.assert_allclose(rotation @ one.centre_m + offset, other.centre_m, atol=1e-3)


@given(seeds)
@settings(max_examples=20, deadline=None)
def test_boxes_hold_their_points_and_axes_are_a_rotation(seed: int) -> None:
    cloud = blobs(seed, CENTRES)
    for cluster in euclidean_clusters(cloud, 0.5):
        own = cloud.points[cluster.indices]
        np.testing.assert_array_equal(cluster.low_m, own.min(axis=0))
        np.testing.assert_array_equal(cluster.high_m, own.max(axis=0))
        np.testing.assert_allclose(cluster.axes.T @ cluster.axes, np.eye(3), atol=1e-9)
        assert np.linalg.det(cluster.axes) == pytest.approx(1.0)
        along = (own - cluster.centre_m) @ cluster.axes
        np.testing.assert_allclose(np.abs(along).max(axis=0), cluster.size_m / 2, rtol=1e-5, atol=1e-6)
        variances = along.var(axis=0)
        assert variances[0] >= variances[1] >= variances[2]
        corners = cluster.corners_m()
        assert corners.shape == (8, 3)
        np.testing.assert_allclose(np.linalg.norm(corners[4] - corners[0]), cluster.size_m[0])


def test_clusters_are_sorted_and_limited_by_size() -> None:
    points = np.concatenate(
        [np.random.default_rng(4).normal(x, 0.02, (count, 3)) for x, count in ((0, 20), (2, 40), (4, 5))]
    ).astype(np.float32)
    cloud = PointCloud(points)
    assert [len(each) for each in euclidean_clusters(cloud, 0.3, 1)] == [40, 20, 5]
    assert [len(each) for each in euclidean_clusters(cloud, 0.3, 10)] == [40, 20]
    assert [len(each) for each in euclidean_clusters(cloud, 0.3, 1, 20)] == [20, 5]
    assert euclidean_clusters(PointCloud(points[:0]), 0.3) == []
    with pytest.raises(ValueError, match="above 0"):
        euclidean_clusters(cloud, 0.0)


def test_key_points_are_at_the_corner_not_on_the_sides() -> None:
    cloud = PointCloud(box_surface(7, 4000))
    chosen = cloud.points[key_points(cloud, 0.25)]
    assert len(chosen) > 0
    # Inside of a side nothing varies along the normal: each is near an edge or a border.
    inner = np.sort(chosen, axis=1)
    assert (inner[:, 1] < 0.3).mean() > 0.7
    assert np.linalg.norm(chosen, axis=1).min() < 0.3


@given(seeds, rotations, offsets)
@settings(max_examples=15, deadline=None)
def test_key_points_do_not_depend_on_the_pose(seed: int, rotation: np.ndarray, offset: np.ndarray) -> None:
    cloud = random_cloud(seed, 400)
    before = set(key_points(cloud, 0.7).tolist())
    after = set(key_points(cloud.transformed(rotation, offset), 0.7).tolist())
    assert len(before) > 3
    assert len(before & after) >= 0.9 * max(len(before), len(after))


def test_a_plane_or_nothing_has_no_key_points() -> None:
    flat = np.random.default_rng(5).uniform(0, 2, (500, 3)).astype(np.float32)
    flat[:, 2] = 1.0
    assert len(key_points(PointCloud(flat), 0.3)) == 0
    assert len(key_points(PointCloud(flat[:1]), 0.3)) == 0


def test_scene_has_the_ground_and_each_object_once() -> None:
    rng = np.random.default_rng(9)
    ground = np.column_stack([rng.uniform(-6, 6, (40_000, 2)), np.full(40_000, 2.0)])
    boxes = [rng.uniform(0, 1, (3000, 3)) * (1, 0.6, 1.5) + (x, 0.0, 0.4) for x in (-4.0, 0.0, 3.0)]
    speckle = rng.uniform((-6, -6, -3), (6, 6, 0), (200, 3))
    cloud = PointCloud(np.concatenate([ground, *boxes, speckle]).astype(np.float32))
    scene = scene_of(cloud, DOWN, voxel_m=0.15)
    assert scene.ground is not None
    assert scene.ground.offset_m == pytest.approx(2.0, abs=0.02)
    assert len(scene.clusters) == 3
    assert len(scene.objects) < len(scene.voxels) < len(cloud)
    lefts = sorted(float(cluster.low_m[0]) for cluster in scene.clusters)
    assert lefts == pytest.approx([-4.0, 0.0, 3.0], abs=0.15)
    for cluster in scene.clusters:
        assert cluster.size_m.tolist() == pytest.approx([1.0, 0.6, 1.4], abs=0.3)


@given(seeds, rotations)
@settings(max_examples=20, deadline=None)
def test_upright_boxes_have_a_vertical_axis(seed: int, rotation: np.ndarray) -> None:
    cloud = blobs(seed, CENTRES).transformed(rotation, np.zeros(3))
    down = rotation @ DOWN
    for cluster in euclidean_clusters(cloud, 0.5, down=down):
        assert abs(cluster.axes[:, 2] @ down) == pytest.approx(1.0, abs=1e-6)
        assert np.linalg.det(cluster.axes) == pytest.approx(1.0)
        along = (cloud.points[cluster.indices] - cluster.centre_m) @ cluster.axes
        np.testing.assert_allclose(np.abs(along).max(axis=0), cluster.size_m / 2, rtol=1e-5, atol=1e-6)
