"""What the tracker promises: who is who, who counts as true, and what it tells."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vision.camera_model import CameraModel
from vision.detections import NO_TRACK, Detections
from vision.rotation import BODY_FROM_OPTICAL, matrix_from_euler
from vision.tracking import (
    CameraView,
    TrackedFrame,
    Tracker,
    TrackerSettings,
    TrackEventKind,
    TrackState,
)

NAMES = ("person", "car")
CAMERA = CameraModel.from_horizontal_fov(640, 480, math.radians(70))
FRAME_S = 0.05

Seen = tuple[float, float, float]  # x, y of the middle, confidence


def detections(*seen: Seen, class_id: int = 0, size: float = 40.0) -> Detections:
    middle = np.array([[x, y] for x, y, _ in seen], np.float32).reshape(-1, 2)
    return Detections(
        np.concatenate([middle - size / 2, middle + size / 2], axis=1).astype(np.float32),
        np.array([confidence for *_, confidence in seen], np.float32),
        np.full(len(seen), class_id, np.int64),
        NAMES,
    )


class Film:
    """A tracker that is given one frame after another."""

    def __init__(self, **settings: float) -> None:
        self.tracker = Tracker(TrackerSettings(**settings))  # type: ignore[arg-type]
        self.now_s = 1.0
        self.told: list[tuple[str, int]] = []

    def show(
        self, *seen: Seen, after_s: float = FRAME_S, view: CameraView | None = None, class_id: int = 0
    ) -> TrackedFrame:
        self.now_s += after_s
        return self.give(detections(*seen, class_id=class_id), view)

    def give(self, found: Detections, view: CameraView | None = None) -> TrackedFrame:
        frame = self.tracker.update(found, round(self.now_s * 1e9), view)
        self.told += [(event.kind.value, event.track.track_id) for event in frame.events]
        return frame


def ids(frame: TrackedFrame) -> list[int]:
    assert frame.detections.track_id is not None
    found: list[int] = frame.detections.track_id.tolist()
    return found


def test_an_object_keeps_its_identity_while_it_moves() -> None:
    film = Film()
    seen = [ids(film.show((100 + 8 * step, 200 - 3 * step, 0.8))) for step in range(30)]
    assert seen == [[1]] * 30


def test_objects_that_cross_each_other_keep_theirs() -> None:
    film = Film()
    for step in range(60):
        frame = film.show((100 + 6 * step, 200, 0.8), (460 - 6 * step, 210, 0.8))
    assert ids(frame) == [1, 2]


def test_the_order_of_detections_means_nothing() -> None:
    film = Film()
    film.show((100, 100, 0.8), (300, 100, 0.8))
    film.show((100, 100, 0.8), (300, 100, 0.8))
    assert ids(film.show((300, 100, 0.8), (100, 100, 0.8))) == [2, 1]


def test_a_class_is_never_taken_for_another() -> None:
    film = Film()
    film.show((100, 100, 0.8))
    film.show((100, 100, 0.8))
    assert ids(film.show((100, 100, 0.8), class_id=1)) == [2]


def test_a_weak_detection_continues_a_track_and_never_begins_one() -> None:
    film = Film(keep_confidence=0.25)
    assert ids(film.show((100, 100, 0.2))) == []
    for _ in range(3):
        film.show((100, 100, 0.8))
    frame = film.show((102, 100, 0.12), (400, 300, 0.2), (500, 300, 0.3))
    assert ids(frame) == [1, NO_TRACK]
    assert frame.detections.confidence == pytest.approx([0.12, 0.3])


def test_what_is_weaker_than_weak_is_not_looked_at() -> None:
    film = Film(low_confidence=0.1)
    for _ in range(3):
        film.show((100, 100, 0.8))
    assert ids(film.show((100, 100, 0.05))) == []


def test_a_weak_detection_does_not_wake_what_was_lost_long_ago() -> None:
    film = Film(coast_timeout_s=0.5)
    for _ in range(3):
        film.show((100, 100, 0.8))
    film.show(after_s=0.8)
    assert ids(film.show((100, 100, 0.2))) == []
    assert ids(film.show((100, 100, 0.6))) == [1]


def test_a_track_counts_as_true_past_the_second_threshold_of_its_median() -> None:
    film = Film(confirm_score=0.5, min_hits=3)
    states = []
    for confidence in (0.36, 0.9, 0.4, 0.45, 0.6, 0.6, 0.6, 0.6, 0.6):
        frame = film.show((100, 100, confidence))
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
    assert film.told[0] == ("new", 1)


def test_what_once_counted_as_true_goes_on_to_do_so() -> None:
    film = Film(confirm_score=0.5)
    for confidence in [0.8] * 3 + [0.2] * 20:
        frame = film.show((100, 100, confidence))
    (record,) = frame.detections.records()
    assert record["track_state"] == "confirmed"
    assert record["track_score"] == pytest.approx(0.2)


def test_what_is_seen_once_makes_no_event_and_is_forgotten() -> None:
    film = Film()
    film.show((100, 100, 0.9))
    film.show()
    assert film.told == []
    assert film.tracker.tracks == ()
    assert ids(film.show((100, 100, 0.9))) == [2]


def test_one_frame_is_enough_where_it_is_set_so() -> None:
    film = Film(min_hits=1)
    film.show((100, 100, 0.9))
    film.show()
    film.show((100, 100, 0.9))
    assert film.told == [("new", 1), ("update", 1)]


def test_a_life_is_told_in_events() -> None:
    film = Film(coast_timeout_s=0.3, max_age_s=1.0)
    for _ in range(4):
        film.show((100, 100, 0.8))
    film.show(after_s=0.1)
    assert film.told == [("new", 1), ("update", 1)]
    film.show(after_s=0.25)
    film.show(after_s=0.1)
    film.show((100, 100, 0.8), after_s=0.1)
    film.show(after_s=0.4)
    (end,) = film.show(after_s=0.7).events
    assert film.told[2:] == [("lost", 1), ("update", 1), ("lost", 1), ("end", 1)]
    assert end.kind is TrackEventKind.END
    assert end.track.state is TrackState.CONFIRMED
    assert end.track.seen == 5
    assert (end.track.last_ns - end.track.first_ns) / 1e9 == pytest.approx(0.7)
    assert end.stamp_ns == round(film.now_s * 1e9)
    assert end.track.class_name == "person"


def test_a_long_time_without_frames_ends_what_was_followed_though_it_seems_to_be_still_there() -> None:
    film = Film(max_age_s=2.0)
    for _ in range(4):
        film.show((100, 100, 0.8))
    assert ids(film.show((100, 100, 0.8), after_s=1.9)) == [1]
    assert ids(film.show((100, 100, 0.8), after_s=2.1)) == [2]
    assert film.told[-1] == ("end", 1)


def test_a_slow_detector_has_tracks_too() -> None:
    film = Film(coast_timeout_s=0.5, max_age_s=2.0)
    for _ in range(4):
        frame = film.show((100, 100, 0.8), after_s=1.2)
    assert ids(frame) == [1]
    assert film.told == [("new", 1), ("update", 1)]


def test_frames_too_far_apart_to_follow_anything_are_told_once(caplog: pytest.LogCaptureFixture) -> None:
    film = Film(max_age_s=2.0)
    for _ in range(4):
        film.show((100, 100, 0.8), after_s=3.0)
    (line,) = caplog.messages
    assert "tracks end between two frames: 3.0 s passed, and max_age_s is 2 s" in line


def test_an_event_bears_the_box_that_was_seen_and_a_lost_one_where_it_should_be() -> None:
    film = Film(coast_timeout_s=0.3)
    for step in range(10):
        frame = film.show((100 + 10 * step, 100, 0.8))
    (update,) = frame.events
    assert update.track.xyxy == pytest.approx((170, 80, 210, 120))
    (lost,) = film.show(after_s=0.4).events
    left, _, right, _ = lost.track.xyxy
    assert (left + right) / 2 == pytest.approx(190 + 10 * 8, abs=10)


def test_a_rumour_is_not_kept_as_long_as_a_track() -> None:
    film = Film(confirm_score=0.9, coast_timeout_s=0.3, max_age_s=5.0)
    for _ in range(5):
        film.show((100, 100, 0.5))
    film.show(after_s=0.4)
    assert film.tracker.tracks == ()
    assert film.told == []


def test_dropped_frames_are_a_matter_of_time_not_of_count() -> None:
    film = Film()
    rng = np.random.default_rng(4)
    x = 50.0
    for _ in range(40):
        after_s = float(rng.choice([0.03, 0.06, 0.2]))
        x += 90.0 * after_s
        frame = film.show((x, 200, 0.8), after_s=after_s)
    assert ids(frame) == [1]
    assert film.tracker.tracks[0].track_id == 1


def test_a_stamp_that_does_not_go_on_is_borne() -> None:
    film = Film()
    for after_s in (0.05, 0.05, 0.0, -0.02, 0.05):
        frame = film.show((100, 100, 0.8), after_s=after_s)
    assert ids(frame) == [1]


def view(yaw_deg: float, roll_deg: float = 0.0) -> CameraView:
    attitude = matrix_from_euler(math.radians(roll_deg), 0.0, math.radians(yaw_deg))
    return CameraView(CAMERA, attitude @ BODY_FROM_OPTICAL)


def thing_at(bearing_deg: float, seen_from: CameraView) -> tuple[float, float]:
    """Pixel of a far object on the horizon."""
    bearing = math.radians(bearing_deg)
    ned = np.array([[math.cos(bearing), math.sin(bearing), 0.0]])
    x, y = CAMERA.project(ned @ seen_from.ned_from_optical)[0]
    return float(x), float(y)


@pytest.mark.parametrize(("known", "kept"), [(True, True), (False, False)])
def test_a_jerk_of_the_camera_changes_nothing_where_the_attitude_is_known(known: bool, kept: bool) -> None:
    film = Film()
    for yaw_deg, roll_deg in ((0, 0), (0, 0), (0, 0), (15, 0), (-10, 5), (-10, -20), (12, 15)):
        seen_from = view(yaw_deg, roll_deg)
        seen = [(*thing_at(bearing, seen_from), 0.8) for bearing in (-9, 1, 8)]
        frame = film.show(*seen, view=seen_from if known else None)
    assert (ids(frame) == [1, 2, 3]) is kept


def test_what_the_camera_turns_away_from_is_known_again_when_it_turns_back() -> None:
    film = Film(max_age_s=3.0)
    for _ in range(4):
        film.show((*thing_at(0, view(0)), 0.8), view=view(0))
    for yaw_deg in (20, 40, 60, 60, 40, 20):
        film.show(view=view(yaw_deg))
    assert ids(film.show((*thing_at(0, view(0)), 0.8), view=view(0))) == [1]


def test_what_the_camera_turns_far_away_from_has_ended() -> None:
    film = Film()
    for _ in range(4):
        film.show((*thing_at(0, view(0)), 0.8), view=view(0))
    film.show(view=view(120))
    assert film.told[-1] == ("end", 1)


def test_a_frame_without_an_attitude_is_taken_as_it_is() -> None:
    film = Film()
    for seen_from in (view(0), view(0), view(0), None, view(3), view(3)):
        frame = film.show((*thing_at(0, view(0)), 0.8), view=seen_from)
    assert ids(frame) == [1]


def test_empty_frames_are_frames_too() -> None:
    film = Film()
    frame = film.show()
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
    frame = Film().give(found)
    assert frame.detections.depth_m.tolist() == [7.0]
    assert frame.detections.names == ["car"]


def test_numbers_begin_where_they_are_told_to() -> None:
    tracker = Tracker(first_track_id=40)
    assert ids(tracker.update(detections((100, 100, 0.8)), 1)) == [40]
    with pytest.raises(ValueError, match="first_track_id must be at least 1, got 0"):
        Tracker(first_track_id=0)


frames_of_film = st.lists(
    st.tuples(
        st.floats(0.0, 1.5),
        st.lists(st.tuples(st.floats(0, 640), st.floats(0, 480), st.floats(0, 1)), max_size=6),
        st.one_of(st.none(), st.floats(-90, 90)),
    ),
    max_size=12,
)


@settings(max_examples=60)
@given(frames_of_film)
def test_whatever_comes_the_promises_hold(
    frames: list[tuple[float, list[Seen], float | None]],
) -> None:
    film = Film(min_hits=2)
    live: set[int] = set()
    ended: set[int] = set()
    for after_s, seen, yaw_deg in frames:
        frame = film.show(*seen, after_s=after_s, view=None if yaw_deg is None else view(yaw_deg))
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
        assert live == {t.track_id for t in film.tracker.tracks if t.state is TrackState.CONFIRMED}
        assert all(np.isfinite(track.xyxy).all() for track in film.tracker.tracks)


# --- what else an object was called

CAR, PERSON = 1, 0


def called(*names: tuple[int, float], x: float = 100.0) -> Detections:
    """One object that a frame gives these classes, each with its confidence."""
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


def show(film: Film, frame: Detections, times: int) -> TrackedFrame:
    for _ in range(times):
        film.now_s += FRAME_S
        shown = film.give(frame)
    return shown


def test_an_object_whose_class_changed_is_not_confirmed() -> None:
    film = Film()
    assert confirmed(show(film, called((PERSON, 0.8)), 6), PERSON) == [True]
    assert confirmed(show(film, called((CAR, 0.8)), 6), CAR) == [False]
    assert film.told[-1] != ("new", 2)


def test_a_class_that_outweighs_the_former_one_is_confirmed() -> None:
    film = Film()
    show(film, called((PERSON, 0.5)), 3)
    assert confirmed(show(film, called((CAR, 0.8)), 10), CAR) == [True]


def test_a_rival_class_in_the_same_frames_prevents_confirmation() -> None:
    film = Film()
    frame = show(film, called((CAR, 0.8), (PERSON, 0.6)), 10)
    assert (confirmed(frame, CAR), confirmed(frame, PERSON)) == ([False], [False])


def test_a_rival_class_seen_seldom_or_weakly_changes_nothing() -> None:
    film = Film()
    for step in range(20):
        names = [(CAR, 0.8), (PERSON, 0.7)] if step % 4 == 0 else [(CAR, 0.8), (PERSON, 0.12)]
        frame = show(film, called(*names), 1)
    assert confirmed(frame, CAR) == [True]


def test_a_confirmed_track_is_in_doubt_while_its_class_changes() -> None:
    film = Film()
    show(film, called((CAR, 0.6)), 6)
    frame = show(film, called((CAR, 0.6), (PERSON, 0.9)), 6)
    assert confirmed(frame, CAR) == [False]
    assert confirmed(show(film, called((CAR, 0.8)), 8), CAR) == [True]
    assert film.told.count(("new", 1)) == 1, "events tell of it once"


def test_an_object_beside_another_does_not_put_its_class_in_doubt() -> None:
    film = Film()
    for _ in range(6):
        film.now_s += FRAME_S
        rider, bicycle = called((PERSON, 0.8)), called((CAR, 0.8), x=112.0)
        both = Detections(
            np.concatenate([rider.xyxy, bicycle.xyxy]),
            np.concatenate([rider.confidence, bicycle.confidence]),
            np.concatenate([rider.class_id, bicycle.class_id]),
            NAMES,
        )
        frame = film.give(both)
    assert (confirmed(frame, CAR), confirmed(frame, PERSON)) == ([True], [True])
