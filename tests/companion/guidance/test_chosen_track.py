"""Commands about exactly one track: requirements, flights, losses, and the gimbal."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pytest

from companion.guidance import Approach, Follow
from companion.guidance.behaviours.approach import ApproachBehaviour
from companion.guidance.behaviours.follow import FollowBehaviour
from companion.guidance.behaviours.gimbal_pointing import PointGimbalBehaviour
from companion.guidance.behaviours.orbit import Orbit, OrbitBehaviour
from companion.guidance.core import GuidanceOptions
from companion.guidance.grammar import json_schema, markdown, usage
from companion.guidance.interface import EventKind, GuidanceInput
from companion.guidance.objects.ranging import RangeMeans
from companion.guidance.objects.tracked_object import Subject
from companion.vehicle.gimbal import GimbalAim, YawFrame
from tests.companion.guidance.gimbal_flight import gimbal_flight, person
from tests.companion.guidance.guidance_harness import (
    Flight,
    GuidanceHarness,
    assert_failed,
    assert_succeeded,
    engaged,
    flying,
    known,
)
from tests.companion.guidance.kinematic_vehicle import KinematicVehicle, SeenObject, look

NAMES = ("car", "person")


def car(north: float, east: float, track_id: int, **more: Any) -> SeenObject:
    return SeenObject("car", north, east, track_id=track_id, track_score=0.8, **more)


def watching(vehicle: KinematicVehicle, objects: Sequence[SeenObject], **more: Any) -> GuidanceHarness:
    """Guidance that sees the objects in every step."""

    def seen(inputs: GuidanceInput) -> GuidanceInput:
        now_ns = vehicle.now_ns
        return replace(inputs, targets=look(vehicle, objects, now_ns), seen_ns=now_ns, **more)

    return GuidanceHarness(vehicle, class_names=NAMES, options=GuidanceOptions(), inputs=seen)


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


def refused(harness: GuidanceHarness, behaviour: FollowBehaviour | OrbitBehaviour) -> str:
    outcome = assert_failed(harness.command(behaviour).result())
    assert not harness.guidance.busy
    return outcome.reason


def test_unknown_track_is_refused_with_what_is_there() -> None:
    objects = [car(12, 0, 3), car(15, 2, 4), SeenObject("person", 10, -2, track_id=5, track_score=0.8)]
    harness = watching(flying(), objects)
    harness.run(0.5)
    reason = refused(harness, FollowBehaviour(Follow(Subject(track_id=17))))
    assert "no track 17" in reason
    assert "2 car, 1 person" in reason
    assert harness.events[-1].kind is EventKind.REFUSED


def test_ended_track_is_refused_with_the_nearest_of_its_class() -> None:
    first, near, far = car(12, 0, 17), car(12, 1.2, 23), car(20, 6, 20)
    walker = SeenObject("person", 12.1, 0.1, track_id=21, track_score=0.8)
    harness = watching(flying(), [first, near, far, walker])
    harness.run(0.5)
    first.visible = False
    harness.run(14.0)
    reason = refused(harness, OrbitBehaviour(Orbit(subject=Subject(track_id=17))))
    assert "track 17 ended 12 s ago" in reason
    assert "nearest car" in reason
    assert "track 23, 1.2 m from" in reason
    assert "give track=23" in reason


def test_ended_track_without_a_successor_is_refused_with_a_list() -> None:
    harness = watching(flying(), objects := [car(12, 0, 17)])
    harness.run(0.5)
    objects[0] = SeenObject("person", 10, 0, track_id=18, track_score=0.8)
    harness.run(5.0)
    reason = refused(harness, FollowBehaviour(Follow(Subject(track_id=17))))
    assert "track 17 ended 3 s ago" in reason
    assert "present: 1 person" in reason


def test_track_that_is_missed_for_a_moment_is_accepted() -> None:
    seen = car(12, 0, 17)
    harness = watching(flying(), [seen])
    harness.run(0.5)
    seen.visible = False
    harness.run(1.5)
    engaged(harness, FollowBehaviour(Follow(Subject(track_id=17))))
    assert harness.guidance.busy


def test_track_whose_object_has_another_id_now_is_accepted() -> None:
    seen = car(12, 0, 17)
    harness = watching(flying(), [seen])
    harness.run(0.5)
    seen.visible = False
    harness.run(0.5)
    seen.visible, seen.track_id = True, 23
    harness.run(3.0)
    engaged(harness, FollowBehaviour(Follow(Subject(track_id=17))))
    (note,) = [event.message for event in harness.events if event.kind is EventKind.NOTED]
    assert note == "track 17: the object is track 23 now"
    assert "track 23 (was 17)" in harness.guidance.status


def test_range_of_the_class_of_a_track_is_required() -> None:
    means = RangeMeans(depth=False, ground=False, classes=frozenset({"person"}))
    harness = watching(flying(), [car(12, 0, 17)], ranging=means)
    harness.run(0.5)
    assert "a range to a car" in refused(harness, FollowBehaviour(Follow(Subject(track_id=17))))


# --- flights


def test_follow_keeps_to_the_farther_car() -> None:
    near, far = car(12, 0, 1), car(20, 3, 2)
    vehicle = KinematicVehicle()

    def each(seconds: float, _vehicle: KinematicVehicle) -> None:
        near.north, far.north = 12 + 1.0 * seconds, 20 + 1.0 * seconds

    assert Flight(FollowBehaviour(Follow(Subject(track_id=2))), vehicle, [near, far]).run(20.0, each) is None
    assert math.dist(vehicle.position[:2], (far.north, far.east)) == pytest.approx(8.0, abs=0.8)


def test_approach_flies_to_the_farther_car() -> None:
    near, far = car(15, 0, 1), car(25, 8, 2)
    vehicle = KinematicVehicle()
    outcome = assert_succeeded(
        Flight(ApproachBehaviour(Approach(Subject(track_id=2))), vehicle, [near, far]).run(60.0)
    )
    assert outcome.reason.startswith("reached track 2 at")
    assert math.dist(vehicle.position[:2], (far.north, far.east)) == pytest.approx(5.0, abs=0.4)


def test_orbit_is_about_the_track() -> None:
    flight = Flight(
        OrbitBehaviour(Orbit(radius_m=8.0, speed_mps=3.0, laps=1.0, subject=Subject(track_id=2))),
        objects=[car(12, 0, 1), car(16, 5, 2)],
    )
    flight.latency_s = 0.0  # it begins after the first frame, as its requirement demands
    assert_succeeded(flight.run(60.0))
    ends = flight.track[-1]
    assert math.dist(ends[:2], (16, 5)) == pytest.approx(8.0, abs=0.6)


@pytest.mark.parametrize(
    "behaviour",
    [
        FollowBehaviour(Follow(Subject(track_id=1))),
        ApproachBehaviour(Approach(Subject(track_id=1), distance_m=2.0)),
    ],
)
def test_object_that_gets_another_id_in_its_place_is_flown_to_on(
    behaviour: FollowBehaviour | ApproachBehaviour,
) -> None:
    """As after it left the image for a moment, because the vehicle leaned forward."""
    seen = car(25, 0, 1)

    def each(seconds: float, _vehicle: KinematicVehicle) -> None:
        seen.visible, seen.track_id = not 4.0 <= seconds < 5.0, 1 if seconds < 4.5 else 9

    flight = Flight(behaviour, objects=[seen])
    outcome = flight.run(30.0, each)
    assert outcome is None or outcome.success, outcome
    wanted_m = 8.0 if isinstance(behaviour, FollowBehaviour) else 2.0
    assert math.dist(flight.track[-1][:2], (25, 0)) == pytest.approx(wanted_m, abs=0.6)
    (note,) = flight.notes
    assert note.startswith("track 1: ")
    assert "track 9 " in note
    assert "track 9 (was 1)" in behaviour.status


@pytest.mark.parametrize(
    "behaviour",
    [
        FollowBehaviour(Follow(Subject(track_id=1))),
        ApproachBehaviour(Approach(Subject(track_id=1), distance_m=2.0)),
    ],
)
def test_object_seen_beside_the_track_never_takes_its_place(
    behaviour: FollowBehaviour | ApproachBehaviour,
) -> None:
    seen, beside = car(25, 0, 1), car(25, 4.0, 9)

    def each(seconds: float, _vehicle: KinematicVehicle) -> None:
        seen.visible = seconds < 4.0
        beside.east = max(0.0, min(4.0, 4.0 - 2.0 * (seconds - 4.0)))

    outcome = assert_failed(Flight(behaviour, objects=[seen, beside]).run(30.0, each))
    assert outcome.reason.startswith("lost track 1 for")
    assert "track 9, a car, is 0." in outcome.reason


def test_loss_of_a_track_that_is_followed_is_an_event() -> None:
    """The command was answered when it began."""
    seen = car(12, 0, 17)
    harness = watching(flying(), [seen])
    harness.run(0.5)
    command = harness.command(FollowBehaviour(Follow(Subject(track_id=17))), endless=True)
    assert harness.outcome(command).success
    harness.run(2.0)
    seen.track_id, seen.east = 23, 4.8
    harness.until(lambda: harness.events[-1].kind is EventKind.ENDED, 10.0)
    note = harness.events[-2]
    assert (note.kind, note.level) == (EventKind.NOTED, "warning")
    assert note.message.startswith("follow ended: ")
    assert "lost track 17 for 3.0 s" in note.message
    assert "track 23, a car, is " in note.message


def test_track_that_comes_back_with_its_id_is_followed_on() -> None:
    seen = car(12, 0, 1)
    vehicle = KinematicVehicle()

    def each(seconds: float, _vehicle: KinematicVehicle) -> None:
        seen.north, seen.visible = 12 + 2.0 * seconds, not 8.0 <= seconds < 9.5

    assert Flight(FollowBehaviour(Follow(Subject(track_id=1))), vehicle, [seen]).run(25.0, each) is None
    assert math.dist(vehicle.position[:2], (seen.north, 0)) == pytest.approx(8.0, abs=0.8)


def test_lost_track_far_from_all_others_names_none() -> None:
    seen, other = car(12, 0, 1), car(30, 20, 2)

    def each(seconds: float, _vehicle: KinematicVehicle) -> None:
        seen.visible = seconds < 5.0

    outcome = known(
        Flight(FollowBehaviour(Follow(Subject(track_id=1))), objects=[seen, other]).run(30.0, each)
    )
    assert "track 2" not in outcome.reason


def test_unconfirmed_track_is_not_flown_to() -> None:
    ghost = car(15, 0, 1, trusted=False)
    assert_failed(
        Flight(ApproachBehaviour(Approach(Subject(track_id=1))), objects=[ghost]).run(20.0), "not confirmed"
    )


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
    assert gimbal.pitch_rad is not None
    assert math.degrees(gimbal.pitch_rad) == pytest.approx(-20.0, abs=4.0)
