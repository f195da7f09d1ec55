import math
from collections.abc import Callable

import pytest

from companion.guidance.behaviour import Outcome
from companion.guidance.behaviours.seek import Seek, SeekBehaviour
from companion.guidance.command import NO_CONTEXT
from companion.guidance.grammar import parse
from tests.companion.guidance.guidance_harness import Flight, assert_failed, assert_succeeded
from tests.companion.guidance.kinematic_vehicle import KinematicVehicle, SeenObject
from vision.attitude import wrap_angle


def found(
    flight: Flight, each: Callable[[float, KinematicVehicle], None] = lambda seconds, vehicle: None
) -> Outcome:
    outcome = assert_succeeded(flight.run(90.0, each))
    return outcome


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


def test_command_compares_the_finds_of_a_whole_turn() -> None:
    first = SeenObject("car", 20.0, 6.0, track_id=1, track_score=0.5)
    surer = SeenObject("car", -15.0, 9.0, track_id=2, track_score=0.85)
    vehicle = KinematicVehicle()
    found(Flight(parse("seek car").build(NO_CONTEXT), vehicle, [first, surer]))
    assert faces(vehicle, surer)
    assert math.dist(vehicle.position, (0, 0, -5)) < 0.3


def test_without_whole_turn_the_first_find_is_faced() -> None:
    first = SeenObject("car", 20.0, 6.0, track_id=1, track_score=0.5)
    surer = SeenObject("car", -15.0, 9.0, track_id=2, track_score=0.85)
    vehicle = KinematicVehicle()
    Flight(SeekBehaviour(Seek("car")), vehicle, [first, surer]).run(60.0)
    assert faces(vehicle, first)


def test_nearest_of_equally_confident_finds_is_faced() -> None:
    far = SeenObject("car", 34.0, 12.0, track_id=1, track_score=0.85)
    near = SeenObject("car", -15.0, 9.0, track_id=2, track_score=0.8)
    vehicle = KinematicVehicle()
    found(Flight(whole_turn(), vehicle, [far, near]))
    assert faces(vehicle, near)


def test_two_finds_in_one_view_are_compared() -> None:
    """The one with the higher confidence per frame has the lower track score."""
    poor = SeenObject("car", 20.0, 0.0, confidence=0.9, track_id=1, track_score=0.45)
    good = SeenObject("car", 20.0, 9.0, confidence=0.8, track_id=2, track_score=0.8)
    vehicle = KinematicVehicle()
    Flight(whole_turn(), vehicle, [poor, good]).run(60.0)
    assert faces(vehicle, good)


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


@pytest.mark.parametrize("with_range", [True, False])
def test_without_tracking_two_finds_are_distinguished(with_range: bool) -> None:
    far = SeenObject("car", 34.0, 12.0, confidence=0.5, with_range=with_range)
    near = SeenObject("car", -15.0, 9.0, with_range=with_range)
    vehicle = KinematicVehicle()
    found(Flight(whole_turn(), vehicle, [far, near]))
    assert faces(vehicle, near)


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
