from __future__ import annotations

import pickle
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from vision.camera_model import CameraModel
from vision.depth import surfaces
from vision.detections import Detections
from vision.frame import Frame
from vision.object_detector import Timing
from vision.pipeline import PerceptionResult, Pipeline
from vision.sources import EndOfStream, Source, SourceSettings, SourceStatistics, open_source
from vision.tracking import Tracker

pytestmark = pytest.mark.realtime

WIDTH, HEIGHT = 96, 64


class BrightSpot:
    """A detector of the brightest square, which distinguishes frames."""

    class_names = ("spot",)
    last_timing = Timing(1.0, 2.0, 3.0)

    def detect(self, image_bgr: np.ndarray, /) -> Detections:
        rows, columns = np.nonzero(image_bgr.max(axis=2) > 200)
        if len(rows) == 0:
            return Detections.empty(self.class_names)
        box = np.array([[columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]], np.float32)
        return Detections(box, np.ones(1, np.float32), np.zeros(1, np.int64), self.class_names)


class Frames(Source):
    """A source of given frames; None is a timeout."""

    uri = "frames"
    live = True

    def __init__(self, *frames: Frame | None) -> None:
        self._frames = list(frames)

    def read(self, timeout_s: float = 1.0) -> Frame | None:
        if not self._frames:
            raise EndOfStream
        return self._frames.pop(0)

    @property
    def statistics(self) -> SourceStatistics:
        return SourceStatistics()

    def close(self) -> None:
        self._frames.clear()


def frame_of(sequence: int, *, spot_x: int = 40, depth_m: float | None = None) -> Frame:
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    image[20:36, spot_x : spot_x + 16] = 255
    depth = None
    if depth_m is not None:
        depth = np.full((HEIGHT, WIDTH), 50.0, np.float32)
        depth[20:36, spot_x : spot_x + 16] = depth_m
    return Frame(image, time.monotonic_ns(), sequence, depth)


