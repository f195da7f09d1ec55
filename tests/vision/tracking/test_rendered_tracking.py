"""Tracking quality on rendered sequences with ground truth; the bench runs longer ones."""

from __future__ import annotations

import pytest

from benchmarks.clear_mot import MotScore, clear_mot
from benchmarks.scenes import MOTIONS, Motion, SyntheticDetector, scene_frames, without_image
from benchmarks.tracking import Seen, attitudes_of, no_tracking, tracked
from vision.tracking import TrackerSettings

SECONDS, RATE_HZ = 3.0, 10.0
SETTINGS = TrackerSettings()
Scores = dict[str, dict[str, MotScore]]


def scores_of(motion: Motion) -> dict[str, MotScore]:
    detector = SyntheticDetector(seed=1)
    sequence = [
        Seen(without_image(frame), detector.detect(frame))
        for frame in scene_frames(motion, seconds=SECONDS, rate_hz=RATE_HZ, seed=1, drop=0.1)
    ]
    return {
        "last frame": clear_mot(no_tracking(sequence, SETTINGS.keep_confidence)),
        "tracker": clear_mot(tracked(sequence, SETTINGS, None)),
        "attitude": clear_mot(tracked(sequence, SETTINGS, attitudes_of(motion, SECONDS, 1))),
    }


@pytest.fixture(scope="module")
def scores() -> Scores:
    return {motion.name: scores_of(motion) for motion in MOTIONS}


@pytest.mark.parametrize("motion", [motion.name for motion in MOTIONS])
def test_tracker_has_far_fewer_switches_than_matching(scores: Scores, motion: str) -> None:
    by_method = scores[motion]
    assert by_method["tracker"].switches < 0.5 * by_method["last frame"].switches
    assert by_method["attitude"].switches < 0.15 * by_method["last frame"].switches
    assert by_method["tracker"].false_positives < 0.3 * by_method["last frame"].false_positives
    assert by_method["attitude"].idf1 > by_method["last frame"].idf1 + 0.3


@pytest.mark.parametrize("motion", ["gusts", "turning"])
def test_attitude_keeps_identities_of_a_moving_camera(scores: Scores, motion: str) -> None:
    by_method = scores[motion]
    assert by_method["attitude"].switches < 0.5 * by_method["tracker"].switches
    assert by_method["attitude"].mota > by_method["tracker"].mota + 0.1
    assert by_method["attitude"].mota > by_method["last frame"].mota + 0.2
    assert by_method["attitude"].idf1 > by_method["tracker"].idf1 + 0.15


def test_attitude_makes_a_moving_camera_nearly_as_good(scores: Scores) -> None:
    still = scores["still"]["attitude"].mota
    assert scores["gusts"]["attitude"].mota > still - 0.1
    assert scores["turning"]["attitude"].mota > still - 0.15


def test_static_camera_needs_no_attitude(scores: Scores) -> None:
    by_method = scores["still"]
    assert by_method["attitude"].mota == pytest.approx(by_method["tracker"].mota, abs=0.03)
