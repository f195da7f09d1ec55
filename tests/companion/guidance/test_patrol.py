import math
from collections.abc import Sequence
from typing import Any

import pytest

from companion.guidance.behaviour import Outcome
from companion.guidance.behaviours.patrol import Patrol
from companion.guidance.command import NO_CONTEXT
from companion.guidance.grammar import parse
from tests.companion.guidance.guidance_harness import (
    STEP_S,
    Flight,
    assert_failed,
    assert_succeeded,
    flown,
)
from tests.companion.guidance.kinematic_vehicle import KinematicVehicle, SeenObject

ROUND = ((0.0, 0.0), (24.0, 0.0), (24.0, 24.0), (0.0, 24.0))
PATH, SMALL = "0,0;24,0;24,24;0,24", "0,0;12,0;12,12;0,12"


def patrol(command: str, *objects: SeenObject, seconds: float = 240.0) -> tuple[Outcome, Flight]:
    """A flight of `patrol` that succeeds, with copies of the objects."""
    flight, outcome = flown(f"patrol {command}", *objects, seconds=seconds)
    return assert_succeeded(outcome), flight


def nearest(flight: Flight, point: Sequence[float]) -> float:
    return min(math.dist(point, position[:2]) for position in flight.track)


def car(north: float, east: float, track_id: int | None = None, **more: Any) -> SeenObject:
    return SeenObject("car", north, east, track_id=track_id, **more)


def test_other_class_and_unconfirmed_target_do_not_stop_its_lap() -> None:
    outcome, flight = patrol(
        f"{PATH} classes=car laps=1", SeenObject("person", 10, 3), car(15.0, 4.0, trusted=False)
    )
    assert all(part in outcome.reason for part in ("1 lap", "4 points", "0 stops"))
    assert flight.notes == []
    assert max(nearest(flight, corner) for corner in ROUND) < 1.5


def test_patrol_stops_faces_reports_and_continues() -> None:
    flight = Flight(f"patrol {PATH} classes=person,car laps=1 dwell=4", objects=[car(18.0, 6.0, 7)])
    off_rad: list[float] = []

    def each(seconds: float, vehicle: KinematicVehicle) -> None:
        if "facing" in flight.behaviour.status and math.hypot(*vehicle.velocity) < 0.1:
            off_rad.append(flight.off_nose_rad())

    assert assert_succeeded(flight.run(240.0, each)).reason.endswith("1 stop")
    (note,) = flight.notes
    assert note.startswith("patrol: ")
    assert "(track 7)" in note
    assert "18.0 m north and 6.0 m east" in note
    assert len(off_rad) * STEP_S > 3.5
    assert off_rad[-1] < math.radians(4)
    # Every part of the path was flown.
    for corner, following in zip(ROUND, [*ROUND[1:], ROUND[0]], strict=True):
        for share in (0.0, 0.25, 0.5, 0.75):
            wanted = tuple(a + share * (b - a) for a, b in zip(corner, following, strict=True))
            assert nearest(flight, wanted) < 1.5, wanted


# The nearer one in that direction is not confident enough to be found.
NEARER = car(10.5, 5.7, 4, track_score=0.3)


@pytest.mark.parametrize("others", [[], [NEARER]], ids=["alone", "beside a nearer one"])
def test_patrol_approaches_what_it_faced_and_returns(others: list[SeenObject]) -> None:
    command = f"{PATH} classes=car laps=1 dwell=1 on_detection=approach distance=4"
    _, flight = patrol(command, car(16.0, 9.0, 3), *others)
    found, reached, *rest = flight.notes
    assert "found a car (track 3)" in found
    assert reached.startswith("patrol: reached ")
    assert "reached car" in reached
    assert rest == []
    assert nearest(flight, (16.0, 9.0)) == pytest.approx(4.0, abs=0.6)
    assert max(nearest(flight, corner) for corner in ROUND) < 1.5


def with_a_new_id(seconds: float) -> dict[str, Any]:
    """Unseen for longer than the table remembers; then it has a new id of the tracker, too."""
    return {"visible": not 12.0 < seconds < 90.0, "track_id": 1 if seconds < 90.0 else 2}


@pytest.mark.parametrize(
    ("seen", "laps", "revisit_s", "stops"),
    [
        (car(6.0, 3.0, 7), 2, 600, 1),
        (car(6.0, 3.0), 2, 600, 1),
        (car(6.0, 3.0, then=with_a_new_id), 6, 600, 1),
        (car(6.0, 3.0, 7), 2, 10, 2),
        (car(6.0, 3.0), 2, 10, 2),
    ],
)
def test_same_object_stops_it_again_after_revisit_only(
    seen: SeenObject, laps: int, revisit_s: int, stops: int
) -> None:
    command = f"{SMALL} classes=car laps={laps} dwell=1 revisit={revisit_s}"
    _, flight = patrol(command, seen, seconds=400.0)
    assert len([note for note in flight.notes if "found" in note]) == stops


def test_two_objects_stop_it_once_each_the_nearer_first() -> None:
    far, near = car(20.0, 11.0, 1, track_score=0.9), car(15.0, 4.0, 2, track_score=0.6)
    _, flight = patrol(f"{PATH} classes=car laps=1 dwell=1", far, near)
    assert [note.split("(")[1][:7] for note in flight.notes] == ["track 2", "track 1"]


def test_object_lost_before_facing_is_logged() -> None:
    flight = Flight(f"patrol {PATH} classes=car laps=1", objects=[seen := car(12.0, 8.0, 9)])

    def each(seconds: float, vehicle: KinematicVehicle) -> None:
        seen.visible = seen.visible and "facing" not in flight.behaviour.status

    assert_succeeded(flight.run(240.0, each))
    assert ["track 9" in note for note in flight.notes] == [True]


@pytest.mark.parametrize("silent_until_s", [8.0, math.inf])
def test_silent_detector_stops_then_ends_the_patrol(silent_until_s: float) -> None:
    flight = Flight(f"patrol {PATH} classes=car laps=1")

    def each(seconds: float, vehicle: KinematicVehicle) -> None:
        flight.perception_alive = not 3.0 < seconds < silent_until_s

    outcome = flight.run(200.0, each)
    if silent_until_s == math.inf:
        assert assert_failed(outcome).reason.endswith("for 10 s")
        assert math.hypot(*flight.vehicle.velocity) < 0.1
    else:
        assert_succeeded(outcome)


def test_patrol_grammar() -> None:
    command = parse(
        'patrol "0,0 20,0 20,20" classes=Person,CAR on_detection=approach distance=3', ("person", "car")
    )
    assert isinstance(command, Patrol)
    assert command.names == ("person", "car")
    assert parse(str(command)) == command
    assert command.build(NO_CONTEXT).class_names == ("person", "car")
    assert command.endless
