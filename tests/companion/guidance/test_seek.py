import math
from collections.abc import Callable
from typing import Any

import pytest

from companion.guidance.behaviour import Behaviour, Outcome
from companion.guidance.behaviours.seek import Seek, SeekBehaviour
from companion.guidance.command import NO_CONTEXT, BuildContext
from companion.guidance.grammar import parse
from tests.companion.guidance.guidance_harness import Flight, assert_failed, assert_succeeded
from tests.companion.guidance.kinematic_vehicle import KinematicVehicle, SeenObject
from vision.attitude import wrap_angle


def found(
    flight: Flight, each: Callable[[float, KinematicVehicle], None] = lambda seconds, vehicle: None
) -> Outcome:
    return assert_succeeded(flight.run(90.0, each))


@pytest.mark.parametrize("degrees", [0, 30, 90, 179, 200, 300, 355])
def test_seek_finds_and_faces_an_object(degrees: float) -> None:
    angle = math.radians(degrees)
    car = SeenObject("car", 12.0 * math.cos(angle), 12.0 * math.sin(angle))
    vehicle = KinematicVehicle()
    outcome = found(Flight(SeekBehaviour(Seek("car")), vehicle, [car]))
    assert abs(wrap_angle(angle - vehicle.yaw_rad)) < math.radians(5)
    assert "12.0 m" in outcome.reason
    assert math.dist(vehicle.position, (0, 0, -5)) < 0.2


def test_seek_gives_up_after_its_laps() -> None:
    vehicle = KinematicVehicle()
    turned = [0.0, 0.0]

    def each(seconds: float, vehicle: KinematicVehicle) -> None:
        turned[0] += wrap_angle(vehicle.yaw_rad - turned[1])
        turned[1] = vehicle.yaw_rad

    flight = Flight(SeekBehaviour(Seek("car")), vehicle, [SeenObject("person", 5.0, 5.0)])
    assert_failed(flight.run(90.0, each), "2 laps")
    assert turned[0] / math.tau == pytest.approx(2.0, abs=0.02)


def test_seek_turns_counterclockwise() -> None:
    vehicle = KinematicVehicle()
    Flight(SeekBehaviour(Seek("car", direction="counterclockwise")), vehicle).run(2.0)
    assert vehicle.yaw_rad < -0.5


def test_single_false_detection_is_ignored() -> None:
    ghost = SeenObject("car", 10.0, 3.0)

    def each(seconds: float, vehicle: KinematicVehicle) -> None:
        ghost.visible = 0.3 < seconds < 0.42

    outcome = Flight(SeekBehaviour(Seek("car", laps=1.0)), objects=[ghost]).run(60.0, each)
    assert outcome is not None
    assert outcome.reason.endswith("1 lap")


def test_turn_continues_when_the_find_disappears() -> None:
    car = SeenObject("car", 0.0, 10.0)
    flight = Flight(SeekBehaviour(Seek("car", laps=1.0)), objects=[car])
    in_view_since: list[float] = []

    def each(seconds: float, vehicle: KinematicVehicle) -> None:
        if abs(wrap_angle(math.pi / 2 - vehicle.yaw_rad)) < math.radians(40):
            in_view_since.append(seconds)
            car.visible = seconds - in_view_since[0] < 0.5

    assert_failed(flight.run(90.0, each))


def test_low_confidence_detections_do_not_count() -> None:
    weak = SeenObject("car", 10.0, 0.0, confidence=0.3)
    assert_failed(Flight(SeekBehaviour(Seek("car", laps=0.5)), objects=[weak]).run(60.0))


def test_silent_detector_stops_then_ends_the_turn() -> None:
    flight = Flight(SeekBehaviour(Seek("car")))

    def each(seconds: float, vehicle: KinematicVehicle) -> None:
        flight.perception_alive = seconds < 3.0

    assert_failed(flight.run(60.0, each), "no detections")
    assert abs(flight.vehicle.yaw_rate_radps) < 0.01


# --- the best find of a turn, as in the command `seek`


def whole_turn(laps: float = 2.0) -> SeekBehaviour:
    return SeekBehaviour(Seek("car", laps=laps), whole_turn=True)


def faces(vehicle: KinematicVehicle, scene_object: SeenObject) -> bool:
    return abs(
        wrap_angle(math.atan2(scene_object.east, scene_object.north) - vehicle.yaw_rad)
    ) < math.radians(5)


def car(north: float, east: float, score: float | None = None, **changes: Any) -> SeenObject:
    """A car; with a score, it is a track."""
    track_id = None if score is None else int(abs(north + east))
    return SeenObject("car", north, east, track_id=track_id, track_score=score, **changes)


