"""Benchmarks of rendered ranges on a few frames: their bounds are wide enough for few frames."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.point_cloud import timed
from benchmarks.range_error import View, rows, samples, views
from mavlink_sim.world.mesh import surface_range_to
from mavlink_sim.world.world import WorldObject, range_to
from vision.detector import Detector


@pytest.fixture(scope="module")
def seen() -> list[View]:
    return list(views(7, 12))


def test_a_seed_gives_the_same_frames(seen: list[View]) -> None:
    again = next(views(7, 1))
    assert np.array_equal(again.image, seen[0].image)
    assert np.array_equal(again.depth_m, seen[0].depth_m, equal_nan=True)


def test_surface_is_within_the_footprint() -> None:
    car = WorldObject(0, "car", (0.0, 0.0, 0.0), 0.4)
    for angle in np.linspace(0.0, 6.0, 13):
        place = (8.0 * np.cos(angle), 8.0 * np.sin(angle))
        assert 0.0 <= surface_range_to(car, place) - range_to(car, place) < 0.5


def test_ranges_of_the_detector_are_near_the_truth(seen: list[View]) -> None:
    detector = Detector(image_size=320, threads=1)
    measured = [sample for view in seen for sample in samples(view, detector)]
    table = {(row.source, row.group): row for row in rows(measured)}
    depth, exact = table["depth", "3-15 m"], table["depth_exact", "3-15 m"]
    assert depth.count >= 10
    assert depth.median_abs_m < 0.1
    assert exact.median_abs_m < 0.05
    assert abs(depth.median_m) < 0.05
    assert abs(exact.median_m) < 0.03
    assert table["ground_plane", "5-25 m"].median_abs_m < 0.6


def test_frames_have_points_clusters_and_times(seen: list[View]) -> None:
    results = [timed(view) for view in seen[:4]]
    for result in results:
        assert result["points"] > result["voxels"] > result["above_ground"] > 0
        assert 0.0 < result["points_ms"] < result["total_ms"]
        assert result["total_ms"] == pytest.approx(result["points_ms"] + result["scene_ms"])
    assert sum(result["clusters"] for result in results) >= 2
