"""Identities in a real street video with cuts: objects that were distinguished by eye."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from vision.detections import Detections
from vision.detector import Detector
from vision.tracking import Tracker, TrackerSettings
from vision.tracking.association import overlaps

DATA = Path(
    os.environ.get("COMPANION_TEST_DATA", Path(__file__).resolve().parents[3].parent / "shared" / "data")
)
VIDEO, MODEL = DATA / "video" / "bikes.mp4", DATA / "models" / "yolov8n_coco.pt"
# Frame and box of an object, then of another one that took its track over without appearance. The scene is
# cut between the frames 75 and 76; the last two are a white van and the dark car behind it.
TAKEN_OVER = [
    (66, (394, 6, 640, 245), 80, (380, 23, 639, 270)),
    (74, (135, 108, 639, 268), 79, (432, 121, 640, 270)),
    (75, (2, 61, 638, 270), 78, (1, 53, 324, 272)),
    (83, (360, 6, 639, 272), 96, (392, 166, 639, 272)),
]
FRAMES, FRAME_NS = range(55, 97), 40_000_000


def track_at(tracked: Detections, box: tuple[int, int, int, int]) -> int:
    (overlap,) = overlaps(np.array([box], np.float32), tracked.xyxy)
    assert overlap.max() > 0.9
    assert tracked.track_id is not None
    return int(tracked.track_id[overlap.argmax()])


@pytest.mark.slow
@pytest.mark.skipif(
    not (VIDEO.is_file() and MODEL.is_file()), reason=f"{DATA} is not here; set COMPANION_TEST_DATA"
)
def test_another_vehicle_does_not_take_a_track_over() -> None:
    detector = Detector(MODEL, precision="float32", confidence=TrackerSettings().low_confidence)
    with_images, without = Tracker(), Tracker()
    video = cv2.VideoCapture(str(VIDEO))
    frames: dict[int, tuple[Detections, Detections]] = {}
    for number in range(FRAMES.stop):
        read, image = video.read()
        assert read
        if number in FRAMES:
            found, at = detector.detect(np.asarray(image, np.uint8)), number * FRAME_NS + 1
            frames[number] = (
                with_images.update(found, at, image=np.asarray(image, np.uint8)).detections,
                without.update(found, at).detections,
            )
    for first, box, second, other_box in TAKEN_OVER:
        before, after = frames[first], frames[second]
        assert track_at(before[0], box) != track_at(after[0], other_box)
        assert track_at(before[1], box) == track_at(after[1], other_box)  # so that the test tests something