# Of the two finds, the second is faced.
BEST = {
    "surest of a whole turn": (parse("seek car").build, car(20.0, 6.0, 0.5), car(-15.0, 9.0, 0.85)),
    "first": (lambda _: SeekBehaviour(Seek("car")), car(-15.0, 9.0, 0.85), car(20.0, 6.0, 0.5)),
    "nearest of the equally sure": (lambda _: whole_turn(), car(34.0, 12.0, 0.85), car(-15.0, 9.0, 0.8)),
    "by track, not frame": (
        lambda _: whole_turn(),
        car(20.0, 0.0, 0.45, confidence=0.9),
        car(20.0, 9.0, 0.8),
    ),
    "of a part of a turn": (lambda _: whole_turn(0.5), car(0.0, -15.0, 0.9), car(0.0, 15.0, 0.6)),
    "without tracks": (lambda _: whole_turn(), car(34.0, 12.0, confidence=0.5), car(-15.0, 9.0)),
    "without ranges": (
        lambda _: whole_turn(),
        car(34.0, 12.0, confidence=0.5, with_range=False),
        car(-15.0, 9.0, with_range=False),
    ),
}


@pytest.mark.parametrize(("build", "other", "best"), BEST.values(), ids=BEST)
def test_best_find_is_faced(
    build: Callable[[BuildContext], Behaviour], other: SeenObject, best: SeenObject
) -> None:
    vehicle = KinematicVehicle()
    found(Flight(build(NO_CONTEXT), vehicle, [other, best]))
    assert faces(vehicle, best)
    assert math.dist(vehicle.position, (0, 0, -5)) < 0.3


def test_often_ambiguous_find_ranks_lower() -> None:
    doubted = SeenObject("car", 12.0, 6.0, track_id=1, track_score=0.8)
    clear = SeenObject("car", -25.0, 9.0, track_id=2, track_score=0.7)
    vehicle = KinematicVehicle()

    def each(seconds: float, vehicle: KinematicVehicle) -> None:
        doubted.trusted = int(seconds * 10) % 3 != 0

    found(Flight(whole_turn(), vehicle, [doubted, clear]), each)
    assert faces(vehicle, clear)


def test_next_best_is_faced_when_the_best_is_gone() -> None:
    best = SeenObject("car", 10.0, 10.0, track_id=1, track_score=0.9)
    other = SeenObject("car", -15.0, 9.0, track_id=2, track_score=0.6)
    vehicle = KinematicVehicle()

    def each(seconds: float, vehicle: KinematicVehicle) -> None:
        best.visible = seconds < 6.0

    found(Flight(whole_turn(laps=1.0), vehicle, [best, other]), each)
    assert faces(vehicle, other)


def test_find_that_becomes_ambiguous_is_not_verified() -> None:
    car = SeenObject("car", 10.0, 10.0, track_id=1, track_score=0.9)

    def each(seconds: float, vehicle: KinematicVehicle) -> None:
        car.trusted = seconds < 8.0

    assert_failed(Flight(whole_turn(laps=1.0), objects=[car]).run(90.0, each))


def test_partial_turn_compares_its_finds() -> None:
    beyond = SeenObject("car", 0.0, -15.0, track_id=1, track_score=0.9)
    within = SeenObject("car", 0.0, 15.0, track_id=2, track_score=0.6)
    vehicle = KinematicVehicle()
    found(Flight(whole_turn(laps=0.5), vehicle, [beyond, within]))
    assert faces(vehicle, within)


def test_second_lap_faces_its_first_find_at_once() -> None:
    late = SeenObject("car", 0.0, 15.0, track_id=1, visible=False)
    times: list[float] = []
    vehicle = KinematicVehicle()

    def each(seconds: float, vehicle: KinematicVehicle) -> None:
        times.append(seconds)
        late.visible = seconds > 8.0

    found(Flight(whole_turn(), vehicle, [late]), each)
    assert times[-1] < 20.0


def test_weak_last_frames_do_not_lower_a_find() -> None:
    poor = SeenObject("car", 20.0, 6.0, confidence=0.55)
    good = SeenObject("car", -15.0, 9.0, confidence=0.85)
    vehicle = KinematicVehicle()

    def each(seconds: float, vehicle: KinematicVehicle) -> None:
        off_rad = abs(wrap_angle(math.atan2(good.east, good.north) - vehicle.yaw_rad))
        good.confidence = 0.85 if off_rad < math.radians(30) else 0.3

    found(Flight(whole_turn(), vehicle, [poor, good]), each)
    assert faces(vehicle, good)


def test_find_with_new_track_ids_is_faced_without_delay() -> None:
    """The image tracker ends a track that is unseen for 2 s; a sweep's turn is slower than that."""
    times: list[float] = []
    seen_s = [0.0]
    car = SeenObject("car", 12.0, 9.0, track_id=1)
    vehicle = KinematicVehicle()

    def each(seconds: float, vehicle: KinematicVehicle) -> None:
        times.append(seconds)
        if abs(wrap_angle(math.atan2(car.east, car.north) - vehicle.yaw_rad)) < math.radians(40):
            if seconds - seen_s[0] > 2.0:
                car.track_id = (car.track_id or 0) + 1
            seen_s[0] = seconds

    behaviour = SeekBehaviour(Seek("car", rate_radps=0.25), whole_turn=True)
    found(Flight(behaviour, vehicle, [car]), each)
    assert car.track_id == 2
    assert times[-1] < math.tau / 0.25 + 3.5
