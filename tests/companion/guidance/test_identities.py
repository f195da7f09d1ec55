"""Use of the image tracker's ids in guidance."""

import math
from dataclasses import replace

import pytest

from companion.guidance.behaviours.approach import Approach, ApproachBehaviour
from companion.guidance.behaviours.seek import Seek, SeekBehaviour
from companion.guidance.objects.target import DOUBTED, RangeSource, Target
from companion.guidance.objects.tracked_object import Subject
from tests.companion.guidance.guidance_harness import Flight, assert_failed, assert_succeeded
from tests.companion.guidance.kinematic_vehicle import KinematicVehicle, SeenObject
from tests.companion.guidance.one_object import OneObject

T0 = 10**12
FRAME_NS = 100_000_000
VEHICLE = (0.0, 0.0, -5.0)


def seen(position: tuple[float, float], frame: int, track_id: int | None) -> Target:
    return Target(
        "car",
        0.8,
        T0 + frame * FRAME_NS,
        math.atan2(position[1], position[0]),
        -0.3,
        math.hypot(*position),
        RangeSource.GROUND_PLANE,
        (*position, 0.0),
        track_id=track_id,
    )


def test_own_track_id_wins_over_a_nearer_box() -> None:
    track = OneObject(seen((20.0, 0.0), 0, 3), VEHICLE)
    assert track.update([seen((20.0, 0.0), 1, 8), seen((20.5, 0.5), 1, 3)], VEHICLE)
    assert track.position_ned_m[1] > 0.1
    assert track.track_id == 3


def test_object_seen_beside_it_is_never_associated() -> None:
    track = OneObject(seen((20.0, 0.0), 0, 3), VEHICLE)
    assert track.update([seen((20.0, 0.0), 1, 3), seen((20.0, 1.0), 1, 8)], VEHICLE)
    assert not track.update([seen((20.0, 0.2), 2, 8)], VEHICLE)
    assert track.update([seen((20.0, 0.2), 3, 3)], VEHICLE)


@pytest.mark.parametrize("other", [9, None])
def test_object_with_a_new_track_id_is_kept(other: int | None) -> None:
    track = OneObject(seen((20.0, 0.0), 0, 3), VEHICLE)
    assert track.update([seen((20.0, 0.2), 1, other)], VEHICLE)
    assert track.track_id == (3 if other is None else other)


def test_track_id_at_an_impossible_position_is_another_object() -> None:
    track = OneObject(seen((20.0, 0.0), 0, 3), VEHICLE)
    assert track.update([seen((12.0, 14.0), 1, 3), seen((20.0, 0.1), 1, 8)], VEHICLE)
    assert track.position_ned_m[:2] == pytest.approx((20.0, 0.05), abs=0.1)
    assert [each.track_ids for each in track.table.objects] == [(8,), (3,)]


def test_approach_ignores_unconfirmed_targets() -> None:
    ghost = SeenObject("car", 12.0, 0.0, track_id=1, track_score=0.6, trusted=False)
    outcome = Flight(ApproachBehaviour(Approach(Subject("car"), retries=0.0)), objects=[ghost]).run(20.0)
    assert outcome is not None
    assert_failed(outcome, "did not find ", "car ")
    assert outcome.reason.endswith(DOUBTED)


def test_approach_prefers_a_confirmed_target() -> None:
    ghost = SeenObject("car", 15.0, 0.0, track_id=1, track_score=0.6, trusted=False)
    car = SeenObject("car", 15.0, 6.0, track_id=2, track_score=0.6)
    vehicle = KinematicVehicle()
    assert_succeeded(
        Flight(ApproachBehaviour(Approach(Subject("car"), retries=0.0)), vehicle, [ghost, car]).run(60.0)
    )
    assert math.dist(vehicle.position[:2], (car.north, car.east)) == pytest.approx(5.0, abs=0.4)


