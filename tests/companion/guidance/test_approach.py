import math
import random

import pytest

from companion.guidance.behaviours.approach import Approach, ApproachBehaviour
from companion.guidance.objects.target import RangeSource
from companion.guidance.objects.tracked_object import Subject
from tests.companion.guidance.guidance_harness import Flight, assert_failed, assert_succeeded
from tests.companion.guidance.kinematic_vehicle import KinematicVehicle, SeenObject


def distance_to(vehicle: KinematicVehicle, scene_object: SeenObject) -> float:
    return math.dist(vehicle.position[:2], (scene_object.north, scene_object.east)) - scene_object.radius_m


@pytest.mark.parametrize(("north", "east"), [(20.0, 5.0), (8.0, -3.0), (45.0, 0.0), (6.0, 0.0)])
def test_approach_stops_at_the_distance_without_overshoot(north: float, east: float) -> None:
    car = SeenObject("car", north, east)
    vehicle = KinematicVehicle()
    nearest = []
    flight = Flight(ApproachBehaviour(Approach(Subject("car"), distance_m=5.0, retries=0.0)), vehicle, [car])
    outcome = assert_succeeded(flight.run(120.0, lambda seconds, v: nearest.append(distance_to(v, car))))
    assert outcome.reason.startswith("reached car")
    assert distance_to(vehicle, car) == pytest.approx(5.0, abs=0.35)
    assert min(nearest) > 4.6
    assert abs(vehicle.position[2] + 5.0) < 0.1
    assert math.hypot(*vehicle.velocity) < 0.3


def test_approach_arrives_with_noisy_ranges() -> None:
    noise = random.Random(7)
    car = SeenObject("car", 25.0, -6.0)
    vehicle = KinematicVehicle()
    flight = Flight(
        ApproachBehaviour(Approach(Subject("car"), retries=0.0)),
        vehicle,
        [car],
        noise=lambda: noise.gauss(0.0, 0.06),
    )
    assert_succeeded(flight.run(120.0))
    assert distance_to(vehicle, car) == pytest.approx(5.0, abs=0.8)


def test_approach_retreats_when_it_starts_too_near() -> None:
    person = SeenObject("person", 2.0, 0.0)
    vehicle = KinematicVehicle()
    assert_succeeded(
        Flight(
            ApproachBehaviour(Approach(Subject("person"), distance_m=4.0, retries=0.0)), vehicle, [person]
        ).run(60.0)
    )
    assert distance_to(vehicle, person) == pytest.approx(4.0, abs=0.35)


def test_approach_keeps_its_object_when_a_nearer_appears() -> None:
    first, second = SeenObject("car", 25.0, 0.0), SeenObject("car", 14.0, 7.0, visible=False)
    vehicle = KinematicVehicle()

    def each(seconds: float, vehicle: KinematicVehicle) -> None:
        second.visible = seconds > 2.0

    assert_succeeded(
        Flight(ApproachBehaviour(Approach(Subject("car"), retries=0.0)), vehicle, [first, second]).run(
            90.0, each
        )
    )
    assert distance_to(vehicle, first) == pytest.approx(5.0, abs=0.35)


def test_approach_follows_a_walking_object() -> None:
    person = SeenObject("person", 20.0, 0.0)

    def each(seconds: float, vehicle: KinematicVehicle) -> None:
        if seconds < 10.0:
            person.east = 0.8 * seconds

    vehicle = KinematicVehicle()
    assert_succeeded(
        Flight(ApproachBehaviour(Approach(Subject("person"), retries=0.0)), vehicle, [person]).run(90.0, each)
    )
    assert distance_to(vehicle, person) == pytest.approx(5.0, abs=0.5)


def test_approach_brakes_and_ends_when_target_lost() -> None:
    car = SeenObject("car", 40.0, 0.0)
    vehicle = KinematicVehicle()
    stopped_at = []

    def each(seconds: float, vehicle: KinematicVehicle) -> None:
        car.visible = seconds < 5.0
        if seconds > 9.0:
            stopped_at.append(vehicle.position[0])

    outcome = Flight(
        ApproachBehaviour(Approach(Subject("car"), lost_timeout_s=6.0, retries=0.0)), vehicle, [car]
    ).run(60.0, each)
    assert_failed(outcome, "lost the ", "car ")
    assert max(stopped_at) - min(stopped_at) < 0.2


def test_approach_continues_when_object_reappears() -> None:
    car = SeenObject("car", 25.0, 0.0)

    def each(seconds: float, vehicle: KinematicVehicle) -> None:
        car.visible = not 4.0 < seconds < 7.0

    vehicle = KinematicVehicle()
    assert_succeeded(
        Flight(ApproachBehaviour(Approach(Subject("car"), retries=0.0)), vehicle, [car]).run(90.0, each)
    )


def test_silent_detector_brakes_and_ends_approach() -> None:
    flight = Flight(
        ApproachBehaviour(Approach(Subject("car"), retries=0.0)), objects=[SeenObject("car", 40.0, 0.0)]
    )

    def each(seconds: float, vehicle: KinematicVehicle) -> None:
        flight.perception_alive = seconds < 4.0

    assert_failed(flight.run(60.0, each), "no detections")
    assert math.hypot(*flight.vehicle.velocity) < 0.1


def test_approach_without_range_only_yaws() -> None:
    car = SeenObject("car", 20.0, 12.0, with_range=False)
    vehicle = KinematicVehicle()
    assert_failed(
        Flight(ApproachBehaviour(Approach(Subject("car"), retries=0.0)), vehicle, [car]).run(60.0), "range"
    )
    assert math.dist(vehicle.position, (0, 0, -5)) < 0.1
    assert vehicle.yaw_rad == pytest.approx(math.atan2(12.0, 20.0), abs=0.05)


def test_approach_finishes_on_bearings_when_range_is_lost() -> None:
    car = SeenObject("car", 20.0, 2.0)

    def each(seconds: float, vehicle: KinematicVehicle) -> None:
        car.with_range = distance_to(vehicle, car) > 7.0

    vehicle = KinematicVehicle()
    assert_succeeded(
        Flight(ApproachBehaviour(Approach(Subject("car"), retries=0.0)), vehicle, [car]).run(60.0, each)
    )
    assert distance_to(vehicle, car) == pytest.approx(5.0, abs=0.5)


@pytest.mark.parametrize("source", [RangeSource.DEPTH, RangeSource.GROUND_PLANE])
def test_wrong_first_range_does_not_lose_the_object(source: RangeSource) -> None:
    car = SeenObject("car", 16.0, 1.0, source=source)
    wrong = [0.8]

    def noise() -> float:
        return wrong.pop() if wrong else 0.0

    vehicle = KinematicVehicle()
    flight = Flight(ApproachBehaviour(Approach(Subject("car"), retries=0.0)), vehicle, [car], noise=noise)
    assert_succeeded(flight.run(60.0))
    assert distance_to(vehicle, car) == pytest.approx(5.0, abs=0.4)
