import math
from collections.abc import Callable

import pytest

from companion.guidance.behaviour import Outcome
from companion.guidance.command import NO_CONTEXT
from companion.guidance.grammar import parse
from tests.companion.guidance.guidance_harness import Flight, assert_failed
from tests.companion.guidance.kinematic_vehicle import KinematicVehicle, SeenObject
from vision.attitude import wrap_angle

Each = Callable[[float, Flight], None]


def active(
    text: str, car: SeenObject, each: Each, seconds: float = 300.0
) -> tuple[Outcome, list[str], Flight]:
    behaviour = parse(text).build(NO_CONTEXT)
    notes: list[str] = []
    vehicle = KinematicVehicle()
    flight = Flight(behaviour, vehicle, [car])

    def listen(at: float, vehicle: KinematicVehicle) -> None:
        notes.extend(behaviour.take_notes())
        each(at, flight)

    outcome = flight.run(seconds, listen)
    assert outcome is not None
    return outcome, [*notes, *behaviour.take_notes()], flight


def test_object_that_reappears_is_approached_again() -> None:
    car = SeenObject("car", 30.0, 0.0)
    turned_rad = [0.0]

    def each(seconds: float, flight: Flight) -> None:
        car.visible = not 5.0 < seconds < 12.5
        turned_rad.append(abs(wrap_angle(flight.vehicle.yaw_rad)))

    outcome, notes, flight = active("approach car", car, each)
    assert outcome.success, outcome.reason
    assert len(notes) == 2
    assert "1 of 2" in notes[0]
    assert "found a car: bearing 0" in notes[1]
    assert max(turned_rad) < 0.1  # it is found where it was, before a turn
    assert math.dist(flight.vehicle.position[:2], (30.0, 0.0)) == pytest.approx(5.0, abs=0.4)


def test_object_that_moved_is_found_by_turning() -> None:
    car = SeenObject("car", 25.0, 0.0, track_id=1)

    def each(seconds: float, flight: Flight) -> None:
        car.visible = not 5.0 < seconds < 12.0
        if seconds > 6.0:
            car.north, car.east, car.track_id = -8.0, 14.0, 2

    outcome, notes, flight = active("approach car", car, each)
    assert outcome.success, outcome.reason
    assert "found a car: bearing" in notes[-1]
    assert math.dist(flight.vehicle.position[:2], (-8.0, 14.0)) == pytest.approx(5.0, abs=0.5)


@pytest.mark.parametrize(("retries", "ending"), [(0, ""), (1, "again once"), (2, "again 2 times")])
def test_lost_object_is_searched_retries_times(retries: int, ending: str) -> None:
    car = SeenObject("car", 30.0, 0.0)
    positions = []

    def each(seconds: float, flight: Flight) -> None:
        car.visible = seconds < 5.0
        if seconds > 9.0:
            positions.append(tuple(flight.vehicle.position))

    outcome, notes, _ = active(f"approach car retries={retries}", car, each)
    assert_failed(outcome, "lost the ", "car ")
    assert outcome.reason.endswith(ending)
    assert len(notes) == retries
    assert max(math.dist(positions[0], position) for position in positions) < 0.5


def test_object_never_seen_is_not_searched() -> None:
    outcome, notes, _ = active("approach car", SeenObject("car", -20.0, 0.0), lambda seconds, flight: None)
    assert "never seen" in outcome.reason
    assert notes == []


def test_silent_detector_does_not_start_a_search() -> None:
    def each(seconds: float, flight: Flight) -> None:
        flight.perception_alive = seconds < 4.0

    outcome, notes, _ = active("approach car", SeenObject("car", 40.0, 0.0), each)
    assert "no detections received" in outcome.reason
    assert notes == []
