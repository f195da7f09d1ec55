import math
from collections.abc import Callable, Sequence

import pytest

from companion.guidance.behaviours.patrol import Patrol, PatrolBehaviour
from companion.guidance.command import NO_CONTEXT
from companion.guidance.grammar import parse
from tests.companion.guidance.guidance_harness import (
    STEP_S,
    Flight,
    assert_failed,
    assert_succeeded,
)
from tests.companion.guidance.kinematic_vehicle import KinematicVehicle, SeenObject

ROUND = ((0.0, 0.0), (24.0, 0.0), (24.0, 24.0), (0.0, 24.0))
PATH, SMALL = "0,0 24,0 24,24 0,24", "0,0 12,0 12,12 0,12"


def active(
    behaviour: PatrolBehaviour,
    objects: list[SeenObject],
    seconds: float = 240.0,
    each: Callable[[float, KinematicVehicle], None] = lambda seconds, vehicle: None,
    vehicle: KinematicVehicle | None = None,
) -> tuple[str, list[str], Flight]:
    """(reason of the success, notes, flight)."""
    notes: list[str] = []

    def listen(at: float, vehicle: KinematicVehicle) -> None:
        notes.extend(behaviour.take_notes())
        each(at, vehicle)

    flight = Flight(behaviour, vehicle or KinematicVehicle(), objects)
    outcome = assert_succeeded(flight.run(seconds, listen))
    return outcome.reason, [*notes, *behaviour.take_notes()], flight


def nearest(flight: Flight, point: Sequence[float]) -> float:
    return min(math.dist(point, position[:2]) for position in flight.track)


def test_other_class_and_unconfirmed_target_do_not_stop_its_lap() -> None:
    objects = [SeenObject("person", 10, 3), SeenObject("car", 15.0, 4.0, trusted=False)]
    reason, notes, flight = active(PatrolBehaviour(Patrol(PATH, "car", laps=1.0)), objects)
    assert reason.endswith("1 lap of 4 points flown, 0 stops")
    assert notes == []
    assert max(nearest(flight, corner) for corner in ROUND) < 1.5


def test_patrol_stops_faces_reports_and_continues() -> None:
    car = SeenObject("car", 18.0, 6.0, track_id=7)
    behaviour = PatrolBehaviour(Patrol(PATH, "person,car", laps=1.0, dwell_s=4.0))
    standing: list[tuple[tuple[float, ...], float]] = []

    def each(seconds: float, vehicle: KinematicVehicle) -> None:
        if "facing" in behaviour.status and math.hypot(*vehicle.velocity) < 0.1:
            standing.append((tuple(vehicle.position), vehicle.yaw_rad))

    reason, notes, flight = active(behaviour, [car], each=each)
    assert reason.endswith("1 stop")
    assert len(notes) == 1
    assert notes[0].startswith("patrol: found a car (track 7)")
    assert "18.0 m north and 6.0 m east" in notes[0]
    assert len(standing) * STEP_S > 3.5
    point, yaw = standing[-1]
    assert yaw == pytest.approx(math.atan2(6.0 - point[1], 18.0 - point[0]), abs=math.radians(4))
    # Every part of the path was flown.
    for corner, following in zip(ROUND, [*ROUND[1:], ROUND[0]], strict=True):
        for share in (0.0, 0.25, 0.5, 0.75):
            wanted = tuple(a + share * (b - a) for a, b in zip(corner, following, strict=True))
            assert nearest(flight, wanted) < 1.5, wanted


def test_patrol_with_approach_returns_to_its_path() -> None:
    car = SeenObject("car", 16.0, 9.0, track_id=3)
    behaviour = PatrolBehaviour(
        Patrol(PATH, "car", laps=1.0, dwell_s=1.0, on_detection="approach", distance_m=4.0)
    )
    _, notes, flight = active(behaviour, [car])
    assert notes[1].startswith("patrol: reached ")
    assert "reached car" in notes[1]
    assert len(notes) == 2
    assert nearest(flight, (16.0, 9.0)) == pytest.approx(4.0, abs=0.6)
    assert max(nearest(flight, corner) for corner in ROUND) < 1.5


