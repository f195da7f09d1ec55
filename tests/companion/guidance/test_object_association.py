import math
import random
from collections.abc import Sequence
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.guidance.objects.table import ObjectTable
from companion.guidance.objects.target import RangeSource, Target
from companion.vehicle.state import Vector3
from tests.companion.guidance.one_object import OneObject

T0 = 10**12
FRAME_NS = 100_000_000


def seen(
    position: Sequence[float],
    vehicle: Vector3 = (0.0, 0.0, -5.0),
    frame: int = 0,
    *,
    source: RangeSource = RangeSource.GROUND_PLANE,
    name: str = "car",
) -> Target:
    north, east = position[0] - vehicle[0], position[1] - vehicle[1]
    known = source is not RangeSource.NONE
    return Target(
        name,
        0.8,
        T0 + frame * FRAME_NS,
        math.atan2(east, north),
        -0.3,
        math.hypot(north, east) if known else math.nan,
        source,
        (position[0], position[1], 0.0) if known else None,
        range_sigma_m=0.5 if known else math.nan,
    )


def test_range_sigma_weights_the_measurement() -> None:
    vehicle = (0.0, 0.0, -5.0)
    positions = []
    for sigma_m in (0.2, 3.0):
        track = OneObject(seen((20.0, 0.0)), vehicle)
        assert track.update([replace(seen((21.0, 0.0), frame=1), range_sigma_m=sigma_m)], vehicle)
        positions.append(track.position_ned_m[0])
    assert positions[0] > 20.7
    assert positions[1] < 20.2


def test_object_without_a_range_has_no_position() -> None:
    vehicle = (0.0, 0.0, -5.0)
    track = OneObject(replace(seen((5.0, 0.0), source=RangeSource.NONE), track_id=1), vehicle)
    assert track.now.position_ned_m is None
    with pytest.raises(ValueError, match="no known range"):
        track.now.position_at(T0)
    assert track.update([replace(seen((5.0, 0.0), frame=1), track_id=1)], vehicle)
    assert track.position_ned_m == pytest.approx((5.0, 0.0, 0.0))


@given(st.floats(-30, 30), st.floats(-30, 30), st.floats(0, 6.28))
def test_repeated_measurements_converge(north: float, east: float, direction: float) -> None:
    truth = (north, east)
    start = (north + math.cos(direction), east + math.sin(direction))
    vehicle = (-40.0, -40.0, -5.0)
    track = OneObject(seen(start, vehicle), vehicle)
    for frame in range(1, 40):
        assert track.update([seen(truth, vehicle, frame)], vehicle)
    assert math.dist(track.position_ned_m[:2], truth) < 0.3


def test_processed_frame_changes_nothing() -> None:
    vehicle = (0.0, 0.0, -5.0)
    track = OneObject(seen((20.0, 0.0)), vehicle)
    assert not track.update([seen((20.5, 0.0), frame=0)], vehicle)
    assert track.update([seen((20.5, 0.0), frame=1)], vehicle)
    position = track.position_ned_m
    assert not track.update([seen((20.5, 0.0), frame=1)], vehicle)
    assert track.position_ned_m == position


@pytest.mark.parametrize("source", list(RangeSource))
def test_object_in_another_direction_is_rejected(source: RangeSource) -> None:
    vehicle = (0.0, 0.0, -5.0)
    track = OneObject(seen((20.0, 0.0)), vehicle)
    assert not track.update([seen((18.0, 9.0), frame=1, source=source)], vehicle)
    assert not track.update([seen((20.0, 0.0), frame=2, name="truck")], vehicle)


def test_nearer_of_two_candidates_is_associated() -> None:
    vehicle = (0.0, 0.0, -5.0)
    track = OneObject(seen((20.0, 0.0)), vehicle)
    assert track.update([seen((20.0, 1.5), frame=1), seen((20.2, 0.1), frame=1)], vehicle)
    assert track.position_ned_m[1] == pytest.approx(0.05, abs=0.1)


def test_bearing_alone_corrects_only_across() -> None:
    vehicle = (0.0, 0.0, -5.0)
    track = OneObject(replace(seen((20.0, 0.0), source=RangeSource.DEPTH), track_id=1), vehicle)
    for frame in range(1, 20):
        bearing = seen((10.0, 0.4), vehicle, frame, source=RangeSource.NONE)
        assert track.update([replace(bearing, track_id=1)], vehicle)
    north, east, _ = track.position_ned_m
    assert math.atan2(east, north) == pytest.approx(math.atan2(0.4, 10.0), abs=0.01)
    assert math.hypot(north, east) == pytest.approx(20.0, abs=0.1)


def test_long_unseen_object_may_have_moved() -> None:
    vehicle = (0.0, 0.0, -5.0)
    near = OneObject(seen((10.0, 0.0), source=RangeSource.DEPTH), vehicle)
    late = OneObject(seen((10.0, 0.0), source=RangeSource.DEPTH), vehicle)
    moved = (10.0, 3.5)
    assert not near.update([seen(moved, frame=1, source=RangeSource.DEPTH)], vehicle)
    assert late.update([seen(moved, frame=30, source=RangeSource.DEPTH)], vehicle)


@pytest.mark.parametrize(("left", "same"), [(290.0, True), (340.0, False)])
def test_box_on_the_object_may_replace_it_and_one_beside_may_not(left: float, same: bool) -> None:
    vehicle = (0.0, 0.0, -5.0)
    first = replace(seen((10.0, 0.0)), track_id=1, box_xyxy=(300.0, 100.0, 340.0, 200.0))
    second = replace(seen((10.0, 0.4)), track_id=2, box_xyxy=(left, 100.0, left + 60.0, 200.0))
    track = OneObject(first, vehicle)
    both = [replace(target, captured_ns=T0 + FRAME_NS) for target in (first, second)]
    assert track.update(both, vehicle)
    assert track.track_id == 1
    assert track.update([replace(second, captured_ns=T0 + 2 * FRAME_NS)], vehicle) is same
    assert track.track_id == (2 if same else 1)


def objects_seen(frames: Sequence[Sequence[Target]]) -> list[list[int]]:
    """The ids of the objects that each frame shows; one frame in 0.1 s."""
    table = ObjectTable()
    shown = []
    for frame, targets in enumerate(frames):
        objects = table.update(targets, (0.0, 0.0, -5.0), T0 + frame * FRAME_NS)
        shown.append([each.object_id for each in objects if not each.occluded])
    return shown


@pytest.mark.parametrize("tracked", [True, False])
@pytest.mark.parametrize("late", [0, 5])
@pytest.mark.parametrize("unseen", [85, 300])
def test_two_alike_seen_again_after_a_turn_keep_their_ids(tracked: bool, late: int, unseen: int) -> None:
    noise = random.Random(3)
    cars = [(15.0, 3.0), (15.0, 9.0)]

    def both(frame: int, new: int) -> list[Target]:
        places = [(north + noise.gauss(0, 0.2), east + noise.gauss(0, 0.2)) for north, east in cars]
        return [
            replace(seen(place, frame=frame), track_id=new + number if tracked else None)
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
        [replace(seen((15.0, noise.gauss(3.0, 0.2)), frame=frame, source=source), trusted=trusted)]
        if not 20 <= frame < 30
        else []
        for frame in range(60)
    ]
    shown = objects_seen(frames)
    assert len({tuple(ids) for ids in shown[:20]}) == 1
    assert len({tuple(ids) for ids in shown[30:]}) == 1
