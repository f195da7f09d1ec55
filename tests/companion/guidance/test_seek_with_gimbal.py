"""`seek` with a camera on a gimbal, flown with the built-in vehicle in lockstep.

Somebody stands nearly below the vehicle: 68° under the horizon, where a camera that looks ahead (its picture
ends 32° down) does not see, and one on a gimbal does once it looks down.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from companion.bench.lockstep_flight import FlightLog, LockstepFlight, Moment
from companion.bench.synthetic_detector import SceneObject
from companion.guidance.command import BuildContext
from companion.guidance.grammar import parse
from companion.guidance.missions.mission_file import plan_from
from companion.guidance.missions.sequence import SequenceBehaviour
from companion.guidance.targets.target import Target
from tests.companion.guidance.gimbal_flight import (
    CAMERA,
    FOOTPRINT,
    HEIGHT_M,
    PERSON_M,
    gimbal_flight,
    person,
)

# Two axes and an estimate: what the picture, the gimbal and the estimator are off by together.
DIRECTION_BOUND_RAD, PLACE_BOUND_M = math.radians(1.5), 0.6


def fly(
    command: str, thing: SceneObject, *, seed: int = 5, limit_s: float = 90.0, **options: Any
) -> tuple[LockstepFlight, FlightLog, list[Target]]:
    """The flight, its log, and every target that was seen, once."""
    flight = gimbal_flight(thing, seed=seed, **options)
    seen: dict[int, Target] = {}

    def each(moment: Moment) -> None:
        for target in moment.context.targets:
            seen.setdefault(target.captured_ns, target)

    log = flight.fly(parse(command).build(BuildContext(FOOTPRINT)), limit_s, each=each)
    return flight, log, list(seen.values())


def direction(target: Target) -> np.ndarray:
    level = math.cos(target.elevation_rad)
    return np.array(
        [
            level * math.cos(target.bearing_rad),
            level * math.sin(target.bearing_rad),
            -math.sin(target.elevation_rad),
        ]
    )


def cut_off(target: Target) -> bool:
    """By the picture's edge: the middle of what is left is not the middle of the thing."""
    left, top, right, bottom = target.box_xyxy
    return left < 2 or top < 2 or right > CAMERA.width - 3 or bottom > CAMERA.height - 3


def pitches(log: FlightLog) -> list[float]:
    found = []
    for moment in log.moments:
        gimbal = moment.context.state.gimbal
        assert gimbal is not None
        assert gimbal.pitch_rad is not None
        found.append(math.degrees(gimbal.pitch_rad))
    return found


@pytest.mark.parametrize("bearing_deg", [0.0, 150.0])
def test_what_only_a_camera_that_looks_down_sees_is_found_with_the_sweep(bearing_deg: float) -> None:
    thing = person(bearing_deg)
    flight, log, seen = fly("seek person sweep=-60", thing)
    assert log.outcome is not None
    assert log.outcome.success, log.outcome.reason
    assert not log.violations
    pose, truth = thing.pose(0.0), flight.vehicle.truth
    bearing = math.atan2(pose.east_m - truth.position_ned_m[1], pose.north_m - truth.position_ned_m[0])
    # So far off the horizon a bearing's degree is a third of one across.
    assert abs(math.remainder(truth.yaw_rad - bearing, math.tau)) < math.radians(15.0)
    assert pitches(log)[-1] < -50.0, "found, the gimbal looks at it"
    place = seen[-1].position_ned_m
    assert place is not None
    assert thing.range_m(place, 0.0) < PLACE_BOUND_M
    # Nobody holds it any more.
    flight.run(1.0)
    manager = flight.vehicle.vehicle.gimbal_manager
    assert manager is not None
    assert manager.primary == (0, 0)


def test_as_a_step_of_a_mission_the_vehicle_holds_until_the_gimbal_looks_there() -> None:
    table = '[[step]]\ndo = "gimbal pitch=-50"\n[[step]]\ndo = "hold duration=1"\n'
    mission = SequenceBehaviour(plan_from(table, "looks"), lambda behaviour: None)
    flight = LockstepFlight.airborne(seed=5, height_m=HEIGHT_M, gimbal=True)
    log = flight.fly(mission, 20.0)
    assert log.outcome is not None
    assert log.outcome.success, log.outcome.reason
    assert [step.reason for step in mission.records] == ["the gimbal looks 50° down", "held for 1 s"]
    assert pitches(log)[-1] == pytest.approx(-50.0, abs=3.0)
    # The next step wants nothing of it, so it has been given back.
    manager = flight.vehicle.vehicle.gimbal_manager
    assert manager is not None
    assert manager.primary == (0, 0)


def test_without_the_sweep_it_is_not_found() -> None:
    _, log, _ = fly("seek person laps=1", person(0.0))
    assert log.outcome is not None
    assert (log.outcome.success, log.outcome.reason) == (False, "no person seen in 1 lap")


def test_directions_and_places_are_right_while_the_gimbal_moves_and_the_vehicle_turns() -> None:
    """Another class is looked for, so that the sweep never stops; wind leans the vehicle."""
    thing = person(60.0)
    _, log, seen = fly("seek car sweep=-60 laps=1", thing, wind_mps=3.0)
    assert log.outcome is not None
    assert log.outcome.reason == "no car seen in 1 lap"
    assert pitches(log)[-1] == pytest.approx(pitches(log)[0], abs=5.0), "in vain, it looks where it did"
    assert min(pitches(log)) == pytest.approx(-60.0, abs=5.5)
    errors_rad, errors_m = [], []
    stamps = np.array([moment.context.now_ns for moment in log.moments])
    whole = [target for target in seen if not cut_off(target)]
    for target in whole:
        index = int(np.argmin(np.abs(stamps - target.captured_ns)))
        place = np.array(log.moments[index].truth.position_ned_m)
        pose = thing.pose(0.0)
        true = np.array([pose.north_m, pose.east_m, -PERSON_M[2] / 2]) - place
        errors_rad.append(math.acos(min(1.0, float(true @ direction(target) / np.linalg.norm(true)))))
        if target.position_ned_m is not None:
            errors_m.append(thing.range_m(target.position_ned_m, 0.0))
    assert len(errors_rad) > 40
    assert np.percentile(errors_rad, 95) < DIRECTION_BOUND_RAD, np.degrees(errors_rad)
    assert np.percentile(errors_m, 95) < PLACE_BOUND_M, errors_m
