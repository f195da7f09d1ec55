"""The program that judges the bundled model: every scene is in it, and its figures fit together."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.bundled_model import Seen, main, recall_by_range
from mavlink_sim.camera import ground_view
from mavlink_sim.camera.scene_file import example_scenes
from mavlink_sim.world.shapes import CLASS_NAMES
from mavlink_sim.world.textures import mip_atlas
from vision.evaluation.metrics import ImageResult


def test_recall_counts_evaluated_objects_found_as_their_class() -> None:
    boxes = np.array([[0, 0, 10, 10], [20, 0, 30, 10], [40, 0, 50, 10], [60, 0, 70, 10]], np.float32)
    car, dog = CLASS_NAMES.index("car"), CLASS_NAMES.index("dog")
    result = ImageResult(
        boxes,
        np.array([0.9, 0.9, 0.2, 0.9], np.float32),
        np.array([car, dog, car, car], np.int64),
        boxes,
        np.full(4, car, np.int64),
        np.array([False, False, False, True]),
    )
    corners = [(float(left), float(top), float(right), float(bottom)) for left, top, right, bottom in boxes]
    seen = [Seen("tree", (0.0, 0.0, 5.0, 5.0), 9.0)] + [
        Seen("car", xyxy, range_m) for xyxy, range_m in zip(corners, (2.5, 2.9, 20.0, 2.1), strict=True)
    ]
    table = recall_by_range([result], [seen], 0.4)
    assert table["2 to 3 m"] == {"objects": 2, "recall": 0.5}  # one found, one called a dog, one ignored
    assert table["15 to 30 m"] == {"objects": 1, "recall": 0.0}  # below the confidence
    assert table["30 to 70 m"] == {"objects": 0, "recall": None}


def test_every_scene_is_judged_and_frames_are_drawn_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    # test_renderer.py draws a ground with patches, a road and a pad (the built-in world's, as the village's);
    # test_rendered_perception.py draws marker_landing and test_cloud_command.py obstacle_course.
    plain = mip_atlas(np.full((64, 64, 3), 110, np.uint8))
    monkeypatch.setattr(ground_view, "ground_atlas", lambda ground: plain)
    folder = tmp_path / "frames"
    arguments = ["--frames", "10", "--image-size", "160", "--folder", str(folder), "--json"]
    main(arguments)
    report = json.loads(capsys.readouterr().out)
    assert set(report["scenes"]) == {"random", "default world", *example_scenes()}
    assert report["all"]["frames"] == sum(part["frames"] for part in report["scenes"].values()) == 10
    assert set(report["all"]["classes"]) == set(CLASS_NAMES)
    for name in CLASS_NAMES:
        parts = [part["classes"][name]["objects"] for part in report["scenes"].values()]
        assert report["all"]["classes"][name]["objects"] == sum(parts)
    for part in (report["all"], *report["scenes"].values()):
        assert sum(one["objects"] for one in part["ranges"].values()) <= sum(
            one["objects"] for one in part["classes"].values()
        )
    assert 0.0 <= report["all"]["map50"] <= 1.0
    before = sorted(folder.rglob("*"))
    main([*arguments[:-1], "--confidence", "1.0"])
    assert sorted(folder.rglob("*")) == before
    assert "precision None" in capsys.readouterr().out  # nothing is that sure
