"""Where the picture's tracker knows which box is which, guidance goes by it."""

import math
from dataclasses import replace

import pytest

from companion.guidance.behaviours.approach import ApproachBehaviour
from companion.guidance.behaviours.seek import SeekBehaviour
from companion.guidance.targets.target import DOUBTED, RangeSource, Target
from companion.guidance.targets.track import ObjectTrack
from tests.companion.guidance.guidance_harness import Flight
from tests.companion.guidance.kinematic_vehicle import KinematicVehicle, SeenObject

T0 = 10**12
FRAME_NS = 100_000_000
VEHICLE = (0.0, 0.0, -5.0)


def seen(place: tuple[float, float], frame: int, track_id: int | None) -> Target:
    return Target(
        "car",
        0.8,
        T0 + frame * FRAME_NS,
        math.atan2(place[1], place[0]),
        -0.3,
        math.hypot(*place),
        RangeSource.GROUND_PLANE,
        (*place, 0.0),
        track_id=track_id,
    )


def test_the_box_with_its_identity_comes_before_one_that_is_nearer_to_where_it_was() -> None:
    track = ObjectTrack(seen((20.0, 0.0), 0, 3), VEHICLE)
    assert track.update([seen((20.0, 0.0), 1, 8), seen((20.5, 0.5), 1, 3)], VEHICLE)
    assert track.position_ned_m[1] > 0.1
    assert track.track_id == 3


def test_what_was_seen_beside_the_object_is_never_taken_for_it() -> None:
    track = ObjectTrack(seen((20.0, 0.0), 0, 3), VEHICLE)
    assert track.update([seen((20.0, 0.0), 1, 3), seen((20.0, 1.0), 1, 8)], VEHICLE)
    assert not track.update([seen((20.0, 0.2), 2, 8)], VEHICLE)
    assert track.update([seen((20.0, 0.2), 3, 3)], VEHICLE)


@pytest.mark.parametrize("other", [9, None])
def test_an_object_that_got_another_identity_is_still_the_object(other: int | None) -> None:
    track = ObjectTrack(seen((20.0, 0.0), 0, 3), VEHICLE)
    assert track.update([seen((20.0, 0.2), 1, other)], VEHICLE)
    assert track.track_id == (3 if other is None else other)


def test_an_identity_in_an_impossible_place_is_not_followed() -> None:
    track = ObjectTrack(seen((20.0, 0.0), 0, 3), VEHICLE)
    assert not track.update([seen((12.0, 14.0), 1, 3), seen((20.0, 0.1), 1, 8)], VEHICLE)
    assert track.position_ned_m[:2] == pytest.approx((20.0, 0.0))


def test_approach_does_not_begin_with_what_does_not_count_as_true() -> None:
    ghost = SeenObject("car", 12.0, 0.0, track_id=1, track_score=0.6, trusted=False)
    outcome = Flight(ApproachBehaviour("car"), objects=[ghost]).run(20.0)
    assert outcome is not None
    assert outcome.reason.startswith("lost the car"), outcome.reason
    assert outcome.reason.endswith(DOUBTED)


def test_approach_prefers_the_true_one_to_the_one_before_its_nose() -> None:
    ghost = SeenObject("car", 15.0, 0.0, track_id=1, track_score=0.6, trusted=False)
    car = SeenObject("car", 15.0, 6.0, track_id=2, track_score=0.6)
    vehicle = KinematicVehicle()
    outcome = Flight(ApproachBehaviour("car"), vehicle, [ghost, car]).run(60.0)
    assert outcome is not None
    assert outcome.success, outcome.reason
    assert math.dist(vehicle.position[:2], (car.north, car.east)) == pytest.approx(5.0, abs=0.4)


