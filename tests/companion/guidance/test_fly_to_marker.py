"""`approach`, `follow` and `orbit` of a printed marker: rendered images, in lockstep through guidance."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from benchmarks.rendered import camera_settings
from companion.bench.lockstep_flight import FlightLog, LockstepFlight
from companion.bench.rendered_camera import RenderedCamera
from companion.guidance.objects.target import UNCONFIRMED_MARKER
from companion.settings import Settings
from companion.vehicle.state import Vector3
from mavlink_sim.camera.scene import CameraSettings, Scene
from mavlink_sim.world.fiducials import Print
from mavlink_sim.world.world import Ground, World, WorldObject
from tests.companion.guidance.guidance_harness import assert_failed, assert_succeeded, in_the_air, known
from vision.camera_model import CameraModel, CameraMount

CAMERA = CameraModel.from_horizontal_fov(480, 360, math.radians(75.0))
MOUNT = CameraMount(forward_m=0.1, pitch_rad=math.radians(-8.0))
SETTINGS = {"detector.enabled": "false", "markers.dictionary": "APRILTAG_36h11", "markers.size_m": "0.8"}
HEIGHT_M, AHEAD_M = 3.0, 8.0
FAR_AWAY = (500.0, 500.0)


@dataclass(frozen=True)
class Motion:
    """Of the marker: (north, east) by the seconds of the flight; it stands and faces south."""

    at: Callable[[float], tuple[float, float]]
    speed_mps: float = 0.0
    period_s: float = 0.0

    def pose_at(self, time_s: float) -> tuple[Vector3, float]:
        return (*self.at(time_s), -2.2), math.pi


def flight_with(
    at: Callable[[float], tuple[float, float]] = lambda _: (AHEAD_M, 1.0),
    *,
    seed: int = 1,
    rate_hz: float = 10.0,
    gimbal: bool = False,
) -> LockstepFlight:
    printed = Print("APRILTAG_36h11", 7, 0.8, standing=True)
    world = World(
        # On grass the detector has many more edges to look at, and takes twice as long.
        (WorldObject(0, "plate", (0.0, 0.0, 0.0), printed=printed),),
        Ground(("concrete",), seed, 256, 0.1),
    )
    mount = replace(MOUNT, pitch_rad=0.0, on_gimbal=True) if gimbal else MOUNT
    scene = Scene(world, {0: Motion(at)}, CameraSettings(model=CAMERA, mount=MOUNT, seed=seed), "marker")
    settings: Settings = camera_settings(CAMERA, mount, SETTINGS)
    vehicle = in_the_air(seed=seed, height_m=HEIGHT_M, wind_mps=1.5, gimbal=gimbal)
    camera = RenderedCamera(settings, scene, vehicle, rate_hz=rate_hz, by_flight=True, depth=False)
    flight = LockstepFlight.of_vehicle(vehicle, camera=camera)
    flight.turn_to(0.0)
    return flight


def reason(log: FlightLog) -> str:
    assert log.outcome is not None
    return log.outcome.reason


@pytest.mark.parametrize("seed", [pytest.param(3, marks=pytest.mark.slow), 8])
def test_approach_stops_before_the_marker(seed: int) -> None:
    flight = flight_with(seed=seed, rate_hz=5.0)
    log = flight.fly("approach marker=7 distance=4", 60.0)
    assert_succeeded(log.outcome, "marker 7")
    north, east, _ = flight.vehicle.truth.position_ned_m
    assert math.hypot(AHEAD_M - north, 1.0 - east) == pytest.approx(4.0, abs=0.35)
    assert not log.violations


def test_follow_keeps_its_distance_to_a_moving_marker() -> None:
    def path(time_s: float) -> tuple[float, float]:
        return 8.0 + 0.8 * time_s, 0.5

    flight = flight_with(path, rate_hz=5.0)
    distances: list[float] = []

    def note() -> None:
        if flight.seconds > 7.0:
            north, east, _ = flight.vehicle.truth.position_ned_m
            goal = path(flight.seconds)
            distances.append(math.hypot(goal[0] - north, goal[1] - east))

    log = flight.fly("follow marker=7 distance=5 duration=11", 30.0, on_tick=note)
    assert_succeeded(log.outcome)
    assert np.percentile(np.abs(np.array(distances) - 5.0), 90) < 0.8
    assert not log.violations


def test_orbit_circles_about_the_marker() -> None:
    flight = flight_with(lambda _: (8.0, 0.0), rate_hz=5.0)
    radii: list[float] = []

    def note() -> None:
        if flight.seconds > 10.0:
            north, east, _ = flight.vehicle.truth.position_ned_m
            radii.append(math.hypot(8.0 - north, east))

    log = flight.fly("orbit marker=7 radius=6 speed=2 laps=0.5", 40.0, on_tick=note)
    assert_succeeded(log.outcome)
    assert np.percentile(np.abs(np.array(radii) - 6.0), 90) < 0.6


def test_policy_flies_to_the_marker() -> None:
    flight = flight_with(lambda _: (10.0, 1.0), rate_hz=5.0)
    log = flight.fly("policy approach marker=7 distance=5", 60.0)
    assert log.outcome is not None
    assert log.outcome.success, log.outcome
    north, east, _ = flight.vehicle.truth.position_ned_m
    assert math.hypot(10.0 - north, 1.0 - east) == pytest.approx(5.0, abs=0.7)
    assert not log.violations


def test_gimbal_is_kept_on_the_marker() -> None:
    flight = flight_with(lambda _: (10.0, 3.0), rate_hz=5.0, gimbal=True)
    flight.run(1.0)
    outcome = known(flight.fly("gimbal marker=7", 12.0).outcome)
    assert outcome.success, outcome
    off_deg: list[float] = []

    def note() -> None:
        north, east, down = np.subtract((10.0, 3.0, -2.2), flight.vehicle.truth.position_ned_m)
        gimbal = known(flight.vehicle.vehicle.gimbal)
        w, x, y, z = gimbal.quaternion
        axis = (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y))
        cosine = np.dot(axis, (north, east, down)) / math.hypot(north, east, down)
        off_deg.append(math.degrees(math.acos(min(1.0, float(cosine)))))

    outcome = known(flight.fly("goto forward=0 right=5", 30.0, on_tick=note).outcome)
    assert outcome.success, outcome
    assert np.percentile(off_deg, 95) < 4.0


def test_marker_that_disappears_ends_the_command() -> None:
    def path(time_s: float) -> tuple[float, float]:
        return (AHEAD_M, 1.0) if time_s < 3.0 else FAR_AWAY

    log = flight_with(path, rate_hz=5.0).fly("approach marker=7 distance=3 lost_timeout=2", 30.0)
    assert_failed(log.outcome)
    assert reason(log).startswith("lost marker 7 for 2.")
    assert "last seen" in reason(log)
    assert log.moments[-1].seconds < 8.0


def test_other_marker_and_one_seen_briefly_are_not_flown_to() -> None:
    other = flight_with(lambda _: (6.0, 0.0), rate_hz=5.0)
    log = other.fly("approach marker=8 lost_timeout=1.5", 20.0)
    assert "never seen" in reason(log)
    assert math.dist(other.vehicle.truth.position_ned_m[:2], (0.0, 0.0)) < 1.0

    def glimpse(time_s: float) -> tuple[float, float]:
        return (6.0, 0.0) if 0.45 < time_s < 0.65 else FAR_AWAY

    log = flight_with(glimpse).fly("approach marker=7 lost_timeout=2", 20.0)
    assert UNCONFIRMED_MARKER in reason(log)
    unseen = flight_with(lambda _: FAR_AWAY, rate_hz=5.0)
    assert "no confirmed marker 7" in reason(unseen.fly("orbit marker=7", 20.0))


def test_marker_needs_detection_with_the_steering_camera() -> None:
    without = LockstepFlight.airborne(seed=1, height_m=HEIGHT_M)
    for command in ("approach marker=7", "follow marker=7", "orbit marker=7"):
        assert_failed(without.fly(command, 5.0).outcome, "(markers.dictionary is not")
