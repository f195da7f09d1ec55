"""Flights of `approach`: where it comes to rest, what it keeps to, and how it ends where it cannot arrive."""

import math
import random
from dataclasses import replace
from typing import Any

import pytest

from companion.guidance.objects.target import DOUBTED, RangeSource
from tests.companion.guidance.guidance_harness import (
    STEP_S,
    Flight,
    assert_failed,
    assert_succeeded,
    flown,
)
from tests.companion.guidance.kinematic_vehicle import KinematicVehicle, SeenObject

ONCE = "approach car retries=0"


def car(north: float, east: float, track_id: int | None = None, **more: Any) -> SeenObject:
    return replace(SeenObject("car", north, east, track_id=track_id), **more)


# Command, what is seen, of which the first is approached, and how near to the distance it rests.
REACHED: dict[str, tuple[str, list[SeenObject], float]] = {
    "ahead": (ONCE, [car(20.0, 5.0)], 0.35),
    "near": (ONCE, [car(8.0, -3.0)], 0.35),
    "far": (ONCE, [car(45.0, 0.0)], 0.35),
    "at the distance": (ONCE, [car(6.0, 0.0)], 0.35),
    "too near": (ONCE, [car(3.0, 0.0)], 0.35),
    "a nearer one appears": (
        ONCE,
        [car(25.0, 0.0), car(14.0, 7.0, then=lambda seconds: {"visible": seconds > 2.0})],
        0.35,
    ),
    "it walks": (ONCE, [car(20.0, 0.0, then=lambda seconds: {"east": 0.8 * min(seconds, 10.0)})], 0.5),
    "it reappears": (ONCE, [car(25.0, 0.0, then=lambda s: {"visible": not 4.0 < s < 7.0})], 0.5),
    "beside an unconfirmed one": (
        ONCE,
        [car(15.0, 6.0, 2, track_score=0.6), car(15.0, 0.0, 1, track_score=0.6, trusted=False)],
        0.4,
    ),
    "another passes before it": (
        ONCE,
        [
            car(30.0, 0.0, 2, track_score=0.7, then=lambda s: {"visible": abs(2.0 * s - 8.0) >= 1.2}),
            car(28.0, -8.0, 5, track_score=0.9, then=lambda s: {"east": 2.0 * s - 8.0}),
        ],
        0.5,
    ),
    "a track of weak frames": (
        "approach car confidence=0.3 retries=0",
        [car(20.0, 0.0, 2, track_score=0.7, confidence=0.12)],
        0.4,
    ),
}


@pytest.mark.parametrize("case", REACHED)
def test_approach_rests_at_the_distance_without_overshoot(case: str) -> None:
    command, objects, within_m = REACHED[case]
    nearest = []
    flight = Flight(command, objects=[replace(each) for each in objects])
    outcome = flight.run(120.0, lambda seconds, vehicle: nearest.append(flight.distance_m()))
    assert assert_succeeded(outcome).reason.startswith("reached car")
    assert flight.distance_m() == pytest.approx(5.0, abs=within_m)
    assert min(nearest) > (4.6 if case != "too near" else 2.9)
    assert abs(flight.vehicle.position[2] + 5.0) < 0.1
    assert math.hypot(*flight.vehicle.velocity) < 0.3


def test_approach_arrives_with_noisy_ranges() -> None:
    random_ = random.Random(7)
    flight, outcome = flown(ONCE, car(25.0, -6.0), noise=lambda: random_.gauss(0.0, 0.06))
    assert_succeeded(outcome)
    assert flight.distance_m() == pytest.approx(5.0, abs=0.8)


@pytest.mark.parametrize("source", [RangeSource.DEPTH, RangeSource.GROUND_PLANE])
def test_wrong_first_range_does_not_lose_the_object(source: RangeSource) -> None:
    wrong = [0.8]
    flight, outcome = flown(ONCE, car(16.0, 1.0, source=source), noise=lambda: wrong.pop() if wrong else 0.0)
    assert_succeeded(outcome)
    assert flight.distance_m() == pytest.approx(5.0, abs=0.4)


def test_approach_finishes_on_bearings_when_range_is_lost() -> None:
    flight = Flight(ONCE, objects=[seen := car(20.0, 2.0)])

    def each(seconds: float, vehicle: KinematicVehicle) -> None:
        seen.with_range = flight.distance_m() > 7.0

    assert_succeeded(flight.run(60.0, each))
    assert flight.distance_m() == pytest.approx(5.0, abs=0.5)


