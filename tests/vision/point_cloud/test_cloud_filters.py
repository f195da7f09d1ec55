from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.vision.point_cloud.clouds import offsets, random_cloud, rotations, seeds
from vision.point_cloud import PointCloud, neighbours, pass_through, remove_outliers, voxel_grid
from vision.point_cloud.neighbours import connected, neighbour_pairs

sizes_m = st.floats(0.01, 3.0)


def brute_distances(points: np.ndarray) -> np.ndarray:
    distance_m: np.ndarray = np.linalg.norm(points[:, None].astype(np.float64) - points[None], axis=2)
    return distance_m


@given(seeds, st.integers(0, 200), sizes_m, offsets)
@settings(max_examples=60, deadline=None)
def test_pairs_are_those_within_the_radius(
    seed: int, count: int, radius_m: float, offset: np.ndarray
) -> None:
    cloud = random_cloud(seed, count).transformed(np.eye(3), offset * 100)
    pairs = neighbour_pairs(cloud.points, radius_m)
    distance_m = brute_distances(cloud.points)
    found = np.zeros((count, count), bool)
    found[pairs.first, pairs.second] = True
    assert not (found & found.T).any()
    found |= found.T
    assert found.sum() == 2 * len(pairs.first)
    margin = 1e-4 * radius_m + 1e-4
    np.fill_diagonal(distance_m, np.inf)
    assert found[distance_m < radius_m - margin].all()
    assert not found[distance_m > radius_m + margin].any()
    np.testing.assert_array_equal(pairs.counts(), found.sum(axis=0))
    np.testing.assert_allclose(np.sqrt(pairs.squared_m2), distance_m[pairs.first, pairs.second], atol=1e-4)


def test_identical_points_are_neighbours() -> None:
    pairs = neighbour_pairs(np.ones((4, 3), np.float32), 0.1)
    assert len(pairs.first) == 6
    assert pairs.counts().tolist() == [3] * 4


def test_too_many_pairs_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(neighbours, "MAX_CANDIDATES", 1000)
    with pytest.raises(ValueError, match="1000"):
        neighbour_pairs(np.zeros((100, 3), np.float32), 1.0)


@given(seeds, st.integers(1, 150), st.floats(0.1, 1.0))
@settings(max_examples=40, deadline=None)
def test_connected_parts_are_those_of_a_search(seed: int, count: int, radius_m: float) -> None:
    pairs = neighbour_pairs(random_cloud(seed, count).points, radius_m)
    linked: list[set[int]] = [set() for _ in range(count)]
    for one, other in zip(pairs.first.tolist(), pairs.second.tolist(), strict=True):
        linked[one].add(other)
        linked[other].add(one)
    expected = [-1] * count
    for start in range(count):
        waiting = [start] if expected[start] < 0 else []
        while waiting:
            point = waiting.pop()
            expected[point] = start
            waiting += [other for other in linked[point] if expected[other] < 0]
    assert connected(pairs).tolist() == expected


@given(seeds, sizes_m)
@settings(max_examples=40, deadline=None)
def test_voxel_grid_is_idempotent(seed: int, size_m: float) -> None:
    once = voxel_grid(random_cloud(seed), size_m)
    twice = voxel_grid(once, size_m)
    np.testing.assert_array_equal(twice.points, once.points)
    assert once.colours is not None
    assert twice.colours is not None
    np.testing.assert_array_equal(twice.colours, once.colours)


@given(seeds, st.floats(0.1, 3.0))
@settings(max_examples=40, deadline=None)
def test_voxels_are_the_means_of_their_points(seed: int, size_m: float) -> None:
    cloud = random_cloud(seed)
    assert cloud.colours is not None
    cells: dict[tuple[int, ...], list[int]] = {}
    for index, key in enumerate(np.floor(cloud.points * np.float32(1 / size_m)).astype(int).tolist()):
        cells.setdefault(tuple(key), []).append(index)
    wanted = [cells[key] for key in sorted(cells)]
    reduced = voxel_grid(cloud, size_m)
    assert reduced.colours is not None
    assert len(reduced) == len(wanted)
    for point, colour, members in zip(reduced.points, reduced.colours, wanted, strict=True):
        np.testing.assert_allclose(point, cloud.points[members].mean(axis=0), atol=1e-5)
        assert np.abs(colour - cloud.colours[members].mean(axis=0)).max() <= 0.5


