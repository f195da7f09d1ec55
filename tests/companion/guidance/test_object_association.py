"""Which detections of the next frames are an object that was seen."""

import math
import random
from collections.abc import Sequence
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.guidance.objects.table import ObjectTable
from companion.guidance.objects.target import RangeSource, Target
from tests.companion.guidance.one_object import PERIOD_NS, T0, VEHICLE, OneObject, seen_car

NO_RANGE, DEPTH = {"source": RangeSource.NONE}, {"source": RangeSource.DEPTH}


class Followed(OneObject):
    """The first object of the first frame."""

    def __init__(self, north: float, east: float, **changes: Any) -> None:
        super().__init__(seen_car((north, east), **changes))
        self.frame = 0

    def sees(self, *cars: tuple[float, float] | tuple[float, float, dict[str, Any]], frames: int = 1) -> bool:
        """The next frame. True: the object is one of these (north, east, changes)."""
        self.frame += frames
        return self.update([seen_car(car[:2], self.frame, **dict(*car[2:])) for car in cars])


def track(identifier: int | None, **more: Any) -> dict[str, Any]:
    return {"track_id": identifier, **more}


@pytest.mark.parametrize(("sigma_m", "least_m", "most_m"), [(0.2, 20.7, 21.0), (3.0, 20.0, 20.2)])
def test_range_sigma_weights_the_measurement(sigma_m: float, least_m: float, most_m: float) -> None:
    followed = Followed(20.0, 0.0)
    assert followed.sees((21.0, 0.0, {"range_sigma_m": sigma_m}))
    assert least_m < followed.position_ned_m[0] < most_m


def test_object_without_a_range_has_no_position() -> None:
    followed = Followed(5.0, 0.0, track_id=1, **NO_RANGE)
    assert followed.now.position_ned_m is None
    with pytest.raises(ValueError, match="no known range"):
        followed.now.position_at(T0)
    assert followed.sees((5.0, 0.0, track(1)))
    assert followed.position_ned_m == pytest.approx((5.0, 0.0, 0.0))


@given(st.floats(-30, 30), st.floats(-30, 30), st.floats(0, 6.28))
def test_repeated_measurements_converge(north: float, east: float, direction: float) -> None:
    vehicle = (-40.0, -40.0, -5.0)
    start = seen_car((north + math.cos(direction), east + math.sin(direction)), vehicle=vehicle)
    followed = OneObject(start, vehicle)
    for frame in range(1, 40):
        assert followed.update([seen_car((north, east), frame, vehicle=vehicle)], vehicle)
    assert math.dist(followed.position_ned_m[:2], (north, east)) < 0.3


def test_processed_frame_changes_nothing() -> None:
    followed = Followed(20.0, 0.0)
    assert not followed.sees((20.5, 0.0), frames=0)
    assert followed.sees((20.5, 0.0))
    position = followed.position_ned_m
    assert not followed.sees((20.5, 0.0), frames=0)
    assert followed.position_ned_m == position


@pytest.mark.parametrize("source", list(RangeSource))
def test_object_in_another_direction_is_rejected(source: RangeSource) -> None:
    followed = Followed(20.0, 0.0)
    assert not followed.sees((18.0, 9.0, {"source": source}))
    assert not followed.sees((20.0, 0.0, {"class_name": "truck"}))


def test_bearing_alone_corrects_only_across() -> None:
    followed = Followed(20.0, 0.0, track_id=1, **DEPTH)
    for _ in range(19):
        assert followed.sees((10.0, 0.4, track(1, **NO_RANGE)))
    north, east, _ = followed.position_ned_m
    assert math.atan2(east, north) == pytest.approx(math.atan2(0.4, 10.0), abs=0.01)
    assert math.hypot(north, east) == pytest.approx(20.0, abs=0.1)


@pytest.mark.parametrize(("frames", "same"), [(1, False), (30, True)])
def test_long_unseen_object_may_have_moved(frames: int, same: bool) -> None:
    assert Followed(10.0, 0.0, **DEPTH).sees((10.0, 3.5, DEPTH), frames=frames) is same


# --- the ids of the image tracker


def test_nearer_of_two_boxes_is_associated() -> None:
    followed = Followed(20.0, 0.0)
    assert followed.sees((20.0, 1.5), (20.2, 0.1))
    assert followed.position_ned_m[1] == pytest.approx(0.05, abs=0.1)


def test_own_track_id_wins_over_a_nearer_box() -> None:
    followed = Followed(20.0, 0.0, track_id=3)
    assert followed.sees((20.0, 0.0, track(8)), (20.5, 0.5, track(3)))
    assert followed.position_ned_m[1] > 0.1
    assert followed.track_id == 3


