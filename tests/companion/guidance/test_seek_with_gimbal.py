"""`seek` with a camera on a gimbal, flown with the simulated vehicle in lockstep.

A person stands nearly below the vehicle, 68° below the horizon: outside the view of a forward camera (its
image ends 32° down), and inside that of a gimbal camera that is pitched down.
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
from companion.guidance.objects.target import Target
from tests.companion.guidance.gimbal_flight import (
    CAMERA,
    FOOTPRINT,
    HEIGHT_M,
    PERSON_M,
    gimbal_flight,
    person,
)
from tests.companion.guidance.guidance_harness import (
    assert_failed,
    assert_succeeded,
    in_the_air,
    known,
    mission,
)

# Bounds of the combined errors of image, gimbal and estimator.
DIRECTION_BOUND_RAD, PLACE_BOUND_M = math.radians(1.5), 0.6


def fly(
    command: str, scene_object: SceneObject, *, seed: int = 5, limit_s: float = 90.0, **options: Any
) -> tuple[LockstepFlight, FlightLog, list[Target]]:
    """The flight, its log, and every target once."""
    flight = gimbal_flight(scene_object, seed=seed, **options)
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
    """Whether the image edge cuts the box: its centre is then not the object's centre."""
    left, top, right, bottom = target.box_xyxy
    return left < 2 or top < 2 or right > CAMERA.width - 3 or bottom > CAMERA.height - 3


def pitches(log: FlightLog) -> list[float]:
    found = []
    for moment in log.moments:
        gimbal = known(moment.context.state.gimbal)
        found.append(math.degrees(known(gimbal.pitch_rad)))
    return found


@pytest.mark.parametrize("bearing_deg", [pytest.param(0.0, marks=pytest.mark.slow), 150.0])
def test_sweep_finds_an_object_nearly_below(bearing_deg: float) -> None:
    scene_object = person(bearing_deg)
    flight, log, seen = fly("seek person sweep=-60", scene_object)
    assert_succeeded(log.outcome)
    assert not log.violations
    pose, truth = scene_object.pose(0.0), flight.vehicle.truth
    bearing = math.atan2(pose.east_m - truth.position_ned_m[1], pose.north_m - truth.position_ned_m[0])
    # At this elevation 1° of bearing is a third of a degree across.
    assert abs(math.remainder(truth.yaw_rad - bearing, math.tau)) < math.radians(15.0)
    assert pitches(log)[-1] < -50.0, "the gimbal points at the find"
    position = known(seen[-1].position_ned_m)
    assert scene_object.range_m(position, 0.0) < PLACE_BOUND_M
    # Control is released.
    flight.run(1.0)
    manager = known(flight.vehicle.vehicle.gimbal_manager)
    assert manager.primary == (0, 0)


def test_mission_step_holds_until_the_gimbal_points_there() -> None:
    flight = LockstepFlight.of_vehicle(in_the_air(seed=5, height_m=HEIGHT_M, gimbal=True))
    steps = mission(flight, "gimbal pitch=-50", "hold duration=1")
    log = flight.fly(steps, 20.0)
    assert_succeeded(log.outcome)
    assert [step.success for step in steps.records] == [True, True]
    assert "50° down" in steps.records[0].reason
    assert pitches(log)[-1] == pytest.approx(-50.0, abs=3.0)
    # The next step does not use it, so control was released.
    manager = known(flight.vehicle.vehicle.gimbal_manager)
    assert manager.primary == (0, 0)


@pytest.mark.slow
def test_without_sweep_it_is_not_found() -> None:
    _, log, _ = fly("seek person laps=1", person(0.0))
    assert_failed(log.outcome, "found in 1 lap")


def test_directions_and_positions_while_gimbal_and_yaw_turn() -> None:
    """Searches for another class, so that the sweep does not stop; wind tilts the vehicle."""
    scene_object = person(60.0)
    _, log, seen = fly("seek car sweep=-60 laps=1", scene_object, rate_hz=10.0, wind_mps=3.0, noise=0.0)
    assert_failed(log.outcome, "found in 1 lap")
    assert pitches(log)[-1] == pytest.approx(pitches(log)[0], abs=5.0), "returned to the initial pitch"
    assert min(pitches(log)) == pytest.approx(-60.0, abs=5.5)
    errors_rad, errors_m = [], []
    stamps = np.array([moment.context.now_ns for moment in log.moments])
    whole = [target for target in seen if not cut_off(target)]
    for target in whole:
        index = int(np.argmin(np.abs(stamps - target.captured_ns)))
        position = np.array(log.moments[index].truth.position_ned_m)
        pose = scene_object.pose(0.0)
        true = np.array([pose.north_m, pose.east_m, -PERSON_M[2] / 2]) - position
        errors_rad.append(math.acos(min(1.0, float(true @ direction(target) / np.linalg.norm(true)))))
        if target.position_ned_m is not None:
            errors_m.append(scene_object.range_m(target.position_ned_m, 0.0))
    assert len(errors_rad) > 40
    assert np.percentile(errors_rad, 95) < DIRECTION_BOUND_RAD, np.degrees(errors_rad)
    assert np.percentile(errors_m, 95) < PLACE_BOUND_M, errors_m