def test_a_wide_cloud_has_the_same_voxels_as_its_table(monkeypatch: pytest.MonkeyPatch) -> None:
    cloud = random_cloud(3)
    table = voxel_grid(cloud, 0.5)
    monkeypatch.setattr("vision.point_cloud.filters._TABLE_CELLS", 1)
    np.testing.assert_array_equal(voxel_grid(cloud, 0.5).points, table.points)


def test_filters_of_an_empty_cloud_give_an_empty_cloud() -> None:
    empty = PointCloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8))
    for filtered in (voxel_grid(empty, 0.1), remove_outliers(empty, 0.1), pass_through(empty, 0, 0.0)):
        assert len(filtered) == 0


@given(seeds, st.integers(0, 2), st.floats(-2, 2), st.floats(-2, 2))
def test_pass_through_keeps_what_is_between(seed: int, axis: int, low_m: float, high_m: float) -> None:
    cloud = random_cloud(seed, 50)
    kept = pass_through(cloud, axis, low_m, high_m)
    inside = (cloud.points[:, axis] >= low_m) & (cloud.points[:, axis] <= high_m)
    np.testing.assert_array_equal(kept.points, cloud.points[inside])


@given(seeds, st.integers(1, 12), st.floats(0.3, 1.5))
@settings(max_examples=30, deadline=None)
def test_outliers_are_those_of_the_definition(seed: int, neighbours: int, radius_m: float) -> None:
    cloud = random_cloud(seed, 200)
    distance_m = brute_distances(cloud.points)
    np.fill_diagonal(distance_m, np.inf)
    nearest = np.sort(np.minimum(distance_m, radius_m), axis=1)[:, :neighbours].mean(axis=1)
    limit = nearest.mean() + 1.0 * nearest.std()
    kept = {tuple(point) for point in remove_outliers(cloud, radius_m, neighbours, 1.0).points.tolist()}
    half_bin = radius_m / 16  # distances are counted in bins
    for point, mean_m in zip(cloud.points.tolist(), nearest, strict=True):
        if abs(mean_m - limit) > half_bin:
            assert (tuple(point) in kept) == (mean_m < limit)


def test_isolated_points_are_removed_and_a_surface_stays() -> None:
    across, down = np.meshgrid(np.arange(30) * 0.1, np.arange(30) * 0.1)
    plane = np.column_stack([across.ravel(), down.ravel(), np.full(900, 3.0)]).astype(np.float32)
    noise = np.array([[0.5, 0.5, 1.0], [2.0, 2.0, 4.2], [5.0, 0.0, 3.0]], np.float32)
    kept = remove_outliers(PointCloud(np.concatenate([plane, noise])), 0.25, neighbours=3, deviations=4.0)
    np.testing.assert_array_equal(kept.points, plane)
    np.testing.assert_array_equal(remove_outliers(PointCloud(plane[:1]), 0.25).points, plane[:1])


@given(seeds, rotations, offsets)
@settings(max_examples=20, deadline=None)
def test_outliers_do_not_depend_on_the_pose(seed: int, rotation: np.ndarray, offset: np.ndarray) -> None:
    rng = np.random.default_rng(seed)
    dense = rng.normal(0.0, 0.2, (300, 3))
    far = rng.uniform(3.0, 4.0, (5, 3))
    cloud = PointCloud(np.concatenate([dense, far]).astype(np.float32))
    kept = remove_outliers(cloud, 0.5, deviations=3.0)
    moved = remove_outliers(cloud.transformed(rotation, offset), 0.5, deviations=3.0)
    # Distances are rounded, so that a point at the limit may change sides.
    assert abs(len(kept) - len(moved)) <= 2
    assert kept.points.max() < 2.9
    assert len(kept) > 270
