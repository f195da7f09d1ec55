"""The program that judges the bundled model: every scene is in it, and its figures fit together."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks.bundled_model import main
from mavlink_sim.camera.scene_file import example_scenes
from mavlink_sim.world.shapes import CLASS_NAMES


def test_every_scene_is_judged_and_frames_are_drawn_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
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
    assert 0.0 <= report["all"]["map50"] <= 1.0
    before = sorted(folder.rglob("*"))
    main([*arguments[:-1], "--confidence", "1.0"])
    assert sorted(folder.rglob("*")) == before
    assert "precision None" in capsys.readouterr().out  # nothing is that sure
