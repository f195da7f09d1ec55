"""The measurement of tracking as a command, and the plain association it is held against."""

from __future__ import annotations

import json

import numpy as np
import pytest

from benchmarks.scenes import CLASS_NAMES, MOTIONS, SceneFrame, Walker, scene_frames, walkers
from benchmarks.tracking import Seen, main, no_tracking
from vision.detections import Detections


def seen(*boxes: tuple[float, float], class_id: int = 0) -> Seen:
    """Of boxes of 20 by 20 pixels at (x, confidence)."""
    xyxy = np.array([[x, 0, x + 20, 20] for x, _ in boxes], np.float32).reshape(-1, 4)
    none, no_share = np.zeros(0, np.int64), np.zeros(0, np.float64)
    no_boxes = np.zeros((0, 4), np.float32)
    frame = SceneFrame(0.0, 1, np.zeros((1, 1, 3), np.uint8), none, none, no_boxes, no_share, none > 0)
    confidence = np.array([confidence for _, confidence in boxes], np.float32)
    return Seen(frame, Detections(xyxy, confidence, np.full(len(boxes), class_id), CLASS_NAMES))


def test_without_tracker_an_identity_lasts_to_the_next_frame() -> None:
    frames = [
        seen((0, 0.9), (100, 0.9)),
        seen((104, 0.9), (3, 0.9)),
        seen((103, 0.9), (0, 0.1)),
        seen((0, 0.9), (103, 0.9)),
        seen((103, 0.9), class_id=1),
    ]
    identities = [tracked.identity for _, tracked in no_tracking(frames, 0.25)]
    assert identities == [[1, 2], [2, 1], [2], [3, 2], [4]]


def test_sequence_has_a_truth_for_each_frame_not_dropped() -> None:
    frames = list(scene_frames(MOTIONS[1], seconds=1.5, rate_hz=8, seed=2, drop=0.3))
    assert 4 <= len(frames) < 12
    assert frames[0].captured_ns == 1_000_000_000
    assert (np.diff([frame.captured_ns for frame in frames]) > 0).all()
    for frame in frames:
        assert frame.counts.sum() >= 4
        assert len(set(frame.identity.tolist())) == len(frame.identity)
        assert (frame.xyxy[:, 2:] > frame.xyxy[:, :2]).all()
        assert frame.image.shape == (480, 640, 3)
    again = next(scene_frames(MOTIONS[1], seconds=1.5, rate_hz=8, seed=2, drop=0.3))
    np.testing.assert_array_equal(again.image, frames[0].image)


@pytest.mark.parametrize("walker", walkers(3), ids=lambda walker: walker.class_name)
def test_those_who_walk_go_at_their_speed_and_look_where_they_go(walker: Walker) -> None:
    step_s = 0.01
    for time_s in np.linspace(0, 40, 23):
        before, after = walker.at(0, float(time_s)), walker.at(0, float(time_s) + step_s)
        north, east = (
            b - a for a, b in zip(before.position_ned_m[:2], after.position_ned_m[:2], strict=True)
        )
        if before.yaw_rad == after.yaw_rad:  # not just turning back
            assert np.hypot(north, east) == pytest.approx(walker.speed_mps * step_s)
            assert np.cos(np.arctan2(east, north) - before.yaw_rad) == pytest.approx(1.0)


def test_command_reports_every_motion_and_method(capsys: pytest.CaptureFixture[str]) -> None:
    main(["--seconds", "1", "--rate-hz", "8", "--json"])
    figures = json.loads(capsys.readouterr().out)
    for motion in ("still", "gusts", "turning"):
        for way in ("last frame", "tracker", "tracker, attitude"):
            score = figures[f"{motion}: {way}"]
            assert score["mota"] <= 1.0
            assert score["objects"] > 20
    assert figures["tracker_ms"]["p50_ms"] > 0
