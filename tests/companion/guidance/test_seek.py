"""Flights of `seek`: which find is faced, by a turn or along a pattern, and how it ends without one."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from companion.guidance.behaviour import Behaviour
from companion.guidance.behaviours.seek import SearchBehaviour, Seek, SeekBehaviour
from companion.guidance.objects.target import DOUBTED
from tests.companion.guidance.guidance_harness import Flight, assert_failed, assert_succeeded, flown
from tests.companion.guidance.kinematic_vehicle import KinematicVehicle, SeenObject
from vision.attitude import wrap_angle


def car(north: float, east: float, score: float | None = None, **changes: Any) -> SeenObject:
    """A car; with a score, it is a track."""
    track_id = None if score is None else int(abs(north + east))
    return replace(SeenObject("car", north, east, track_id=track_id, track_score=score), **changes)


def turn(laps: float = 2.0) -> SeekBehaviour:
    """Faces the first find."""
    return SeekBehaviour(Seek("car", laps=laps))


def whole_turn(laps: float = 2.0, rate_radps: float = 0.5) -> SeekBehaviour:
    """Faces the best find of a turn, as the command does."""
    return SeekBehaviour(Seek("car", laps=laps, rate_radps=rate_radps), whole_turn=True)


@pytest.mark.parametrize("degrees", [0, 30, 90, 179, 200, 300, 355])
def test_seek_finds_and_faces_an_object(degrees: float) -> None:
    angle = math.radians(degrees)
    flight, outcome = flown(turn(), car(12.0 * math.cos(angle), 12.0 * math.sin(angle)))
    assert_succeeded(outcome, "12.0 m")
    assert flight.off_nose_rad() < math.radians(5)
    assert math.dist(flight.vehicle.position, (0, 0, -5)) < 0.2


def test_seek_gives_up_after_its_laps() -> None:
    turned = [0.0, 0.0]

    def each(seconds: float, vehicle: KinematicVehicle) -> None:
        turned[0] += wrap_angle(vehicle.yaw_rad - turned[1])
        turned[1] = vehicle.yaw_rad

    _, outcome = flown(turn(), SeenObject("person", 5.0, 5.0), each=each)
    assert_failed(outcome, "2 laps")
    assert turned[0] / math.tau == pytest.approx(2.0, abs=0.02)


def test_seek_turns_counterclockwise() -> None:
    flight, _ = flown(SeekBehaviour(Seek("car", direction="counterclockwise")), seconds=2.0)
    assert flight.vehicle.yaw_rad < -0.5


# What is not found by a lap, and words of the reason.
NOT_FOUND = {
    "one false frame": (
        turn(1.0),
        car(10.0, 3.0, then=lambda seconds: {"visible": 0.3 < seconds < 0.42}),
        "1 lap",
    ),
    "weak frames": (turn(1.0), car(10.0, 0.0, confidence=0.3), "1 lap"),
    "never confirmed": (turn(1.0), car(12.0, 4.0, 0.6, trusted=False), DOUBTED),
    "ambiguous when it is faced": (
        whole_turn(1.0),
        car(10.0, 10.0, 0.9, then=lambda seconds: {"trusted": seconds < 8.0}),
        "",
    ),
}


@pytest.mark.parametrize("case", NOT_FOUND)
def test_doubtful_object_is_not_found(case: str) -> None:
    behaviour, seen, ending = NOT_FOUND[case]
    _, outcome = flown(behaviour, seen)
    assert assert_failed(outcome).reason.endswith(ending)


def test_turn_continues_when_the_find_disappears() -> None:
    flight = Flight(turn(1.0), objects=[seen := car(0.0, 10.0)])
    in_view_since: list[float] = []

    def each(seconds: float, vehicle: KinematicVehicle) -> None:
        if flight.off_nose_rad() < math.radians(40):
            in_view_since.append(seconds)
            seen.visible = seconds - in_view_since[0] < 0.5

    assert_failed(flight.run(90.0, each))


def test_silent_detector_stops_then_ends_the_turn() -> None:
    flight = Flight(turn())

    def each(seconds: float, vehicle: KinematicVehicle) -> None:
        flight.perception_alive = seconds < 3.0

    assert_failed(flight.run(60.0, each), "no detections")
    assert abs(flight.vehicle.yaw_rate_radps) < 0.01


# Of the finds, the first is faced.
Case = tuple[Behaviour | str, list[SeenObject]]
BEST: dict[str, Callable[[], Case]] = {
    "surest of a whole turn": lambda: ("seek car", [car(-15.0, 9.0, 0.85), car(20.0, 6.0, 0.5)]),
    "first": lambda: (turn(), [car(20.0, 6.0, 0.5), car(-15.0, 9.0, 0.85)]),
    "nearest of the equally sure": lambda: (
        whole_turn(), [car(-15.0, 9.0, 0.8), car(34.0, 12.0, 0.85)],
    ),
    "by track, not frame": lambda: (
        whole_turn(), [car(20.0, 9.0, 0.8), car(20.0, 0.0, 0.45, confidence=0.9)],
    ),
    "of a part of a turn": lambda: (whole_turn(0.5), [car(0.0, 15.0, 0.6), car(0.0, -15.0, 0.9)]),
    "without tracks": lambda: (whole_turn(), [car(-15.0, 9.0), car(34.0, 12.0, confidence=0.5)]),
    "without ranges": lambda: (
        whole_turn(),
        [car(-15.0, 9.0, with_range=False), car(34.0, 12.0, confidence=0.5, with_range=False)],
    ),
    "seldom ambiguous": lambda: (
        whole_turn(),
        [car(-25.0, 9.0, 0.7), car(12.0, 6.0, 0.8, then=lambda s: {"trusted": int(s * 10) % 3 != 0})],
    ),
    "next, when the best is gone": lambda: (
        whole_turn(1.0),
        [car(-15.0, 9.0, 0.6), car(10.0, 10.0, 0.9, then=lambda s: {"visible": s < 6.0})],
    ),
    "confirmed late": lambda: (turn(1.0), [car(12.0, 4.0, 0.6, then=lambda s: {"trusted": s > 1.5})]),
    "not one that appears beside it": lambda: (
        turn(), [car(14.0, 0.0, 0.8), car(14.0, 2.4, 0.8, then=lambda s: {"visible": s > 0.6})],
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", BEST)
def test_best_find_is_faced(case: str) -> None:
    behaviour, objects = BEST[case]()
    flight, outcome = flown(behaviour, *objects)
    assert_succeeded(outcome)
    assert flight.off_nose_rad() < math.radians(4.5)
    assert math.dist(flight.vehicle.position, (0, 0, -5)) < 0.3


def test_weak_last_frames_do_not_lower_a_find() -> None:
    flight = Flight(whole_turn(), objects=[good := car(-15.0, 9.0), car(20.0, 6.0, confidence=0.55)])

    def each(seconds: float, vehicle: KinematicVehicle) -> None:
        good.confidence = 0.85 if flight.off_nose_rad() < math.radians(30) else 0.3

    assert_succeeded(flight.run(90.0, each))
    assert flight.off_nose_rad() < math.radians(5)


def test_second_lap_faces_its_first_find_at_once() -> None:
    flight, outcome = flown(whole_turn(), car(0.0, 15.0, 0.8, then=lambda s: {"visible": s > 8.0}))
    assert_succeeded(outcome)
    assert flight.seconds < 20.0


def test_find_with_new_track_ids_is_faced_without_delay() -> None:
    """The image tracker ends a track that is unseen for 2 s; a sweep's turn is slower than that."""
    seen_s = [0.0]
    flight = Flight(whole_turn(rate_radps=0.25), objects=[seen := car(12.0, 9.0, track_id=1)])

    def each(seconds: float, vehicle: KinematicVehicle) -> None:
        if flight.off_nose_rad() < math.radians(40):
            seen.track_id = (seen.track_id or 0) + (seconds - seen_s[0] > 2.0)
            seen_s[0] = seconds

    assert_succeeded(flight.run(90.0, each))
    assert seen.track_id == 2
    assert flight.seconds < math.tau / 0.25 + 3.5