def test_patrol_approaches_the_object_that_it_faced() -> None:
    """And not the nearer one in that direction, which is not confident enough to be found."""
    car = SeenObject("car", 16.0, 9.0, track_id=3)
    nearer = SeenObject("car", 10.5, 5.7, track_id=4, track_score=0.3)
    behaviour = PatrolBehaviour(
        Patrol(PATH, "car", laps=1.0, dwell_s=1.0, on_detection="approach", distance_m=4.0)
    )
    _, notes, flight = active(behaviour, [car, nearer])
    assert "found a car (track 3)" in notes[0]
    assert notes[1].startswith("patrol: reached ")
    assert nearest(flight, (16.0, 9.0)) == pytest.approx(4.0, abs=0.6)


def test_object_with_a_new_id_is_known_by_its_place() -> None:
    car = SeenObject("car", 6.0, 3.0, track_id=1)

    def each(seconds: float, vehicle: KinematicVehicle) -> None:
        # Unseen for longer than the table remembers; then it has a new id of the tracker, too.
        car.visible = not 12.0 < seconds < 90.0
        car.track_id = 1 if seconds < 90.0 else 2

    behaviour = PatrolBehaviour(Patrol(SMALL, "car", laps=6.0, dwell_s=1.0, revisit_s=600.0))
    _, notes, _ = active(behaviour, [car], 400, each=each)
    assert len(notes) == 1


@pytest.mark.parametrize("with_identity", [True, False])
def test_same_object_stops_it_again_after_revisit_only(with_identity: bool) -> None:
    car = SeenObject("car", 6.0, 3.0, track_id=7 if with_identity else None)
    _, notes, _ = active(
        PatrolBehaviour(Patrol(SMALL, "car", laps=2.0, dwell_s=1.0, revisit_s=600.0)), [car], 400
    )
    assert len(notes) == 1
    behaviour = PatrolBehaviour(Patrol(SMALL, "car", laps=2.0, dwell_s=1.0, revisit_s=10.0))
    _, notes, _ = active(behaviour, [car], 400)
    assert len(notes) >= 2


def test_two_objects_stop_it_once_each_the_nearer_first() -> None:
    far = SeenObject("car", 20.0, 11.0, track_id=1, track_score=0.9)
    near = SeenObject("car", 15.0, 4.0, track_id=2, track_score=0.6)
    behaviour = PatrolBehaviour(Patrol(PATH, "car", laps=1.0, dwell_s=1.0))
    _, notes, _ = active(behaviour, [far, near])
    assert [note.split("(")[1][:7] for note in notes] == ["track 2", "track 1"]


def test_object_lost_before_facing_is_logged() -> None:
    car = SeenObject("car", 12.0, 8.0, track_id=9)
    behaviour = PatrolBehaviour(Patrol(PATH, "car", laps=1.0))

    def each(seconds: float, vehicle: KinematicVehicle) -> None:
        if "facing" in behaviour.status:
            car.visible = False

    _, notes, _ = active(behaviour, [car], each=each)
    assert ["track 9" in note for note in notes] == [True]


def test_silent_detector_stops_then_ends_the_patrol() -> None:
    behaviour = PatrolBehaviour(Patrol(PATH, "car", laps=1.0))
    flight = Flight(behaviour, KinematicVehicle())

    def short(seconds: float, vehicle: KinematicVehicle) -> None:
        flight.perception_alive = not 3.0 < seconds < 8.0

    assert_succeeded(flight.run(200.0, short))

    flight = Flight(PatrolBehaviour(Patrol(PATH, "car", laps=1.0)), KinematicVehicle())

    def silent(seconds: float, vehicle: KinematicVehicle) -> None:
        flight.perception_alive = seconds < 3.0

    outcome = assert_failed(flight.run(200.0, silent))
    assert outcome.reason.endswith("for 10 s")
    assert math.hypot(*flight.vehicle.velocity) < 0.1


def test_patrol_grammar() -> None:
    command = parse(
        'patrol "0,0 20,0 20,20" classes=Person,CAR on_detection=approach distance=3', ("person", "car")
    )
    assert isinstance(command, Patrol)
    assert command.names == ("person", "car")
    assert parse(str(command)) == command
    assert command.build(NO_CONTEXT).class_names == ("person", "car")
    assert command.endless
