from __future__ import annotations

import pytest

from benchmarks.point_cloud import timed
from benchmarks.range_error import views


def test_frames_have_points_clusters_and_times() -> None:
    results = [timed(view) for view in views(6, 4)]
    for result in results:
        assert result["points"] > result["voxels"] > result["above_ground"] > 0
        assert 0.0 < result["points_ms"] < result["total_ms"]
        assert result["total_ms"] == pytest.approx(result["points_ms"] + result["scene_ms"])
    assert sum(result["clusters"] for result in results) >= 2
