"""The tracker: identities, confirmation, events."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vision.camera_model import CameraModel
from vision.detections import NO_TRACK, Detections
from vision.rotation import BODY_FROM_OPTICAL, matrix_from_euler
from vision.tracking import CameraView, TrackedFrame, Tracker, TrackerSettings, TrackEventKind, TrackState

NAMES = ("person", "car")
CAMERA = CameraModel.from_horizontal_fov(640, 480, math.radians(70))
FRAME_S = 0.05

Seen = tuple[float, float, float]  # x, y of the centre, confidence


def detections(*seen: Seen, class_id: int = 0, size: float = 40.0) -> Detections:
    middle = np.array([[x, y] for x, y, _ in seen], np.float32).reshape(-1, 2)
    return Detections(
        np.concatenate([middle - size / 2, middle + size / 2], axis=1).astype(np.float32),
        np.array([confidence for *_, confidence in seen], np.float32),
        np.full(len(seen), class_id, np.int64),
        NAMES,
    )


class TrackingSequence:
    """A tracker that receives one frame after another."""

    def __init__(self, **settings: float) -> None:
        self.tracker = Tracker(TrackerSettings(**settings))  # type: ignore[arg-type]
        self.now_s = 1.0
        self.reported: list[tuple[str, int]] = []

    def show(
        self, *seen: Seen, after_s: float = FRAME_S, view: CameraView | None = None, class_id: int = 0
    ) -> TrackedFrame:
        self.now_s += after_s
        return self.give(detections(*seen, class_id=class_id), view)

    def give(self, found: Detections, view: CameraView | None = None) -> TrackedFrame:
        frame = self.tracker.update(found, round(self.now_s * 1e9), view)
        self.reported += [(event.kind.value, event.track.track_id) for event in frame.events]
        return frame


def ids(frame: TrackedFrame) -> list[int]:
    assert frame.detections.track_id is not None
    found: list[int] = frame.detections.track_id.tolist()
    return found


def test_an_object_keeps_its_identity_while_it_moves() -> None:
    sequence = TrackingSequence()
    seen = [ids(sequence.show((100 + 8 * step, 200 - 3 * step, 0.8))) for step in range(30)]
    assert seen == [[1]] * 30


def test_crossing_objects_keep_their_ids() -> None:
    sequence = TrackingSequence()
    for step in range(60):
        frame = sequence.show((100 + 6 * step, 200, 0.8), (460 - 6 * step, 210, 0.8))
    assert ids(frame) == [1, 2]


def test_order_of_detections_does_not_matter() -> None:
    sequence = TrackingSequence()
    sequence.show((100, 100, 0.8), (300, 100, 0.8))
    sequence.show((100, 100, 0.8), (300, 100, 0.8))
    assert ids(sequence.show((300, 100, 0.8), (100, 100, 0.8))) == [2, 1]


def test_tracks_never_match_another_class() -> None:
    sequence = TrackingSequence()
    sequence.show((100, 100, 0.8))
    sequence.show((100, 100, 0.8))
    assert ids(sequence.show((100, 100, 0.8), class_id=1)) == [2]


def test_weak_detection_continues_but_never_starts_a_track() -> None:
    sequence = TrackingSequence(keep_confidence=0.25)
    assert ids(sequence.show((100, 100, 0.2))) == []
    for _ in range(3):
        sequence.show((100, 100, 0.8))
    frame = sequence.show((102, 100, 0.12), (400, 300, 0.2), (500, 300, 0.3))
    assert ids(frame) == [1, NO_TRACK]
    assert frame.detections.confidence == pytest.approx([0.12, 0.3])


def test_detections_below_low_confidence_are_ignored() -> None:
    sequence = TrackingSequence(low_confidence=0.1)
    for _ in range(3):
        sequence.show((100, 100, 0.8))
    assert ids(sequence.show((100, 100, 0.05))) == []


def test_weak_detection_does_not_revive_a_lost_track() -> None:
    sequence = TrackingSequence(coast_timeout_s=0.5)
    for _ in range(3):
        sequence.show((100, 100, 0.8))
    sequence.show(after_s=0.8)
    assert ids(sequence.show((100, 100, 0.2))) == []
    assert ids(sequence.show((100, 100, 0.6))) == [1]


def test_track_is_confirmed_by_its_median_confidence() -> None:
    sequence = TrackingSequence(confirm_score=0.5, min_hits=3)
    states = []
    for confidence in (0.36, 0.9, 0.4, 0.45, 0.6, 0.6, 0.6, 0.6, 0.6):
        frame = sequence.show((100, 100, confidence))
        (record,) = frame.detections.records()
        assert record["track_score"] is not None
        states.append((record["track_state"], round(record["track_score"], 3)))
    assert states == [
        ("tentative", 0.36),
        ("tentative", 0.63),  # two are too few
        ("tentative", 0.4),
        ("tentative", 0.425),
        ("tentative", 0.45),
        ("confirmed", 0.525),
        ("confirmed", 0.6),
        ("confirmed", 0.6),
        ("confirmed", 0.6),
    ]
    assert sequence.reported[0] == ("new", 1)


def test_confirmed_track_stays_confirmed() -> None:
    sequence = TrackingSequence(confirm_score=0.5)
    for confidence in [0.8] * 3 + [0.2] * 20:
        frame = sequence.show((100, 100, confidence))
    (record,) = frame.detections.records()
    assert record["track_state"] == "confirmed"
    assert record["track_score"] == pytest.approx(0.2)


def test_single_detection_makes_no_event() -> None:
    sequence = TrackingSequence()
    sequence.show((100, 100, 0.9))
    sequence.show()
    assert sequence.reported == []
    assert sequence.tracker.tracks == ()
    assert ids(sequence.show((100, 100, 0.9))) == [2]


def test_min_hits_of_one_confirms_at_once() -> None:
    sequence = TrackingSequence(min_hits=1)
    sequence.show((100, 100, 0.9))
    sequence.show()
    sequence.show((100, 100, 0.9))
    assert sequence.reported == [("new", 1), ("update", 1)]


def test_track_events_cover_its_life() -> None:
    sequence = TrackingSequence(coast_timeout_s=0.3, max_age_s=1.0)
    for _ in range(4):
        sequence.show((100, 100, 0.8))
    sequence.show(after_s=0.1)
    assert sequence.reported == [("new", 1), ("update", 1)]
    sequence.show(after_s=0.25)
    sequence.show(after_s=0.1)
    sequence.show((100, 100, 0.8), after_s=0.1)
    sequence.show(after_s=0.4)
    (end,) = sequence.show(after_s=0.7).events
    assert sequence.reported[2:] == [("lost", 1), ("update", 1), ("lost", 1), ("end", 1)]
    assert end.kind is TrackEventKind.END
    assert end.track.state is TrackState.CONFIRMED
    assert end.track.seen == 5
    assert (end.track.last_ns - end.track.first_ns) / 1e9 == pytest.approx(0.7)
    assert end.stamp_ns == round(sequence.now_s * 1e9)
    assert end.track.class_name == "person"


def test_long_gap_between_frames_ends_tracks() -> None:
    sequence = TrackingSequence(max_age_s=2.0)
    for _ in range(4):
        sequence.show((100, 100, 0.8))
    assert ids(sequence.show((100, 100, 0.8), after_s=1.9)) == [1]
    assert ids(sequence.show((100, 100, 0.8), after_s=2.1)) == [2]
    assert sequence.reported[-1] == ("end", 1)


def test_slow_detector_keeps_tracks() -> None:
    sequence = TrackingSequence(coast_timeout_s=0.5, max_age_s=2.0)
    for _ in range(4):
        frame = sequence.show((100, 100, 0.8), after_s=1.2)
    assert ids(frame) == [1]
    assert sequence.reported == [("new", 1), ("update", 1)]


def test_frame_interval_above_max_age_is_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    sequence = TrackingSequence(max_age_s=2.0)
    for _ in range(4):
        sequence.show((100, 100, 0.8), after_s=3.0)
    (line,) = caplog.messages
    assert "interval 3.0 s, max_age_s 2 s" in line


def test_events_have_detected_or_predicted_boxes() -> None:
    sequence = TrackingSequence(coast_timeout_s=0.3)
    for step in range(10):
        frame = sequence.show((100 + 10 * step, 100, 0.8))
    (update,) = frame.events
    assert update.track.xyxy == pytest.approx((170, 80, 210, 120))
    (lost,) = sequence.show(after_s=0.4).events
    left, _, right, _ = lost.track.xyxy
    assert (left + right) / 2 == pytest.approx(190 + 10 * 8, abs=10)


def test_tentative_track_ends_sooner() -> None:
    sequence = TrackingSequence(confirm_score=0.9, coast_timeout_s=0.3, max_age_s=5.0)
    for _ in range(5):
        sequence.show((100, 100, 0.5))
    sequence.show(after_s=0.4)
    assert sequence.tracker.tracks == ()
    assert sequence.reported == []


def test_timeouts_are_in_seconds_not_frames() -> None:
    sequence = TrackingSequence()
    rng = np.random.default_rng(4)
    x = 50.0
    for _ in range(40):
        after_s = float(rng.choice([0.03, 0.06, 0.2]))
        x += 90.0 * after_s
        frame = sequence.show((x, 200, 0.8), after_s=after_s)
    assert ids(frame) == [1]
    assert sequence.tracker.tracks[0].track_id == 1


def test_repeated_stamp_is_accepted() -> None:
    sequence = TrackingSequence()
    for after_s in (0.05, 0.05, 0.0, -0.02, 0.05):
        frame = sequence.show((100, 100, 0.8), after_s=after_s)
    assert ids(frame) == [1]


def view(yaw_deg: float, roll_deg: float = 0.0) -> CameraView:
    attitude = matrix_from_euler(math.radians(roll_deg), 0.0, math.radians(yaw_deg))
    return CameraView(CAMERA, attitude @ BODY_FROM_OPTICAL)


def object_at(bearing_deg: float, seen_from: CameraView) -> tuple[float, float]:
    """Pixel of a far object on the horizon."""
    bearing = math.radians(bearing_deg)
    ned = np.array([[math.cos(bearing), math.sin(bearing), 0.0]])
    x, y = CAMERA.project(ned @ seen_from.ned_from_optical)[0]
    return float(x), float(y)


@pytest.mark.parametrize(("known", "kept"), [(True, True), (False, False)])
def test_known_attitude_compensates_camera_rotation(known: bool, kept: bool) -> None:
    sequence = TrackingSequence()
    for yaw_deg, roll_deg in ((0, 0), (0, 0), (0, 0), (15, 0), (-10, 5), (-10, -20), (12, 15)):
        seen_from = view(yaw_deg, roll_deg)
        seen = [(*object_at(bearing, seen_from), 0.8) for bearing in (-9, 1, 8)]
        frame = sequence.show(*seen, view=seen_from if known else None)
    assert (ids(frame) == [1, 2, 3]) is kept


def test_track_survives_turning_away_and_back() -> None:
    sequence = TrackingSequence(max_age_s=3.0)
    for _ in range(4):
        sequence.show((*object_at(0, view(0)), 0.8), view=view(0))
    for yaw_deg in (20, 40, 60, 60, 40, 20):
        sequence.show(view=view(yaw_deg))
    assert ids(sequence.show((*object_at(0, view(0)), 0.8), view=view(0))) == [1]


def test_track_far_out_of_view_ends() -> None:
    sequence = TrackingSequence()
    for _ in range(4):
        sequence.show((*object_at(0, view(0)), 0.8), view=view(0))
    sequence.show(view=view(120))
    assert sequence.reported[-1] == ("end", 1)


def test_frame_without_attitude_is_not_compensated() -> None:
    sequence = TrackingSequence()
    for seen_from in (view(0), view(0), view(0), None, view(3), view(3)):
        frame = sequence.show((*object_at(0, view(0)), 0.8), view=seen_from)
    assert ids(frame) == [1]


def test_empty_frames_are_processed() -> None:
    sequence = TrackingSequence()
    frame = sequence.show()
    assert ids(frame) == []
    assert frame.events == ()
    assert frame.detections.track_confirmed is not None


def test_ranges_stay_with_their_detections() -> None:
    found = Detections(
        np.array([[0, 0, 10, 10], [50, 50, 60, 60]], np.float32),
        np.array([0.15, 0.9], np.float32),
        np.array([0, 1], np.int64),
        NAMES,
        np.array([[0.0, 0.0, 3.0], [0.0, 0.0, 7.0]], np.float32),
    )
    frame = TrackingSequence().give(found)
    assert frame.detections.depth_m.tolist() == [7.0]
    assert frame.detections.names == ["car"]


def test_ids_start_at_first_track_id() -> None:
    tracker = Tracker(first_track_id=40)
    assert ids(tracker.update(detections((100, 100, 0.8)), 1)) == [40]
    with pytest.raises(ValueError, match=r"first_track_id .* 0"):
        Tracker(first_track_id=0)


frame_sequences = st.lists(
    st.tuples(
        st.floats(0.0, 1.5),
        st.lists(st.tuples(st.floats(0, 640), st.floats(0, 480), st.floats(0, 1)), max_size=6),
        st.one_of(st.none(), st.floats(-90, 90)),
    ),
    max_size=12,
)


@settings(max_examples=60)
@given(frame_sequences)
def test_invariants_hold_for_any_input(frames: list[tuple[float, list[Seen], float | None]]) -> None:
    sequence = TrackingSequence(min_hits=2)
    live: set[int] = set()
    ended: set[int] = set()
    for after_s, seen, yaw_deg in frames:
        frame = sequence.show(*seen, after_s=after_s, view=None if yaw_deg is None else view(yaw_deg))
        found = frame.detections
        used = [identity for identity in ids(frame) if identity != NO_TRACK]
        assert len(used) == len(set(used))
        assert not ended & set(used)
        for event in frame.events:
            identity = event.track.track_id
            assert event.track.state is TrackState.CONFIRMED
            assert (identity in live) == (event.kind is not TrackEventKind.NEW)
            live.add(identity)
            if event.kind is TrackEventKind.END:
                live.remove(identity)
                ended.add(identity)
        assert found.track_confirmed is not None
        confirmed = {
            identity for identity, sure in zip(ids(frame), found.track_confirmed, strict=True) if sure
        }
        assert confirmed <= live
        assert live == {t.track_id for t in sequence.tracker.tracks if t.state is TrackState.CONFIRMED}
        assert all(np.isfinite(track.xyxy).all() for track in sequence.tracker.tracks)


# --- other classes on an object

CAR, PERSON = 1, 0


def detected_as(*names: tuple[int, float], x: float = 100.0) -> Detections:
    """One object that a frame reports with these classes, each with its confidence."""
    box = [[x - 20, 80.0, x + 20, 120.0]] * len(names)
    return Detections(
        np.array(box, np.float32).reshape(-1, 4),
        np.array([confidence for _, confidence in names], np.float32),
        np.array([class_id for class_id, _ in names], np.int64),
        NAMES,
    )


def confirmed(frame: TrackedFrame, class_id: int) -> list[bool]:
    assert frame.detections.track_confirmed is not None
    chosen = frame.detections.track_confirmed[frame.detections.class_id == class_id]
    return [bool(value) for value in chosen]


def show(sequence: TrackingSequence, frame: Detections, times: int) -> TrackedFrame:
    for _ in range(times):
        sequence.now_s += FRAME_S
        shown = sequence.give(frame)
    return shown


def test_an_object_whose_class_changed_is_not_confirmed() -> None:
    sequence = TrackingSequence()
    assert confirmed(show(sequence, detected_as((PERSON, 0.8)), 6), PERSON) == [True]
    assert confirmed(show(sequence, detected_as((CAR, 0.8)), 6), CAR) == [False]
    assert sequence.reported[-1] != ("new", 2)


def test_a_class_that_outweighs_the_former_one_is_confirmed() -> None:
    sequence = TrackingSequence()
    show(sequence, detected_as((PERSON, 0.5)), 3)
    assert confirmed(show(sequence, detected_as((CAR, 0.8)), 10), CAR) == [True]


def test_a_rival_class_in_the_same_frames_prevents_confirmation() -> None:
    sequence = TrackingSequence()
    frame = show(sequence, detected_as((CAR, 0.8), (PERSON, 0.6)), 10)
    assert (confirmed(frame, CAR), confirmed(frame, PERSON)) == ([False], [False])


def test_rare_or_weak_rival_class_changes_nothing() -> None:
    sequence = TrackingSequence()
    for step in range(20):
        names = [(CAR, 0.8), (PERSON, 0.7)] if step % 4 == 0 else [(CAR, 0.8), (PERSON, 0.12)]
        frame = show(sequence, detected_as(*names), 1)
    assert confirmed(frame, CAR) == [True]


def test_a_confirmed_track_is_in_doubt_while_its_class_changes() -> None:
    sequence = TrackingSequence()
    show(sequence, detected_as((CAR, 0.6)), 6)
    frame = show(sequence, detected_as((CAR, 0.6), (PERSON, 0.9)), 6)
    assert confirmed(frame, CAR) == [False]
    assert confirmed(show(sequence, detected_as((CAR, 0.8)), 8), CAR) == [True]
    assert sequence.reported.count(("new", 1)) == 1, "reported once"


def test_neighbouring_object_does_not_affect_the_class() -> None:
    sequence = TrackingSequence()
    for _ in range(6):
        sequence.now_s += FRAME_S
        rider, bicycle = detected_as((PERSON, 0.8)), detected_as((CAR, 0.8), x=112.0)
        both = Detections(
            np.concatenate([rider.xyxy, bicycle.xyxy]),
            np.concatenate([rider.confidence, bicycle.confidence]),
            np.concatenate([rider.class_id, bicycle.class_id]),
            NAMES,
        )
        frame = sequence.give(both)
    assert (confirmed(frame, CAR), confirmed(frame, PERSON)) == ([True], [True])