def test_approach_is_not_led_away_by_one_that_passes_before_its_object() -> None:
    car = SeenObject("car", 30.0, 0.0, track_id=2, track_score=0.7)
    other = SeenObject("car", 26.0, -8.0, track_id=5, track_score=0.9)
    vehicle = KinematicVehicle()

    def each(seconds: float, vehicle: KinematicVehicle) -> None:
        other.east = -8.0 + 2.0 * seconds
        other.north = 28.0
        car.visible = not abs(other.east) < 1.2  # hidden while the other passes

    outcome = Flight(ApproachBehaviour("car"), vehicle, [car, other]).run(90.0, each)
    assert outcome is not None
    assert outcome.success, outcome.reason
    assert math.dist(vehicle.position[:2], (car.north, car.east)) == pytest.approx(5.0, abs=0.5)


def test_a_followed_object_may_be_seen_weakly_for_a_while() -> None:
    car = SeenObject("car", 20.0, 0.0, confidence=0.12, track_id=2, track_score=0.7)
    outcome = Flight(ApproachBehaviour("car", confidence=0.3), objects=[car]).run(60.0)
    assert outcome is not None
    assert outcome.success, outcome.reason


def test_an_object_with_a_poor_history_is_not_flown_to_for_one_good_frame() -> None:
    car = SeenObject("car", 20.0, 0.0, confidence=0.9, track_id=2, track_score=0.2)
    outcome = Flight(ApproachBehaviour("car", confidence=0.3), objects=[car]).run(20.0)
    assert outcome is not None
    assert not outcome.success


def test_seek_does_not_end_with_what_does_not_count_as_true() -> None:
    ghost = SeenObject("car", 12.0, 4.0, track_id=1, track_score=0.6, trusted=False)
    outcome = Flight(SeekBehaviour("car", laps=1.0), objects=[ghost]).run(60.0)
    assert outcome is not None
    assert not outcome.success
    assert outcome.reason == f"no car seen in 1 lap: {DOUBTED}"


def test_seek_ends_when_what_it_sees_comes_to_count() -> None:
    car = SeenObject("car", 12.0, 4.0, track_id=1, track_score=0.6, trusted=False)

    def each(seconds: float, vehicle: KinematicVehicle) -> None:
        car.trusted = seconds > 1.5

    outcome = Flight(SeekBehaviour("car", laps=1.0), objects=[car]).run(60.0, each)
    assert outcome is not None
    assert outcome.success, outcome.reason


def test_seek_faces_the_one_it_found_and_not_its_neighbour() -> None:
    car = SeenObject("car", 14.0, 0.0, track_id=1)
    vehicle = KinematicVehicle()
    neighbour = replace(car, east=2.4, track_id=2, visible=False)

    def each(seconds: float, vehicle: KinematicVehicle) -> None:
        neighbour.visible = seconds > 0.6

    Flight(SeekBehaviour("car"), vehicle, [car, neighbour]).run(60.0, each)
    assert abs(vehicle.yaw_rad) < math.radians(4.5)


def test_a_doubtful_box_does_not_take_the_place_of_an_object_that_is_missing_for_a_frame() -> None:
    track = ObjectTrack(seen((20.0, 0.0), 0, 3), VEHICLE)
    assert track.update([seen((20.0, 0.0), 1, 3)], VEHICLE)
    ghost = replace(seen((20.0, 0.1), 2, 9), trusted=False)
    assert not track.update([ghost], VEHICLE)
    assert track.update([seen((20.0, 0.0), 3, 3), replace(ghost, captured_ns=T0 + 3 * FRAME_NS)], VEHICLE)
    assert track.track_id == 3


def test_a_second_box_on_the_object_is_not_held_to_be_another_object() -> None:
    track = ObjectTrack(seen((20.0, 0.0), 0, 3), VEHICLE)
    double = seen((20.0, 0.05), 1, 8)
    assert track.update([seen((20.0, 0.0), 1, 3), double], VEHICLE)
    assert not track.is_another(double)
    # The first identity ends and the second lives on: it is the same object.
    assert track.update([seen((20.0, 0.05), 2, 8)], VEHICLE)
