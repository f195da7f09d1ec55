import math
from collections.abc import Callable, Sequence

import pytest

from companion.guidance.behaviour import Outcome
from companion.guidance.behaviours.patrol import Patrol, PatrolBehaviour
from companion.guidance.command import NO_CONTEXT
from companion.guidance.grammar import parse
from companion.vehicle.state import FlightMode
from tests.companion.guidance.guidance_harness import Flight, GuidanceHarness
from tests.companion.guidance.kinematic_vehicle import KinematicVehicle, SeenObject

ROUND = ((0.0, 0.0), (24.0, 0.0), (24.0, 24.0), (0.0, 24.0))


def active(
    behaviour: PatrolBehaviour,
    objects: list[SeenObject],
    seconds: float = 240.0,
    each: Callable[[float, KinematicVehicle], None] = lambda seconds, vehicle: None,
    vehicle: KinematicVehicle | None = None,
) -> tuple[Outcome | None, list[str], Flight]:
    """(outcome, what was told, the flight)."""
    notes: list[str] = []

    def listen(at: float, vehicle: KinematicVehicle) -> None:
        notes.extend(behaviour.take_notes())
        each(at, vehicle)

    flight = Flight(behaviour, vehicle or KinematicVehicle(), objects)
    outcome = flight.run(seconds, listen)
    return outcome, [*notes, *behaviour.take_notes()], flight


def nearest(flight: Flight, place: Sequence[float]) -> float:
    return min(math.dist(place, position[:2]) for position in flight.track)


def test_a_round_without_anything_to_see_is_flown_whole() -> None:
    outcome, notes, flight = active(PatrolBehaviour(ROUND, ["car"], laps=1.0), [SeenObject("person", 10, 3)])
    assert outcome is not None
    assert outcome.success, outcome.reason
    assert outcome.reason == "1 lap of 4 points flown, 0 stops"
    assert notes == []
    assert max(nearest(flight, corner) for corner in ROUND) < 1.5


def test_it_stops_for_an_object_faces_it_says_where_it_is_and_goes_on_where_it_left_the_way() -> None:
    car = SeenObject("car", 18.0, 6.0, track_id=7)
    behaviour = PatrolBehaviour(ROUND, ["person", "car"], laps=1.0, dwell_s=4.0)
    standing: list[tuple[tuple[float, ...], float]] = []

    def each(seconds: float, vehicle: KinematicVehicle) -> None:
        if "looking at" in behaviour.status and math.hypot(*vehicle.velocity) < 0.1:
            standing.append((tuple(vehicle.position), vehicle.yaw_rad))

    outcome, notes, flight = active(behaviour, [car], each=each)
    assert outcome is not None
    assert outcome.success, outcome.reason
    assert outcome.reason.endswith("1 stop")
    assert len(notes) == 1
    assert notes[0].startswith("patrol: found a car (track 7), ")
    assert notes[0].endswith("18.0 m north and 6.0 m east of home")
    assert len(standing) * 0.02 > 3.5
    place, yaw = standing[-1]
    assert yaw == pytest.approx(math.atan2(6.0 - place[1], 18.0 - place[0]), abs=math.radians(4))
    # Not a metre of the way is left out: every part of it was flown along.
    for corner, following in zip(ROUND, [*ROUND[1:], ROUND[0]], strict=True):
        for share in (0.0, 0.25, 0.5, 0.75):
            wanted = tuple(a + share * (b - a) for a, b in zip(corner, following, strict=True))
            assert nearest(flight, wanted) < 1.5, wanted


def test_with_approach_it_flies_up_to_the_object_and_back_to_its_way() -> None:
    car = SeenObject("car", 16.0, 9.0, track_id=3)
    behaviour = PatrolBehaviour(ROUND, ["car"], laps=1.0, approach_m=4.0, dwell_s=1.0)
    outcome, notes, flight = active(behaviour, [car])
    assert outcome is not None
    assert outcome.success, outcome.reason
    assert notes[1].startswith("patrol: reached car at")
    assert len(notes) == 2
    assert nearest(flight, (16.0, 9.0)) == pytest.approx(4.0, abs=0.6)
    assert max(nearest(flight, corner) for corner in ROUND) < 1.5


