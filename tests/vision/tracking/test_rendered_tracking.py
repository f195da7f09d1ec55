"""What tracking is worth on rendered sequences with known truth; the bench runs longer ones."""

from __future__ import annotations

import pytest

from benchmarks.scenes import MOTIONS, Motion, SyntheticDetector, scene_frames, without_image
from benchmarks.tracking import Seen, attitudes_of, no_tracking, tracked
from vision.tracking import TrackerSettings
from vision.tracking.clear_mot import MotScore, clear_mot

SECONDS, RATE_HZ = 5.0, 10.0
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
def test_a_tracker_switches_far_less_than_frame_by_frame_and_invents_less(
    scores: Scores, motion: str
) -> None:
    ways = scores[motion]
    assert ways["tracker"].switches < 0.5 * ways["last frame"].switches
    assert ways["attitude"].switches < 0.15 * ways["last frame"].switches
    assert ways["tracker"].false_positives < 0.3 * ways["last frame"].false_positives
    assert ways["attitude"].idf1 > ways["last frame"].idf1 + 0.3


@pytest.mark.parametrize("motion", ["gusts", "turning"])
def test_the_vehicles_attitude_keeps_identities_of_a_moving_camera(scores: Scores, motion: str) -> None:
    ways = scores[motion]
    assert ways["attitude"].switches < 0.5 * ways["tracker"].switches
    assert ways["attitude"].mota > ways["tracker"].mota + 0.1
    assert ways["attitude"].mota > ways["last frame"].mota + 0.2
    assert ways["attitude"].idf1 > ways["tracker"].idf1 + 0.15


def test_with_the_attitude_a_moving_camera_is_nearly_as_good_as_one_that_stands_still(scores: Scores) -> None:
    still = scores["still"]["attitude"].mota
    assert scores["gusts"]["attitude"].mota > still - 0.1
    assert scores["turning"]["attitude"].mota > still - 0.15


def test_a_camera_that_stands_still_needs_no_attitude(scores: Scores) -> None:
    ways = scores["still"]
    assert ways["attitude"].mota == pytest.approx(ways["tracker"].mota, abs=0.03)