@pytest.mark.parametrize("speed_mps", [0.5, 0.8])
def test_approach_retreats_from_an_approaching_object(speed_mps: float) -> None:
    flight = Flight(ONCE, objects=[car(20.0, 0.0, then=lambda s: {"north": 20.0 - speed_mps * s})])
    ranges: list[float] = []
    flight.run(25.0, lambda seconds, vehicle: ranges.append(flight.distance_m()))
    assert min(ranges) > 4.2
    assert min(ranges[-100:]) > 4.6


# What ends it, and words of the reason.
NOT_REACHED: dict[str, tuple[str, SeenObject, tuple[str, ...]]] = {
    "never a range": (ONCE, car(20.0, 12.0, with_range=False), ("range",)),
    "never confirmed": (
        ONCE,
        car(12.0, 0.0, 1, track_score=0.6, trusted=False),
        ("did not find ", "car ", DOUBTED),
    ),
    "one good frame": (
        "approach car confidence=0.3 retries=0",
        car(20.0, 0.0, 2, confidence=0.9, track_score=0.2),
        (),
    ),
    "never seen": ("approach car", car(-20.0, 0.0), ("never seen",)),
}


@pytest.mark.parametrize("case", NOT_REACHED)
def test_approach_does_not_fly_to_what_it_does_not_know(case: str) -> None:
    command, seen, words = NOT_REACHED[case]
    flight, outcome = flown(command, seen)
    assert_failed(outcome, *words)
    assert math.dist(flight.vehicle.position, (0, 0, -5)) < 0.1
    assert flight.notes == []  # nor is it searched again
    if not seen.with_range:
        assert flight.vehicle.yaw_rad == pytest.approx(math.atan2(12.0, 20.0), abs=0.05)


def test_silent_detector_ends_approach_without_a_search() -> None:
    flight = Flight("approach car", objects=[car(40.0, 0.0)])

    def each(seconds: float, vehicle: KinematicVehicle) -> None:
        flight.perception_alive = seconds < 4.0

    assert_failed(flight.run(90.0, each), "no detections received")
    assert math.hypot(*flight.vehicle.velocity) < 0.1
    assert flight.notes == []


# --- a lost object is searched


@pytest.mark.parametrize(("retries", "ending"), [(0, ""), (1, "again once"), (2, "again 2 times")])
def test_lost_object_is_searched_retries_times(retries: int, ending: str) -> None:
    lost = car(30.0, 0.0, then=lambda seconds: {"visible": seconds < 5.0})
    flight, outcome = flown(f"approach car retries={retries}", lost, seconds=300.0)
    assert assert_failed(outcome, "lost the ", "car ").reason.endswith(ending)
    assert len(flight.notes) == retries
    stood = flight.track[round(9.0 / STEP_S) :]
    assert max(math.dist(stood[0], position) for position in stood) < 0.5


def test_object_that_reappears_is_approached_again() -> None:
    turned_rad: list[float] = []
    reappearing = car(30.0, 0.0, then=lambda seconds: {"visible": not 5.0 < seconds < 12.5})
    flight, outcome = flown(
        "approach car", reappearing, each=lambda seconds, vehicle: turned_rad.append(abs(vehicle.yaw_rad))
    )
    assert_succeeded(outcome)
    begun, found = flight.notes
    assert "1 of 2" in begun
    assert "found a car: bearing 0" in found
    assert max(turned_rad) < 0.1  # it is found where it was, before a turn
    assert flight.distance_m() == pytest.approx(5.0, abs=0.4)


def test_object_that_moved_is_found_by_turning() -> None:
    def elsewhere(seconds: float) -> dict[str, Any]:
        moved = {"north": -8.0, "east": 14.0, "track_id": 2} if seconds > 6.0 else {}
        return {"visible": not 5.0 < seconds < 12.0, **moved}

    flight, outcome = flown("approach car", car(25.0, 0.0, 1, then=elsewhere))
    assert_succeeded(outcome)
    assert "found a car: bearing" in flight.notes[-1]
    assert flight.distance_m() == pytest.approx(5.0, abs=0.5)
