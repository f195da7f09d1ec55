"""Commands about exactly one track: requirements, flights, losses, and the gimbal."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

from companion.guidance import Follow
from companion.guidance.behaviours.gimbal_pointing import PointGimbalBehaviour
from companion.guidance.grammar import json_schema, markdown, usage
from companion.guidance.interface import EventKind, GuidanceInput
from companion.guidance.objects.ranging import RangeMeans
from companion.guidance.objects.tracked_object import Subject
from companion.vehicle.gimbal import GimbalAim, YawFrame
from tests.companion.guidance.gimbal_flight import gimbal_flight, person
from tests.companion.guidance.guidance_harness import (
    GuidanceHarness,
    assert_failed,
    assert_succeeded,
    engaged,
    flown,
    flying,
    known,
)
from tests.companion.guidance.kinematic_vehicle import SeenObject, look


def car(north: float, east: float, track_id: int, **more: Any) -> SeenObject:
    return SeenObject("car", north, east, track_id=track_id, track_score=0.8, **more)


def walker(north: float, east: float, track_id: int, **more: Any) -> SeenObject:
    return replace(car(north, east, track_id, **more), class_name="person")


def watching(*objects: SeenObject, **more: Any) -> GuidanceHarness:
    """Guidance that sees the objects in every step, for half a second until now."""
    vehicle = flying()

    def seen(inputs: GuidanceInput) -> GuidanceInput:
        now_ns = vehicle.now_ns
        return replace(inputs, targets=look(vehicle, objects, now_ns), seen_ns=now_ns, **more)

    harness = GuidanceHarness(vehicle, class_names=("car", "person"), inputs=seen)
    harness.run(0.5)
    return harness


# --- the grammar


def test_help_and_schema_show_the_choice() -> None:
    assert usage(Follow).startswith("follow CLASS|track=…|marker=… [distance=8]")
    schema, keys = json_schema()["$defs"]["follow"], ("class", "track", "marker")
    assert schema["required"] == []
    assert schema["oneOf"] == [{"required": [key]} for key in keys]
    assert schema["properties"]["track"]["type"] == "integer"
    marker = schema["properties"]["marker"]
    assert (marker["type"], marker["minimum"], marker["maximum"]) == ("integer", 0, 1023)
    section = markdown().split("## follow\n")[1].split("\n## ")[0]
    (row,) = [line for line in section.splitlines() if line.startswith("| `track` | ")]
    assert row.endswith(f"| a track_id | {' or '.join(keys)} required |")


# --- requirements


def refused(harness: GuidanceHarness, command: str) -> str:
    outcome = assert_failed(harness.command(command).result())
    assert not harness.guidance.busy
    return outcome.reason


def test_unknown_track_is_refused_with_what_is_there() -> None:
    harness = watching(car(12, 0, 3), car(15, 2, 4), walker(10, -2, 5))
    reason = refused(harness, "follow track=17")
    assert "no track 17" in reason
    assert "2 car, 1 person" in reason
    assert harness.events[-1].kind is EventKind.REFUSED


def test_ended_track_is_refused_with_the_nearest_of_its_class() -> None:
    first, near, far = car(12, 0, 17), car(12, 1.2, 23), car(20, 6, 20)
    harness = watching(first, near, far, walker(12.1, 0.1, 21))
    first.visible = False
    harness.run(14.0)
    reason = refused(harness, "orbit track=17")
    assert "track 17 ended 12 s ago" in reason
    assert "nearest car" in reason
    assert "track 23, 1.2 m from" in reason
    assert "give track=23" in reason


def test_ended_track_without_a_successor_is_refused_with_a_list() -> None:
    first, other = car(12, 0, 17), walker(10, 0, 18, visible=False)
    harness = watching(first, other)
    first.visible, other.visible = False, True
    harness.run(5.0)
    reason = refused(harness, "follow track=17")
    assert "track 17 ended 3 s ago" in reason
    assert "present: 1 person" in reason


def test_track_that_is_missed_for_a_moment_is_accepted() -> None:
    harness = watching(seen := car(12, 0, 17))
    seen.visible = False
    harness.run(1.5)
    engaged(harness, "follow track=17")
    assert harness.guidance.busy


def test_track_whose_object_has_another_id_now_is_accepted() -> None:
    harness = watching(seen := car(12, 0, 17))
    seen.visible = False
    harness.run(0.5)
    seen.visible, seen.track_id = True, 23
    harness.run(3.0)
    engaged(harness, "follow track=17")
    (note,) = [event.message for event in harness.events if event.kind is EventKind.NOTED]
    assert note.startswith("track 17: ")
    assert "track 23" in note
    assert "track 23 (was 17)" in harness.guidance.status


def test_range_of_the_class_of_a_track_is_required() -> None:
    means = RangeMeans(depth=False, ground=False, classes=frozenset({"person"}))
    assert "a range to a car" in refused(watching(car(12, 0, 17), ranging=means), "follow track=17")


# --- flights


# Command, what is seen, which of them is meant, and how far from it the flight ends.
FLOWN: dict[str, tuple[str, list[SeenObject], int, float]] = {
    "follow the farther": (
        "follow track=2",
        [
            car(12, 0, 1, then=lambda seconds: {"north": 12 + seconds}),
            car(20, 3, 2, then=lambda seconds: {"north": 20 + seconds}),
        ],
        1,
        8.0,
    ),
    "approach the farther": ("approach track=2", [car(15, 0, 1), car(25, 8, 2)], 1, 5.0),
    "orbit the farther": ("orbit track=2 radius=8 speed=3 laps=1", [car(12, 0, 1), car(16, 5, 2)], 1, 8.0),
    "back with its id": (
        "follow track=1",
        [car(12, 0, 1, then=lambda s: {"north": 12 + 2.0 * s, "visible": not 8.0 <= s < 9.5})],
        0,
        8.0,
    ),
}


@pytest.mark.parametrize("case", FLOWN)
def test_track_that_was_given_is_flown_to(case: str) -> None:
    command, objects, meant, wanted_m = FLOWN[case]
    # An orbit begins after the first frame, as its requirement demands.
    flight, outcome = flown(command, *objects, seconds=25.0, latency_s=0.0 if "orbit" in case else 0.1)
    if not command.startswith("follow"):
        assert_succeeded(outcome)
    if command.startswith("approach"):
        assert known(outcome).reason.startswith("reached track 2 at")
    assert flight.distance_m(meant) == pytest.approx(wanted_m, abs=0.4 if "approach" in case else 0.8)


@pytest.mark.parametrize(
    ("command", "wanted_m"), [("follow track=1", 8.0), ("approach track=1 distance=2", 2.0)]
)
def test_object_that_gets_another_id_in_its_place_is_flown_to_on(command: str, wanted_m: float) -> None:
    """As after it left the image for a moment, because the vehicle leaned forward."""
    changing = car(25, 0, 1, then=lambda s: {"visible": not 4.0 <= s < 5.0, "track_id": 1 if s < 4.5 else 9})
    flight, outcome = flown(command, changing, seconds=30.0)
    assert outcome is None or outcome.success, outcome
    assert flight.distance_m() == pytest.approx(wanted_m, abs=0.6)
    (note,) = flight.notes
    assert note.startswith("track 1: ")
    assert "track 9 " in note
    assert "track 9 (was 1)" in flight.behaviour.status


BESIDE = car(25, 4.0, 9, then=lambda s: {"east": max(0.0, min(4.0, 4.0 - 2.0 * (s - 4.0)))})
FAR_AWAY = car(45, 20, 9)


@pytest.mark.parametrize("other", [BESIDE, FAR_AWAY], ids=["beside it", "far away"])
@pytest.mark.parametrize("command", ["follow track=1", "approach track=1 distance=2"])
def test_another_object_never_takes_the_place_of_a_lost_track(command: str, other: SeenObject) -> None:
    lost = car(25, 0, 1, then=lambda seconds: {"visible": seconds < 4.0})
    outcome = assert_failed(flown(command, lost, other, seconds=30.0)[1])
    assert outcome.reason.startswith("lost track 1 for")
    assert ("track 9, a car, is 0." in outcome.reason) is (other is BESIDE)
    assert ("track 9" in outcome.reason) is (other is BESIDE)


def test_loss_of_a_track_that_is_followed_is_an_event() -> None:
    """The command was answered when it began."""
    harness = watching(seen := car(12, 0, 17))
    command = harness.command("follow track=17", endless=True)
    assert harness.outcome(command).success
    harness.run(2.0)
    seen.track_id, seen.east = 23, 4.8
    harness.until(lambda: harness.events[-1].kind is EventKind.ENDED, 10.0)
    note = harness.events[-2]
    assert (note.kind, note.level) == (EventKind.NOTED, "warning")
    assert note.message.startswith("follow ended: ")
    assert "lost track 17 for 3.0 s" in note.message
    assert "track 23, a car, is " in note.message


def test_unconfirmed_track_is_not_flown_to() -> None:
    assert_failed(flown("approach track=1", car(15, 0, 1, trusted=False), seconds=20.0)[1], "not confirmed")


def test_wanted_is_a_class_a_track_or_a_marker() -> None:
    for wrong in ({}, {"class_name": "car", "track_id": 1}, {"track_id": 1, "marker_id": 7}):
        got = f"{wrong.get('track_id')} and {wrong.get('marker_id')}"
        with pytest.raises(ValueError, match=f"class, .*marker, .* {got}$"):
            Subject(**wrong)


# --- the gimbal


def test_gimbal_is_kept_on_a_track_until_it_is_lost() -> None:
    walker = person(20.0, 12.0)
    flight = gimbal_flight(walker)
    flight.run(2.0)
    aim = flight.command("gimbal track=1")
    assert flight.run_until(lambda: flight.outcome(aim), 10.0)
    assert_succeeded(flight.outcome(aim))

    def off_deg() -> float:
        target = flight.inputs.steering.targets[0]
        gimbal, yaw_rad = known(flight.state.gimbal), flight.state.yaw_rad
        assert yaw_rad is not None
        wanted = GimbalAim(target.elevation_rad, target.bearing_rad, YawFrame.NORTH)
        off_rad = known(gimbal.off_rad(wanted, yaw_rad))
        return math.degrees(off_rad)

    assert off_deg() < 5.0
    moving = flight.command("goto forward=6 right=0")
    assert flight.run_until(lambda: flight.outcome(moving), 30.0)
    assert off_deg() < 5.0, "kept while the vehicle flew"
    flight.cameras = ()
    assert flight.run_until(lambda: flight.events[-1].message.startswith("gimbal: lost "), 10.0)
    assert "lost track 1 " in flight.events[-1].message


def test_gimbal_is_refused_for_a_track_that_is_not_there() -> None:
    flight = gimbal_flight(person(20.0, 12.0))
    flight.run(1.0)
    aim = flight.command("gimbal track=99")
    flight.run(0.5)
    assert_failed(flight.outcome(aim), "no track 99; present: 1 person")


def test_mission_step_points_the_gimbal_at_a_track() -> None:
    flight = gimbal_flight(person(0.0, 25.0))
    flight.run(2.0)
    log = flight.fly(PointGimbalBehaviour(Subject(track_id=1)), 15.0, warm_up_s=0.0)
    assert_succeeded(log.outcome)
    gimbal = known(flight.state.gimbal)
    assert math.degrees(known(gimbal.pitch_rad)) == pytest.approx(-20.0, abs=4.0)
