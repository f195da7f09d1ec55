"""Selection of an object by a rectangle: which track it is, its rules, and its errors."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.vision.tracking.test_correlation_filter import GROUND, image
from vision.detections import Detections
from vision.frame import Frame
from vision.tracking import (
    TARGET_CLASS,
    ObjectSelection,
    Selected,
    SelectRequest,
    TrackedFrame,
    Tracker,
    TrackerSettings,
)

NAMES = ("person", "car")
FRAME_S = 0.1
CAR = (400.0, 100.0, 500.0, 160.0)


class Camera:
    """A thing at a place on the ground, which no detection covers, and a car that the detector reports."""

    def __init__(self) -> None:
        self.tracker = Tracker(TrackerSettings())
        self.selection = ObjectSelection(self.tracker.settings, self.tracker.take_id)
        self.now_ns = 10**9
        self.number = 0
        self.at: tuple[float, float] | None = (150.0, 200.0)
        self.events: list[tuple[str, int]] = []
        self.answers: list[Selected] = []

    def show(self, frames: int = 1) -> Detections:
        for _ in range(frames):
            self.now_ns += round(FRAME_S * 1e9)
            self.number += 1
            gray = GROUND if self.at is None else image(*self.at, 60, 40)
            colour: NDArray[np.uint8] = np.repeat(gray[..., None], 3, axis=2)
            frame = Frame(np.ascontiguousarray(colour), self.now_ns, self.number)
            found = Detections(np.array([CAR], np.float32), np.array([0.8], np.float32), np.array([1]), NAMES)
            tracked = self.tracker.update(found, self.now_ns)
            shown: TrackedFrame = self.selection.update(frame, tracked, None)
            self.events += [(e.kind.value, e.track.track_id) for e in shown.events]
            self.answers += self.selection.take_answers()
        return shown.detections

    def select(
        self, left: float, top: float, right: float, bottom: float, stamp_ns: int | None = None
    ) -> Selected:
        rectangle = (left / 640, top / 480, (right - left) / 640, (bottom - top) / 480)
        self.selection.request(SelectRequest(rectangle, stamp_ns))
        self.show()
        return self.answers[-1]


@pytest.fixture
def camera() -> Camera:
    camera = Camera()
    camera.show(5)
    return camera


def target_of(detections: Detections) -> tuple[int, list[float]] | None:
    for record in detections.records():
        if record["class_name"] == TARGET_CLASS:
            assert record["track_state"] == "confirmed"
            assert record["track_id"] is not None
            return record["track_id"], record["xyxy"]
    return None


def test_rectangle_without_a_detection_becomes_a_track(camera: Camera) -> None:
    assert target_of(camera.show()) is None
    answer = camera.select(120, 180, 180, 220)
    assert answer == Selected(True, "track 2, a target", 2, TARGET_CLASS)
    assert camera.events[-1] == ("new", 2)
    for _ in range(20):
        assert camera.at is not None
        camera.at = (camera.at[0] + 5, camera.at[1] + 2)
        found = target_of(camera.show())
        assert found is not None
        track_id, xyxy = found
        assert track_id == 2
        x, y = camera.at
        assert xyxy == pytest.approx([x - 30, y - 20, x + 30, y + 20], abs=5.0)
        assert camera.events[-1] == ("update", 2)


def test_rectangle_on_a_detection_names_its_track(camera: Camera) -> None:
    answer = camera.select(410, 95, 505, 165)
    assert answer == Selected(True, answer.reason, 1, "car")
    assert answer.reason.startswith("track 1, a car, ")
    assert target_of(camera.show()) is None


def test_rectangle_covered_by_less_than_half_is_another_object(camera: Camera) -> None:
    assert camera.select(440, 120, 640, 240).class_name == TARGET_CLASS


def test_ids_are_not_used_twice(camera: Camera) -> None:
    assert camera.select(120, 180, 180, 220).track_id == 2
    assert camera.select(120, 180, 180, 220).track_id == 3
    assert camera.events[-2:] == [("end", 2), ("new", 3)]
    assert camera.tracker.take_id() == 4


def test_selection_is_lost_and_ends_as_other_tracks_do(camera: Camera) -> None:
    camera.select(120, 180, 180, 220)
    camera.show(3)
    camera.at = None
    camera.events.clear()
    assert target_of(camera.show()) is None
    camera.show(8)
    assert ("lost", 2) in camera.events
    camera.show(15)
    assert ("end", 2) in camera.events


def test_selection_that_returns_in_time_has_the_same_id(camera: Camera) -> None:
    camera.select(120, 180, 180, 220)
    camera.show(3)
    at, camera.at = camera.at, None
    camera.show(10)
    camera.at = at
    found = target_of(camera.show())
    assert found is not None
    assert found[0] == 2


def test_select_without_a_rectangle_ends_the_selection(camera: Camera) -> None:
    camera.select(120, 180, 180, 220)
    camera.selection.request(SelectRequest(None))
    camera.show()
    assert camera.answers[-1] == Selected(True, "track 2 ended")
    assert camera.events[-1] == ("end", 2)
    assert target_of(camera.show()) is None
    camera.selection.request(SelectRequest(None))
    camera.show()
    nothing = camera.answers[-1]
    assert nothing == Selected(True, nothing.reason)
    assert "nothing" in nothing.reason


def test_rectangle_of_an_earlier_image_is_followed_to_the_newest(camera: Camera) -> None:
    shown_ns = camera.now_ns
    for _ in range(6):
        assert camera.at is not None
        camera.at = (camera.at[0] + 12, camera.at[1])
        camera.show()
    answer = camera.select(120, 180, 180, 220, shown_ns)
    assert answer.success, answer.reason
    found = target_of(camera.show())
    assert found is not None
    assert camera.at is not None
    x, y = camera.at
    assert found[1] == pytest.approx([x - 30, y - 20, x + 30, y + 20], abs=6.0)


@pytest.mark.parametrize(
    ("rectangle", "words"),
    [((100.0, 100.0, 104.0, 140.0), ["4 by 40 pixels", "8 by 8"]), ((560.0, 420.0, 620.0, 470.0), ["even"])],
)
def test_unusable_rectangle_is_refused(
    camera: Camera,
    rectangle: tuple[float, float, float, float],
    words: list[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ground = GROUND.copy()
    ground[400:, 540:] = 120
    monkeypatch.setattr("tests.vision.tracking.test_correlation_filter.GROUND", ground)
    answer = camera.select(*rectangle)
    assert not answer.success
    assert answer.track_id is None
    assert [word for word in words if word not in answer.reason] == []


def test_rectangle_of_an_image_that_is_not_kept_is_refused(camera: Camera) -> None:
    old_ns = camera.now_ns
    camera.show(20)
    answer = camera.select(120, 180, 180, 220, old_ns)
    assert not answer.success
    assert f"stamp_ns {old_ns}: " in answer.reason
    assert "2.1 s before" in answer.reason


def test_failed_selection_ends_the_one_before(camera: Camera) -> None:
    camera.select(120, 180, 180, 220)
    assert not camera.select(100, 100, 104, 140).success
    assert camera.events[-1] == ("end", 2)


def test_large_images_are_followed_in_their_own_pixels() -> None:
    big = Camera()
    rng = np.random.default_rng(1)
    blocks = np.kron(rng.integers(0, 255, (27, 48), np.uint8), np.ones((40, 40), np.uint8))
    colour = np.ascontiguousarray(np.repeat(blocks[..., None], 3, axis=2))
    empty = big.tracker.update(Detections.empty(NAMES), 1)
    big.selection.request(SelectRequest((0.25, 0.25, 0.1, 0.1)))
    shown = big.selection.update(Frame(colour, 10**9, 0), empty, None)
    shown = big.selection.update(Frame(colour, 10**9 + 10**8, 1), TrackedFrame(empty.detections, ()), None)
    found = target_of(shown.detections)
    assert found is not None
    assert found[1] == pytest.approx([480, 270, 672, 378], abs=4.0)