@pytest.mark.parametrize("with_identity", [True, False])
def test_the_same_object_does_not_stop_it_twice_until_its_time_is_over(with_identity: bool) -> None:
    car = SeenObject("car", 12.0, 5.0, track_id=7 if with_identity else None)
    outcome, notes, _ = active(
        PatrolBehaviour(ROUND, ["car"], laps=2.0, dwell_s=1.0, revisit_s=600.0), [car], 400
    )
    assert outcome is not None
    assert outcome.success, outcome.reason
    assert len(notes) == 1
    behaviour = PatrolBehaviour(ROUND, ["car"], laps=2.0, dwell_s=1.0, revisit_s=20.0)
    outcome, notes, _ = active(behaviour, [car], 400)
    assert outcome is not None
    assert outcome.success, outcome.reason
    assert len(notes) >= 2


def test_two_objects_of_a_class_stop_it_once_each() -> None:
    cars = [SeenObject("car", 15.0, 4.0, track_id=1), SeenObject("car", 20.0, 16.0, track_id=2)]
    behaviour = PatrolBehaviour(ROUND, ["car"], laps=1.0, dwell_s=1.0)
    outcome, notes, _ = active(behaviour, cars)
    assert outcome is not None
    assert outcome.success, outcome.reason
    assert sorted(note.split("(")[1][:7] for note in notes) == ["track 1", "track 2"]


def test_what_does_not_count_as_true_does_not_stop_it() -> None:
    outcome, notes, _ = active(
        PatrolBehaviour(ROUND, ["car"], laps=1.0), [SeenObject("car", 15.0, 4.0, trusted=False)]
    )
    assert outcome is not None
    assert outcome.reason.endswith("0 stops")
    assert notes == []


def test_what_vanishes_before_it_is_faced_is_told_and_the_round_goes_on() -> None:
    car = SeenObject("car", 12.0, 8.0, track_id=9)
    behaviour = PatrolBehaviour(ROUND, ["car"], laps=1.0)

    def each(seconds: float, vehicle: KinematicVehicle) -> None:
        if "looking at" in behaviour.status:
            car.visible = False

    outcome, notes, _ = active(behaviour, [car], each=each)
    assert outcome is not None
    assert outcome.success, outcome.reason
    assert notes == ["patrol: lost sight of a car (track 9) before it was faced"]


def test_a_silent_detector_stops_it_and_then_ends_it_and_a_short_silence_does_not() -> None:
    behaviour = PatrolBehaviour(ROUND, ["car"], laps=1.0)
    flight = Flight(behaviour, KinematicVehicle())

    def short(seconds: float, vehicle: KinematicVehicle) -> None:
        flight.perception_alive = not 3.0 < seconds < 8.0

    outcome = flight.run(200.0, short)
    assert outcome is not None
    assert outcome.success, outcome.reason

    flight = Flight(PatrolBehaviour(ROUND, ["car"], laps=1.0), KinematicVehicle())

    def silent(seconds: float, vehicle: KinematicVehicle) -> None:
        flight.perception_alive = seconds < 3.0

    outcome = flight.run(200.0, silent)
    assert outcome is not None
    assert outcome.reason == "nothing came from the detector for 10 s"
    assert math.hypot(*flight.vehicle.velocity) < 0.1


def test_the_grammar_of_a_patrol() -> None:
    command = parse(
        'patrol "0,0 20,0 20,20" classes=Person,CAR on_detection=approach distance=3', ("person", "car")
    )
    assert isinstance(command, Patrol)
    assert command.names == ("person", "car")
    assert parse(str(command)) == command
    assert command.build(NO_CONTEXT).class_names == ("person", "car")
    assert command.endless
    for text, said in [
        ("patrol 0,0 classes=car", "two points"),
        ("patrol 0,0 9,9", "classes is missing"),
        ("patrol 0,0 9,9 classes=car,", "names of classes"),
        ("patrol 0,0 9,9 classes=car,zebra", "unknown class 'zebra'"),
        ("patrol 0,0 9,9 classes=car on_detection=photo", "hold or approach"),
    ]:
        with pytest.raises(ValueError, match=said):
            parse(text, ("person", "car") if "zebra" in text else None)


def test_a_pilots_mode_ends_a_patrol_and_an_operators_command_takes_its_place() -> None:
    harness = GuidanceHarness(KinematicVehicle(mode=FlightMode.HOLD))
    harness.run(0.1)
    future = harness.command(PatrolBehaviour(ROUND, ["car"]))
    harness.until(lambda: harness.vehicle.position[0] > 3.0)
    harness.autopilot.change_mode(FlightMode.POSITION)
    harness.until(future.done, 2.0)
    assert future.result().reason == "the pilot took over: position mode"
    sent = len(harness.autopilot.setpoints)
    harness.run(3.0)
    assert len(harness.autopilot.setpoints) == sent
