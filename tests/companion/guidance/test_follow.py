import math
from collections.abc import Callable

import pytest

from benchmarks.flights import UnknownFlightError, flight_named, flights, summary
from benchmarks.flights_follow import run
from companion.guidance.behaviours.follow import Follow, FollowBehaviour
from companion.guidance.command import NO_CONTEXT
from companion.guidance.grammar import parse
from companion.guidance.objects.tracked_object import Subject
from tests.companion.guidance.guidance_harness import Flight, assert_failed
from tests.companion.guidance.kinematic_vehicle import KinematicVehicle, SeenObject


def moving(
    scene_object: SeenObject, speed_mps: float, *, hidden: tuple[float, float] = (1e9, 1e9)
) -> Callable[[float, KinematicVehicle], None]:
    def each(seconds: float, _vehicle: KinematicVehicle) -> None:
        scene_object.north = 12.0 + speed_mps * seconds
        scene_object.visible = not hidden[0] <= seconds < hidden[1]

    return each


@pytest.mark.parametrize("bearing", ["here", "course"])
def test_follow_keeps_its_distance_through_an_occlusion(bearing: str) -> None:
    car = SeenObject("car", 12.0, 0.0, track_id=1, track_score=0.8)
    vehicle = KinematicVehicle()
    flight = Flight(FollowBehaviour(Follow(Subject("car"), distance_m=8.0, bearing=bearing)), vehicle, [car])
    assert flight.run(30.0, moving(car, 3.0, hidden=(18.0, 19.5))) is None
    assert math.dist(vehicle.position[:2], (car.north, car.east)) == pytest.approx(8.0, abs=0.8)


def test_follow_ends_when_target_lost() -> None:
    car = SeenObject("car", 12.0, 0.0, track_id=1, track_score=0.8)
    outcome = Flight(FollowBehaviour(Follow(Subject("car"), occlusion_s=2.0)), objects=[car]).run(
        30.0, moving(car, 3.0, hidden=(10, 99))
    )
    assert_failed(outcome, "lost the ", "car ")


def test_follow_does_not_switch_to_another_object() -> None:
    car = SeenObject("car", 12.0, 0.0, track_id=1, track_score=0.8)
    other = SeenObject("car", 20.0, 4.0, track_id=2, track_score=0.9)
    outcome = Flight(FollowBehaviour(Follow(Subject("car"))), objects=[car, other]).run(
        30.0, moving(car, 0.5, hidden=(6, 99))
    )
    assert_failed(outcome, "lost the ", "car ")


def test_command_builds_the_behaviour() -> None:
    command = parse("follow car distance=6 bearing=course angle=180")
    assert isinstance(command.build(NO_CONTEXT), FollowBehaviour)
    limited = parse("follow car duration=10")
    assert parse("follow car").endless
    assert not limited.endless


@pytest.mark.slow
def test_follow_a_person_for_a_minute_in_lockstep() -> None:
    result = run(4)
    assert result.success, result.reason


def test_campaign_flights_have_names() -> None:
    assert {"approach", "approach-depth", "follow", "obstacles"} <= set(flights())
    with pytest.raises(UnknownFlightError, match="there are: "):
        flight_named("nix")
    with pytest.raises(ValueError, match="no flights"):
        summary("follow", [])
