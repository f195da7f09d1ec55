"""Detector kinds, and the handling of a plug-in's detections."""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

from vision.detections import Detections
from vision.detector import Detector, open_detector
from vision.object_detector import (
    DETECTORS,
    YOLO,
    DetectionsError,
    DetectorSettings,
    ObjectDetector,
    Timing,
    detector,
)

FRAME = np.zeros((48, 64, 3), np.uint8)


class Corners(ObjectDetector):
    """Detects one object of each class, with decreasing confidence."""

    class_names = ("a", "b", "c")

    def __init__(self, settings: DetectorSettings) -> None:
        self.settings = settings

    def detect(self, image_bgr: NDArray[np.uint8], /) -> Detections:
        boxes = np.array([(0, 0, 9, 9), (20, 0, 29, 9), (40, 0, 49, 9)], np.float32)
        return Detections(
            boxes, np.array([0.9, 0.6, 0.3], np.float32), np.arange(3, dtype=np.int64), self.class_names
        )


class Wrong(Corners):
    """Reports other class names than it declares."""

    def detect(self, image_bgr: NDArray[np.uint8], /) -> Detections:
        return Detections.empty(("a", "b"))


class Seven(Corners):
    """Returns a number."""

    def detect(self, image_bgr: NDArray[np.uint8], /) -> Detections:
        return 7  # type: ignore[return-value]


class Timed(Corners):
    """Has its own timing, name and runtime."""

    model_name, runtime, precision, reason = "corners-2", "harris", "int8", "there is no other"
    last_timing = Timing(1.0, 2.0, 3.0)


@pytest.fixture(autouse=True)
def _kinds() -> Iterator[None]:
    kinds = {"corners": Corners, "wrong": Wrong, "seven": Seven, "timed": Timed}
    for kind, opener in kinds.items():
        detector(kind, "of a test")(opener)
    yield
    for kind in kinds:
        DETECTORS.remove(kind)


@pytest.mark.parametrize(
    ("settings", "names"),
    [
        (DetectorSettings(confidence=0.0), ["a", "b", "c"]),
        (DetectorSettings(confidence=0.5), ["a", "b"]),
        (DetectorSettings(confidence=0.0, classes=("b", 2)), ["b", "c"]),
        (DetectorSettings(confidence=0.5, classes=("c",)), []),
    ],
)
def test_classes_and_confidence_apply_to_a_plugin(settings: DetectorSettings, names: list[str]) -> None:
    assert open_detector("corners", settings).detect(FRAME).names == names


def test_unknown_class_of_a_plugin_is_rejected() -> None:
    with pytest.raises(ValueError, match="class 'd'; known: a, b, c"):
        open_detector("corners", DetectorSettings(classes=("d",)))


def test_unknown_kind_lists_the_known_ones() -> None:
    with pytest.raises(ValueError, match=r"'yollo'.*yolo.*corners"):
        open_detector("yollo", DetectorSettings())


@pytest.mark.parametrize("kind", [YOLO, "Corners", ""])
def test_duplicate_or_malformed_kind_is_rejected(kind: str) -> None:
    before = DETECTORS.known()
    with pytest.raises(ValueError, match=r"test_object_detector\.Corners"):
        detector(kind, "of a test")(Corners)
    assert DETECTORS.known() == before


def test_detector_without_timing_is_timed_as_a_whole() -> None:
    made = open_detector("corners", DetectorSettings())
    assert made.last_timing is None
    made.detect(FRAME)
    timing = made.last_timing
    assert timing is not None
    assert 0.0 < timing.inference_ms == timing.total_ms
    assert (made.model_name, made.runtime, made.precision) == ("corners", None, None)


def test_detector_may_set_its_description() -> None:
    made = open_detector("timed", DetectorSettings())
    made.detect(FRAME)
    assert (made.model_name, made.runtime, made.precision, made.reason) == (
        "corners-2",
        "harris",
        "int8",
        Timed.reason,
    )
    assert made.last_timing == Timing(1.0, 2.0, 3.0)


@pytest.mark.parametrize(("kind", "got"), [("wrong", r"\('a', 'b'\)"), ("seven", "int 7")])
def test_wrong_result_of_a_plugin_is_named(kind: str, got: str) -> None:
    with pytest.raises(DetectionsError, match=kind) as error:
        open_detector(kind, DetectorSettings()).detect(FRAME)
    assert re.search(f"'{kind}': .*got {got}$", str(error.value))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("opened", "got"),
    [
        (7, "int 7"),
        (Corners, "ABCMeta <class"),
        (type("Nameless", (Corners,), {"class_names": None})(None), "None"),
    ],
)
def test_kind_that_opens_no_detector_is_named(opened: object, got: str) -> None:
    def opener(settings: DetectorSettings) -> ObjectDetector:
        return opened  # type: ignore[return-value]

    detector("none", "of a test")(opener)
    try:
        with pytest.raises(ValueError, match=rf"'none'.*got .*{got}"):
            open_detector("none", DetectorSettings())
    finally:
        DETECTORS.remove("none")


def test_yolo_is_a_registered_kind() -> None:
    made = open_detector(YOLO, DetectorSettings(confidence=0.5, image_size=64, precision="float32"))
    assert isinstance(made, Detector)
    assert (made.model_name, made.runtime, made.precision) == ("default", "onnxruntime", "float32")
    assert (made.confidence, made.image_size) == (0.5, 64)
    assert made.reason
