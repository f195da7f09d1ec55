"""Confidence and classes of a running detector are changed; what it was loaded for bounds them."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from companion.perception.assembly import change_detecting, load_detector
from companion.perception.messages import Detecting, Ready
from companion.perception.supervisor import PerceptionState, PerceptionSupervisor
from companion.settings import DetectorSection
from tests.companion.perception.test_perception_supervisor import Recorder, settings_of, supervised, until
from vision.class_names import joined_names
from vision.detections import Detections
from vision.detector import open_detector
from vision.object_detector import DETECTORS, DetectorSettings, ObjectDetector
from vision.tracking import Tracker, TrackerSettings, TrackEventKind

BOTH = {"detector.confidence": "0", "tracker.enabled": "false"}


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    folder = tmp_path / "photos"
    folder.mkdir()
    for number in range(3):
        image = np.random.default_rng(number).integers(0, 255, (48, 64, 3), dtype=np.uint8)
        cv2.imwrite(str(folder / f"{number}.png"), image)
    return folder


def names_of(recorder: Recorder, since: int) -> set[str]:
    return {name for result in recorder.results[since:] for name in result.detections.names}


@pytest.mark.realtime
async def test_changed_classes_change_the_detections(photos: Path, exported_model: Path) -> None:
    async with supervised(settings_of(photos, exported_model, **BOTH)) as (supervisor, recorder):
        await until(lambda: len(recorder.results) >= 6)
        before = names_of(recorder, 0)
        assert len(before) >= 2
        (kept, *_) = sorted(before)
        section = DetectorSection(confidence=0.0, classes=(kept,))
        supervisor.check_detecting(section)
        supervisor.change_detecting(section)
        await until(lambda: set(recorder.results[-1].detections.names) == {kept})
        changed = len(recorder.results)
        pid = supervisor.status.pid
        assert pid is not None

        os.kill(pid, signal.SIGKILL)
        await until(lambda: supervisor.status.restarts == 1 and supervisor.state is PerceptionState.RUNNING)
        restarted = len(recorder.results)
        await until(lambda: len(recorder.results) >= restarted + 6)
        assert names_of(recorder, changed) == {kept}

        supervisor.check_detecting(DetectorSection(confidence=0.0))  # the replacement was loaded for all, too
        supervisor.change_detecting(DetectorSection(confidence=0.0))
        await until(lambda: len(set(recorder.results[-1].detections.names)) >= 2)
        supervisor.change_detecting(DetectorSection(confidence=1.0))
        await until(lambda: not recorder.results[-1].detections.names)


def supervisor_with(ready: Ready | None) -> PerceptionSupervisor:
    supervisor = PerceptionSupervisor(settings_of("none"), on_result=lambda _: None, on_event=lambda *_: None)
    supervisor._ready = ready
    return supervisor


LOADED = Ready("a", "m", ("person", "car", "boat"), None, min_confidence=0.05, reportable_ids=(1, 2))


@pytest.mark.parametrize(
    ("ready", "section", "words"),
    [
        (None, DetectorSection(), "no model"),
        (Ready("a", None, (), None), DetectorSection(), "no model"),
        (LOADED, DetectorSection(classes=("cat",)), "did you mean car"),
        (LOADED, DetectorSection(classes=(3,)), "classes 0..2"),
        (LOADED, DetectorSection(classes=("car", "person")), "loaded for car, boat alone"),
        (LOADED, DetectorSection(classes=()), "loaded for car, boat alone"),
        (LOADED, DetectorSection(classes=("car",), confidence=0.04), "at least 0.05"),
    ],
)
def test_what_the_loaded_detector_cannot_do_is_refused(
    ready: Ready | None, section: DetectorSection, words: str
) -> None:
    with pytest.raises(ValueError, match=words):
        supervisor_with(ready).check_detecting(section)
    supervisor_with(LOADED).check_detecting(DetectorSection(classes=("Car", 2), confidence=0.05))


def test_network_of_few_classes_reports_no_others(small_model: Path) -> None:
    some = load_detector(settings_of("none", small_model, **{"detector.classes": "car,boat"}))
    every = load_detector(settings_of("none", small_model))
    assert (some.reportable_ids, every.reportable_ids) == ((1, 2), (0, 1, 2))
    assert some.min_confidence == every.min_confidence == 0.05
    low = load_detector(settings_of("none", small_model, **BOTH))
    assert low.min_confidence == 0.0


@pytest.fixture
def everything() -> Iterator[str]:
    """A kind of detector."""
    DETECTORS.add("everything", "two objects", lambda _: Everything())
    yield "everything"
    DETECTORS.remove("everything")


class Everything(ObjectDetector):
    class_names = ("car", "person")

    def detect(self, image_bgr: NDArray[np.uint8], /) -> Detections:
        boxes = np.array([[8, 8, 24, 24], [30, 8, 46, 24]], np.float32)
        return Detections(boxes, np.array([0.6, 0.4], np.float32), np.array([0, 1]), self.class_names)


def test_detector_of_a_plug_in_is_bounded_by_what_it_was_opened_for(everything: str) -> None:
    image = np.zeros((48, 64, 3), np.uint8)
    opened = open_detector(everything, DetectorSettings(confidence=0.3, classes=("car",)))
    assert (opened.min_confidence, opened.reportable_ids) == (0.3, (0,))
    assert opened.detect(image).names == ["car"]
    opened.confidence = 0.7
    assert opened.detect(image).names == []


def test_track_of_a_class_that_is_not_detected_any_more_ends(everything: str) -> None:
    settings = settings_of("none", **{"detector.enabled": "true", "detector.kind": everything})
    detector = load_detector(settings)
    tracker = Tracker(TrackerSettings())
    image = np.zeros((48, 64, 3), np.uint8)
    frames = iter(range(0, 10**10, 10**8))
    for _ in range(10):
        shown = tracker.update(detector.detect(image), next(frames), None, image)
    assert sorted(shown.detections.names) == ["car", "person"]
    change_detecting(settings, Detecting(0.25, ("person",)), detector, tracker)
    events = []
    for _ in range(30):
        shown = tracker.update(detector.detect(image), next(frames), None, image)
        assert shown.detections.names == ["person"]
        events += [event for event in shown.events if event.kind is TrackEventKind.END]
    assert [event.track.class_name for event in events] == ["car"]


def test_many_unknown_names_take_no_time() -> None:
    names = tuple(f"n{index}" for index in range(4000))
    assert joined_names(names, ("car", "traffic light, red")) == names
    assert joined_names(("traffic light", " red", "car"), ("car", "traffic light, red"))[1:] == ("car",)
