"""Resets of the autopilot's position estimate, and invalid estimates, in flight."""

from __future__ import annotations

import math

import pytest

from benchmarks.rendered import camera_settings
from companion.bench.lockstep_flight import LockstepFlight
from companion.bench.synthetic_camera import SyntheticCamera
from companion.bench.synthetic_detector import SceneObject, ScenePose, SyntheticDetector
from companion.guidance.interface import EventKind
from tests.companion.guidance.guidance_harness import (
    GuidanceHarness,
    assert_failed,
    assert_succeeded,
    engaged,
    flying,
    in_the_air,
    known,
    with_state,
)
from vision.camera_model import CameraModel, CameraMount

RESET_NED_M = (5.0, 3.0, -1.0)
RESET = "ekf_reset 5 3 -1"


def airborne(autopilot: str) -> LockstepFlight:
    return LockstepFlight.of_vehicle(in_the_air(seed=4, autopilot=autopilot))


def distance_m(flight: LockstepFlight, point_ned_m: tuple[float, ...]) -> float:
    return math.dist(flight.vehicle.truth.position_ned_m, point_ned_m)


@pytest.mark.parametrize("autopilot", ["px4", pytest.param("ardupilot", marks=pytest.mark.slow)])
@pytest.mark.parametrize("reset_s", [pytest.param(3.0, marks=pytest.mark.slow), 0.5])
def test_goal_keeps_its_ground_position_through_a_reset(autopilot: str, reset_s: float) -> None:
    flight = airborne(autopilot)
    goal = (25.0, 4.0, flight.vehicle.truth.position_ned_m[2])
    identifier = flight.command("goto 25 4")
    flight.run(reset_s)
    before = flight.state
    flight.vehicle.vehicle.faults.begin(RESET)
    fastest_mps = 0.0

    def arrived() -> bool:
        nonlocal fastest_mps
        fastest_mps = max(fastest_mps, math.hypot(*known(flight.state.velocity_ned_mps)[:2]))
        return flight.outcome(identifier) is not None

    assert flight.run_until(arrived, 40.0)
    assert_succeeded(flight.outcome(identifier))
    assert distance_m(flight, goal) < 1.0  # in the autopilot's new coordinates the goal is 5.9 m from there
    assert fastest_mps < 5.5
    assert flight.state.reset_count == before.reset_count + 1
    assert flight.state.reset_offset_ned_m == pytest.approx(RESET_NED_M, abs=0.4)
    resets = [event for event in flight.events if "position estimate" in event.message]
    assert [event.kind for event in resets] == [EventKind.NOTED]
    assert "goals moved" in resets[0].message


@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
def test_hold_keeps_its_position_through_resets(autopilot: str) -> None:
    flight = airborne(autopilot)
    flight.command("hold")
    flight.run(3.0)
    point = flight.vehicle.truth.position_ned_m
    number = flight.vehicle.vehicle.faults.begin(RESET)
    for _ in range(40):
        flight.run(0.1)
        assert distance_m(flight, point) < 0.8
    flight.vehicle.vehicle.faults.end(number)
    for _ in range(40):
        flight.run(0.1)
        assert distance_m(flight, point) < 0.8
    assert flight.state.reset_count == 2
    assert flight.state.reset_offset_ned_m == pytest.approx((0.0, 0.0, 0.0), abs=0.3)


@pytest.mark.parametrize("autopilot", ["px4", pytest.param("ardupilot", marks=pytest.mark.slow)])
def test_hard_manoeuvres_are_not_resets(autopilot: str) -> None:
    flight = airborne(autopilot)
    for command in ("goto 20 0 speed=5", "goto 0 0 speed=5", "orbit radius=6 speed=3", "stop"):
        flight.command(command)
        flight.run(5.0)
    assert flight.state.reset_count == 0
    assert flight.state.reset_offset_ned_m == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