def surfaces_in(frame: Frame, xyxy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    assert frame.depth_m is not None
    camera = CameraModel.from_horizontal_fov(WIDTH, HEIGHT, 1.0)
    return surfaces(frame.depth_m, xyxy, camera, np.array([0.0, 1.0, 0.0]))


def run(pipeline: Pipeline) -> list[PerceptionResult]:
    results: list[PerceptionResult] = []
    while True:
        try:
            pipeline.step(0.1, results.append)
        except EndOfStream:
            return results


def test_every_frame_of_a_folder_gives_a_stamped_result(tmp_path: Path) -> None:
    for number in range(4):
        cv2.imwrite(str(tmp_path / f"{number}.png"), frame_of(0, spot_x=number * 10).image)
    with open_source(str(tmp_path), SourceSettings()) as source:
        results = run(Pipeline(source, BrightSpot()))
    assert [result.sequence for result in results] == [0, 1, 2, 3]
    assert [result.detections.xyxy[0, 0] for result in results] == [0, 10, 20, 30]
    assert all(result.captured_ns < result.inferred_ns for result in results)
    assert {(result.width, result.height, result.dropped) for result in results} == {(WIDTH, HEIGHT, 0)}


def test_every_stage_is_timed() -> None:
    (result,) = run(Pipeline(Frames(frame_of(0)), BrightSpot()))
    assert result.timing_ms["preprocess"] == 1.0
    assert result.timing_ms["inference"] == 2.0
    assert result.timing_ms["postprocess"] == 3.0
    assert result.timing_ms["total"] >= result.timing_ms["range"] >= 0


def test_depth_gives_every_detection_its_range() -> None:
    frames = Frames(frame_of(0, depth_m=6.5), frame_of(1))
    near, none = run(Pipeline(frames, BrightSpot(), surfaces_in=surfaces_in))
    assert near.detections.depth_m == pytest.approx([6.5])
    assert near.depth is not None
    assert near.depth.valid_share == 1.0
    assert none.depth is None
    assert np.isnan(none.detections.depth_m).all()


def tenths_of_a_second(*frames: Frame) -> Frames:
    return Frames(*(replace(frame, captured_ns=frame.sequence * 100_000_000) for frame in frames))


def test_only_frames_up_to_the_rate_are_processed() -> None:
    frames = tenths_of_a_second(*(frame_of(number) for number in range(7)))
    pipeline = Pipeline(frames, BrightSpot(), max_rate_hz=1 / 0.3)
    assert [result.sequence for result in run(pipeline)] == [0, 3, 6]
    assert pipeline.frames == 7
    assert pipeline.dropped == 0
    assert pipeline.frames_skipped == {"replaced": 0, "unreadable": 0, "rate": 4}


def test_frames_that_the_source_lost_are_counted() -> None:
    pipeline = Pipeline(Frames(frame_of(1), frame_of(2), frame_of(6)), BrightSpot())
    results = run(pipeline)
    assert [result.dropped for result in results] == [1, 1, 4]
    assert [result.frames_skipped["replaced"] for result in results] == [1, 1, 4]


def test_arrival_decoding_and_waiting_are_timed_separately() -> None:
    now_ns = time.monotonic_ns()
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    frame = Frame(image, now_ns - 50_000_000, 0, ready_ns=now_ns - 30_000_000, decode_ms=5.0)
    (result,) = run(Pipeline(Frames(frame), BrightSpot()))
    assert result.timing_ms["capture"] == pytest.approx(15.0)
    assert result.timing_ms["decode"] == 5.0
    assert result.timing_ms["wait"] >= 30.0


def test_timeout_without_a_frame_is_not_the_end() -> None:
    results: list[PerceptionResult] = []
    pipeline = Pipeline(Frames(None, frame_of(0)), BrightSpot())
    assert pipeline.step(0.1, results.append) is False
    assert pipeline.step(0.1, results.append) is True
    assert len(results) == 1


def test_without_a_detector_every_result_is_empty() -> None:
    (result,) = run(Pipeline(Frames(frame_of(0, depth_m=4.0)), None))
    assert len(result.detections) == 0
    assert "inference" not in result.timing_ms


def test_a_result_is_small_and_survives_pickling() -> None:
    (result,) = run(Pipeline(Frames(frame_of(3, depth_m=4.0)), BrightSpot()))
    data = pickle.dumps(result)
    assert len(data) < 4096
    copy = pickle.loads(data)
    assert copy.detections.records() == result.detections.records()
    assert (copy.sequence, copy.captured_ns, copy.timing_ms) == (3, result.captured_ns, result.timing_ms)


class Flickering:
    """The bright spot, alternately with high and low confidence, and a weak false detection."""

    class_names = ("spot",)
    last_timing = BrightSpot.last_timing

    def __init__(self) -> None:
        self._spot = BrightSpot()
        self._calls = 0

    def detect(self, image_bgr: np.ndarray, /) -> Detections:
        spot = self._spot.detect(image_bgr)
        ghost = np.array([[0, 50, 10, 60]], np.float32)
        sure = 0.15 if self._calls % 4 == 3 else 0.9
        self._calls += 1
        return Detections(
            np.concatenate([spot.xyxy, ghost]),
            np.array([sure, 0.2], np.float32),
            np.zeros(2, np.int64),
            self.class_names,
        )


def test_tracker_sets_ids_and_keeps_weak_detections_of_tracks() -> None:
    frames = [frame_of(number, spot_x=10 + 3 * number) for number in range(8)]
    frames = [replace(frame, captured_ns=frame.sequence * 100_000_000 + 1) for frame in frames]
    results = run(Pipeline(Frames(*frames), Flickering(), tracker=Tracker()))
    tracked = [result.detections.track_id for result in results]
    assert [ids is not None and ids.tolist() for ids in tracked] == [[1]] * 8
    confidences = [float(result.detections.confidence[0]) for result in results]
    assert confidences == pytest.approx([0.9, 0.9, 0.9, 0.15] * 2)
    kinds = [[event.kind.value for event in result.track_events] for result in results]
    assert kinds == [[], [], ["new"]] + [["update"]] * 5
    assert all(result.timing_ms["track"] > 0 for result in results)


def test_ranges_are_measured_for_tracked_detections_too() -> None:
    (result,) = run(
        Pipeline(Frames(frame_of(0, depth_m=6.5)), Flickering(), tracker=Tracker(), surfaces_in=surfaces_in)
    )
    assert result.detections.depth_m == pytest.approx([6.5])


def test_view_is_requested_after_each_detection() -> None:
    asked: list[tuple[int, bool]] = []
    detector = Flickering()

    def view_at(frame: Frame) -> None:
        asked.append((frame.sequence, detector._calls == len(asked) + 1))

    run(Pipeline(Frames(frame_of(0), frame_of(1)), detector, tracker=Tracker(), view_at=view_at))
    assert asked == [(0, True), (1, True)]


def test_without_a_tracker_there_are_no_track_ids() -> None:
    (result,) = run(Pipeline(Frames(frame_of(0)), Flickering()))
    assert result.detections.track_id is None
    assert result.track_events == ()
    (nothing,) = run(Pipeline(Frames(frame_of(0)), None, tracker=Tracker()))
    assert nothing.detections.track_id is None


class Kept:
    """A recorder that keeps its frames."""

    def __init__(self) -> None:
        self.kept: list[tuple[int, int]] = []

    def write(self, frame: Frame, detections: Detections, /) -> None:
        self.kept.append((frame.sequence, len(detections)))


def test_every_frame_is_recorded_with_the_newest_detections() -> None:
    dark = Frame(np.zeros((HEIGHT, WIDTH, 3), np.uint8), time.monotonic_ns(), 3)
    recorder = Kept()
    frames = [frame_of(0), frame_of(1), frame_of(2), dark]
    run(Pipeline(tenths_of_a_second(*frames), BrightSpot(), max_rate_hz=1 / 0.3, recorder=recorder))
    assert recorder.kept == [(0, 1), (1, 1), (2, 1), (3, 0)]