def test_object_seen_beside_it_is_never_associated() -> None:
    followed = Followed(20.0, 0.0, track_id=3)
    assert followed.sees((20.0, 0.0, track(3)), (20.0, 1.0, track(8)))
    assert not followed.sees((20.0, 0.2, track(8)))
    assert followed.sees((20.0, 0.2, track(3)))


@pytest.mark.parametrize("other", [9, None])
def test_object_with_a_new_track_id_is_kept(other: int | None) -> None:
    followed = Followed(20.0, 0.0, track_id=3)
    assert followed.sees((20.0, 0.2, track(other)))
    assert followed.track_id == (3 if other is None else other)


def test_track_id_at_an_impossible_position_is_another_object() -> None:
    followed = Followed(20.0, 0.0, track_id=3)
    assert followed.sees((12.0, 14.0, track(3)), (20.0, 0.1, track(8)))
    assert followed.position_ned_m[:2] == pytest.approx((20.0, 0.05), abs=0.1)
    assert [each.track_ids for each in followed.table.objects] == [(8,), (3,)]


def test_unconfirmed_box_does_not_replace_a_missed_object() -> None:
    followed, ghost = Followed(20.0, 0.0, track_id=3), (20.0, 0.1, track(9, trusted=False))
    assert followed.sees((20.0, 0.0, track(3)))
    assert not followed.sees(ghost)
    assert followed.sees((20.0, 0.0, track(3)), ghost)
    assert followed.track_id == 3


def test_second_box_on_the_object_is_the_same_object() -> None:
    followed = Followed(20.0, 0.0, track_id=3)
    assert followed.sees((20.0, 0.0, track(3)), (20.0, 0.05, track(8)))
    assert len(followed.table.objects) == 1
    # The first id ends and the second continues: it is the same object.
    assert followed.sees((20.0, 0.05, track(8)))


@pytest.mark.parametrize(("left", "same"), [(290.0, True), (340.0, False)])
def test_box_on_the_object_may_replace_it_and_one_beside_may_not(left: float, same: bool) -> None:
    first = track(1, box_xyxy=(300.0, 100.0, 340.0, 200.0))
    second = track(2, box_xyxy=(left, 100.0, left + 60.0, 200.0))
    followed = Followed(10.0, 0.0, **first)
    assert followed.sees((10.0, 0.0, first), (10.0, 0.4, second))
    assert followed.track_id == 1
    assert followed.sees((10.0, 0.4, second)) is same
    assert followed.track_id == (2 if same else 1)


def objects_seen(frames: Sequence[Sequence[Target]]) -> list[list[int]]:
    """The ids of the objects that each frame shows; one frame in 0.1 s."""
    table = ObjectTable()
    shown = []
    for frame, targets in enumerate(frames):
        objects = table.update(targets, VEHICLE, T0 + frame * PERIOD_NS)
        shown.append([each.object_id for each in objects if not each.occluded])
    return shown


@pytest.mark.parametrize("tracked", [True, False])
@pytest.mark.parametrize("late", [0, 5])
@pytest.mark.parametrize("unseen", [85, 300])
def test_two_alike_seen_again_after_a_turn_keep_their_ids(tracked: bool, late: int, unseen: int) -> None:
    noise = random.Random(3)

    def both(frame: int, new: int) -> list[Target]:
        places = [(15.0 + noise.gauss(0, 0.2), east + noise.gauss(0, 0.2)) for east in (3.0, 9.0)]
        return [
            seen_car(place, frame, track_id=new + number if tracked else None)
            for number, place in enumerate(places)
        ]

    frames = [both(frame, 1) for frame in range(20)] + [[]] * unseen
    again = range(len(frames), len(frames) + 20)
    frames += [both(frame, 11)[: 2 if frame >= again[0] + late else 1] for frame in again]
    assert objects_seen(frames)[-1] == [1, 2]


@pytest.mark.parametrize("source", [RangeSource.GROUND_PLANE, RangeSource.NONE])
@pytest.mark.parametrize("trusted", [True, False])
def test_without_a_tracker_a_standing_object_is_one(source: RangeSource, trusted: bool) -> None:
    noise = random.Random(3)
    frames = [
        [seen_car((15.0, noise.gauss(3.0, 0.2)), frame, source=source, trusted=trusted)]
        if not 20 <= frame < 30
        else []
        for frame in range(60)
    ]
    shown = objects_seen(frames)
    assert len({tuple(ids) for ids in shown[:20]}) == 1
    assert len({tuple(ids) for ids in shown[30:]}) == 1