def test_invalid_position_without_gps_is_not_used(autopilot: str) -> None:
    """LOCAL_POSITION_NED still comes; the estimator's flags mark it as invalid."""
    flight = airborne(autopilot)
    identifier = flight.command("goto 40 0 speed=1")
    flight.run(2.0)
    flight.vehicle.vehicle.faults.begin("gps_loss")
    assert flight.run_until(lambda: flight.outcome(identifier), 20.0)
    assert_failed(flight.outcome(identifier))
    # a failsafe may be reported before the estimator's flags, which come once a second
    assert flight.run_until(lambda: flight.state.position_valid is False, 1.5)
    assert flight.state.position_fresh(flight.now_ns)
    again = flight.command("goto 10 0")
    flight.run(0.5)
    refused = known(flight.outcome(again))
    assert "estimator" in refused.reason


def test_invalid_estimate_brakes_and_then_ends_command() -> None:
    """With an autopilot that stays in offboard mode."""
    harness = GuidanceHarness(flying())
    pending = engaged(harness)
    harness._inputs = with_state(position_valid=False)
    harness.run(0.5)
    assert not pending.done()
    setpoint = known(harness.outputs[-1].setpoint)
    assert setpoint.velocity_ned_mps == (0.0, 0.0, 0.0)
    reason = harness.outcome(pending).reason
    assert "attitude lost" in reason
    assert "estimator" in reason


def positions_of_car(autopilot: str, command: str, fault: str = "") -> list[tuple[int, float, float]]:
    """(id, north, east) of the object ten times a second, from the moment of a fault."""
    place = ScenePose(18.0, 1.0, 0.3)
    scene = [SceneObject("car", (4.2, 1.8, 1.5), lambda _: place)]
    camera = CameraModel.from_horizontal_fov(640, 480, math.radians(80.0))
    mount = CameraMount(pitch_rad=math.radians(-15.0))
    detector = SyntheticDetector(scene, camera, mount, seed=5)
    seen = SyntheticCamera(camera_settings(camera, mount, {}), detect=detector)
    vehicle = in_the_air(seed=4, autopilot=autopilot, noise=0.0)  # two flights are compared
    flight = LockstepFlight.of_vehicle(vehicle, camera=seen)
    flight.run(1.0)
    identifier = flight.command(command)
    flight.run(2.5)
    if fault:
        flight.vehicle.vehicle.faults.begin(fault)
    found = []
    for _ in range(60):
        flight.run(0.1)
        located = [
            (math.dist(each.position_ned_m[:2], (18.0, 1.0)), each.object_id, each.position_ned_m)
            for each in seen.perceived.objects.objects
            if each.confirmed and each.position_ned_m is not None
        ]
        _, object_id, (north, east, _) = min(located)
        found.append((object_id, north, east))
    assert flight.state.reset_count == (1 if fault else 0)
    outcome = flight.outcome(identifier)
    assert outcome is None or outcome.success
    return found


@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
@pytest.mark.parametrize("command", ["approach car distance=5", "orbit car radius=6"])
def test_object_stays_where_it_is_through_a_reset(autopilot: str, command: str) -> None:
    """Local NED is that of the first connection, so the table of objects has nothing to shift."""
    still = positions_of_car(autopilot, command)
    reset = positions_of_car(autopilot, command, "ekf_reset 5 3 0")
    assert [each[0] for each in still] == [each[0] for each in reset]
    apart = [math.dist(one[1:], other[1:]) for one, other in zip(still, reset, strict=True)]
    assert max(apart) < 0.5  # the estimate was reset by 5.8 m


def test_object_is_the_same_one_when_the_height_is_reset() -> None:
    """Ranges by the ground change with the height: 1 m of height is 3 m at this angle."""
    found = positions_of_car("px4", "approach car distance=5", RESET)
    assert {each[0] for each in found} == {found[0][0]}
    assert math.dist(found[-1][1:], (18.0, 1.0)) < 1.5