# --- along a pattern


@pytest.mark.parametrize(
    "pattern", ["pattern=square radius=12 spacing=8", "pattern=lawnmower width=24 height=16 spacing=8"]
)
def test_search_finds_an_object_hidden_from_the_centre(pattern: str) -> None:
    flight = Flight(f"seek car {pattern}", objects=[seen := car(6.0, -9.0, track_id=4)])

    def each(seconds: float, vehicle: KinematicVehicle) -> None:
        seen.visible = flight.distance_m() < 9.0  # small objects are seen only from near

    assert assert_succeeded(flight.run(240.0, each)).reason.startswith("found a car")
    assert flight.off_nose_rad() < math.radians(5)


@pytest.mark.parametrize(
    ("pattern", "reason"),
    [({"radius_m": 8.0, "spacing_m": 8.0}, DOUBTED), ({"radius_m": 30.0}, "set spacing")],
    ids=["only a doubtful one", "neither footprint nor spacing"],
)
def test_search_without_a_find_says_why(pattern: dict[str, float], reason: str) -> None:
    command = Seek("car", pattern="square", **pattern)  # type: ignore[arg-type]
    _, outcome = flown(SearchBehaviour(command), car(6.0, 2.0, trusted=False), seconds=120.0)
    assert assert_failed(outcome).reason.endswith(reason)