def test_approach_is_not_diverted_by_a_passing_object() -> None:
    car = SeenObject("car", 30.0, 0.0, track_id=2, track_score=0.7)
    other = SeenObject("car", 26.0, -8.0, track_id=5, track_score=0.9)
    vehicle = KinematicVehicle()

    def each(seconds: float, vehicle: KinematicVehicle) -> None:
        other.east = -8.0 + 2.0 * seconds
        other.north = 28.0
        car.visible = not abs(other.east) < 1.2  # hidden while the other passes

    assert_succeeded(
        Flight(ApproachBehaviour(Approach(Subject("car"), retries=0.0)), vehicle, [car, other]).run(
            90.0, each
        )
    )
    assert math.dist(vehicle.position[:2], (car.north, car.east)) == pytest.approx(5.0, abs=0.5)


def test_tracked_object_may_have_low_confidence() -> None:
    car = SeenObject("car", 20.0, 0.0, confidence=0.12, track_id=2, track_score=0.7)
    assert_succeeded(
        Flight(ApproachBehaviour(Approach(Subject("car"), confidence=0.3, retries=0.0)), objects=[car]).run(
            60.0
        )
    )


def test_one_good_frame_does_not_start_an_approach() -> None:
    car = SeenObject("car", 20.0, 0.0, confidence=0.9, track_id=2, track_score=0.2)
    assert_failed(
        Flight(ApproachBehaviour(Approach(Subject("car"), confidence=0.3, retries=0.0)), objects=[car]).run(
            20.0
        )
    )


def test_seek_ignores_unconfirmed_targets() -> None:
    ghost = SeenObject("car", 12.0, 4.0, track_id=1, track_score=0.6, trusted=False)
    outcome = assert_failed(Flight(SeekBehaviour(Seek("car", laps=1.0)), objects=[ghost]).run(60.0))
    assert outcome.reason.endswith(DOUBTED)


def test_seek_ends_once_the_target_is_confirmed() -> None:
    car = SeenObject("car", 12.0, 4.0, track_id=1, track_score=0.6, trusted=False)

    def each(seconds: float, vehicle: KinematicVehicle) -> None:
        car.trusted = seconds > 1.5

    assert_succeeded(Flight(SeekBehaviour(Seek("car", laps=1.0)), objects=[car]).run(60.0, each))


def test_seek_faces_its_find_and_not_the_neighbour() -> None:
    car = SeenObject("car", 14.0, 0.0, track_id=1)
    vehicle = KinematicVehicle()
    neighbour = replace(car, east=2.4, track_id=2, visible=False)

    def each(seconds: float, vehicle: KinematicVehicle) -> None:
        neighbour.visible = seconds > 0.6

    Flight(SeekBehaviour(Seek("car")), vehicle, [car, neighbour]).run(60.0, each)
    assert abs(vehicle.yaw_rad) < math.radians(4.5)


def test_unconfirmed_box_does_not_replace_a_missed_object() -> None:
    track = OneObject(seen((20.0, 0.0), 0, 3), VEHICLE)
    assert track.update([seen((20.0, 0.0), 1, 3)], VEHICLE)
    ghost = replace(seen((20.0, 0.1), 2, 9), trusted=False)
    assert not track.update([ghost], VEHICLE)
    assert track.update([seen((20.0, 0.0), 3, 3), replace(ghost, captured_ns=T0 + 3 * FRAME_NS)], VEHICLE)
    assert track.track_id == 3


def test_second_box_on_the_object_is_the_same_object() -> None:
    track = OneObject(seen((20.0, 0.0), 0, 3), VEHICLE)
    double = seen((20.0, 0.05), 1, 8)
    assert track.update([seen((20.0, 0.0), 1, 3), double], VEHICLE)
    assert len(track.table.objects) == 1
    # The first id ends and the second continues: it is the same object.
    assert track.update([seen((20.0, 0.05), 2, 8)], VEHICLE)
