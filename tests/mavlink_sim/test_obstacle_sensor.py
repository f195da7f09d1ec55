"""The range sensors in a scene, and collision prevention with them."""

from __future__ import annotations

import math
from typing import Any

import pytest

from mavlink_sim.camera.scene import Path, Scene
from mavlink_sim.flight.collision_prevention import UNKNOWN_CM
from mavlink_sim.flight.transmitter import Sticks
from mavlink_sim.lockstep import LockstepVehicle
from mavlink_sim.physics.obstacle_sensor import NOISE_M, NOTHING_CM
from mavlink_sim.testing import QUICK_FLIGHT
from mavlink_sim.wire.streams import GCS_RATES_HZ, ONBOARD_RATES_HZ
from mavlink_sim.world.world import World, WorldObject
from tests.mavlink_sim.conftest import CALIBRATION

OBSTACLE_DISTANCE = 330
REQUEST_MESSAGE, SET_MESSAGE_INTERVAL, GET_MESSAGE_INTERVAL = 512, 511, 510
WALL = WorldObject(2, "wall", (6.0, 0.0, 0.0), math.pi, size_m=(20.0, 0.3, 6.0))
FACE_M = 6.0 - 0.15
BLOCK = WorldObject(5, "box", (0.0, 3.0, 0.0), size_m=(2.0, 2.0, 1.5))
LINKS = {"onboard": dict.fromkeys(ONBOARD_RATES_HZ, 0.0), "gcs": GCS_RATES_HZ}


def flying(*objects: WorldObject, height_m: float = 3.0, **options: Any) -> LockstepVehicle:
    calm = {"scene": World(objects), "gusts_mps": 0.0, "noise": False, "obstacle_sensor": True}
    quick = {"ready_after_s": 0.0, "parameters": QUICK_FLIGHT}
    vehicle = LockstepVehicle(LINKS, **{**calm, **quick, **options})
    vehicle.take_off(height_m)
    return vehicle


def piloted(*objects: WorldObject, scene: Scene | None = None, **parameters: float) -> LockstepVehicle:
    """In Position mode, its pilot at the sticks."""
    vehicle = flying(
        scene=World(objects) if scene is None else scene,
        parameters={**QUICK_FLIGHT, **CALIBRATION, "COM_RC_IN_MODE": 0, "CP_GUIDE_ANG": 0, **parameters},
    )
    vehicle.vehicle.transmitter.on = True
    vehicle.step(0.5)
    vehicle.set_mode("POSCTL")
    return vehicle


def sensed(vehicle: LockstepVehicle) -> list[int]:
    """Sector by sector, as the vehicle's map has it."""
    distances: list[int] = vehicle.vehicle.autopilot.navigator.obstacles.distances_cm
    return distances


def test_sensor_measures_wall_ahead_only() -> None:
    found = sensed(flying(WALL))
    assert found[0] == pytest.approx(100 * FACE_M, abs=3)
    for sector in (-8, -4, 4, 8):  # the nearest point of each sector is at its edge
        angle = math.radians(5.0 * abs(sector) - 2.5)
        assert found[sector] == pytest.approx(100 * FACE_M / math.cos(angle), abs=12)
    assert found[36] == found[18] == NOTHING_CM


def test_sectors_follow_heading_and_height() -> None:
    vehicle = flying(WALL)
    vehicle.vehicle.airframe.yaw_rad = math.pi / 2
    vehicle.step(0.2)
    found = sensed(vehicle)
    assert found[54] == pytest.approx(100 * FACE_M, abs=20)  # to the left of who looks east
    assert found[18] == NOTHING_CM
    assert min(sensed(flying(WALL, height_m=8.0))) == NOTHING_CM  # over its top


def test_a_thin_pole_is_not_missed_between_two_beams() -> None:
    pole = WorldObject(0, "pole", (11.0 * math.cos(0.04), 11.0 * math.sin(0.04), 0.0), appearance=2)
    found = sensed(flying(pole, height_m=2.5))
    assert found[0] == pytest.approx(1095, abs=15)
    assert sum(value < NOTHING_CM for value in found) <= 2


def test_its_noise_comes_from_the_seed() -> None:
    once, again, other = (sensed(flying(WALL, noise=True, seed=seed)) for seed in (3, 3, 4))
    assert once == again != other
    wall = flying(WALL, noise=True, seed=3)
    ahead = []
    for _ in range(40):
        wall.step(0.1)
        ahead.append(sensed(wall)[0] + 100 * wall.truth.position_ned_m[0])
    spread = max(ahead) - min(ahead)
    assert 100 * NOISE_M < spread < 100 * 8 * NOISE_M


def test_without_sensor_map_empty_without_scene_refused() -> None:
    vehicle = flying(WALL, obstacle_sensor=False)
    assert set(sensed(vehicle)) == {UNKNOWN_CM}
    with pytest.raises(ValueError, match=r"sensor=True .*scene"):
        LockstepVehicle(obstacle_sensor=True)
    with pytest.raises(ValueError, match=r"ArduPilot .*--obstacle-sensor"):
        LockstepVehicle(obstacle_sensor=True, scene=World((WALL,)), autopilot="ardupilot")


def test_it_measures_on_after_a_reboot() -> None:
    vehicle = LockstepVehicle(LINKS, scene=World((WALL,)), noise=False, obstacle_sensor=True)
    vehicle.step(1.0)
    vehicle.vehicle.reboot()
    assert set(sensed(vehicle)) == {UNKNOWN_CM}
    vehicle.step(0.2)
    assert sensed(vehicle)[0] == pytest.approx(100 * FACE_M, abs=2)


def test_a_pilot_at_full_stick_stops_before_the_wall() -> None:
    vehicle = piloted(WALL, CP_DIST=1.5)
    vehicle.vehicle.transmitter.sticks = Sticks(pitch=1.0)
    vehicle.step(12.0)
    truth = vehicle.truth
    assert truth.mode == "POSCTL"
    assert truth.collisions == 0
    assert 1.2 < FACE_M - truth.position_ned_m[0] < 2.6
    assert math.hypot(*truth.velocity_ned_mps) < 0.2


def test_without_collision_prevention_same_stick_ends_at_wall() -> None:
    vehicle = piloted(WALL, CP_DIST=-1.0)
    vehicle.vehicle.transmitter.sticks = Sticks(pitch=1.0)
    vehicle.step(6.0)
    assert vehicle.truth.collisions > 0
    assert vehicle.truth.position_ned_m[0] < FACE_M


def test_moving_obstacle_pushes_back() -> None:
    path = Path(((14.0, 0.0, 0.0), (2.5, 0.0, 0.0)), 0.8, "once", fixed_yaw_rad=math.pi)
    scene = Scene(World((WorldObject(2, "wall", (14.0, 0.0, 0.0), math.pi, size_m=(20, 0.3, 6)),)), {2: path})
    vehicle = piloted(scene=scene, CP_DIST=2.0)
    vehicle.vehicle.transmitter.sticks = Sticks(pitch=0.3)
    vehicle.step(16.0)
    assert vehicle.truth.collisions == 0
    assert 2.2 - vehicle.truth.position_ned_m[0] > 1.0


def test_fused_map_streams_during_collision_prevention() -> None:
    vehicle = piloted(WALL, CP_DIST=1.5)
    vehicle.receive("gcs"), vehicle.receive("onboard")
    vehicle.step(5.0)
    reported = [one for one in vehicle.receive("gcs") if one.get_type() == "OBSTACLE_DISTANCE"]
    assert len(reported) == 5
    newest = reported[-1]
    assert newest.distances[0] == pytest.approx(100 * FACE_M, abs=30)
    assert (newest.min_distance, newest.max_distance) == (20, 1200)
    assert (newest.increment, newest.increment_f, newest.angle_offset, newest.frame) == (0, 5.0, 0.0, 12)
    assert vehicle.now_s - newest.time_usec / 1e6 < 1.2
    assert "OBSTACLE_DISTANCE" not in {one.get_type() for one in vehicle.receive("onboard")}
    vehicle.set_mode("HOLD")
    vehicle.receive("gcs")
    vehicle.step(3.0)
    assert "OBSTACLE_DISTANCE" not in {one.get_type() for one in vehicle.receive("gcs")}


def test_companion_may_request_the_map() -> None:
    vehicle = piloted(WALL, CP_DIST=1.5)
    assert vehicle.command(REQUEST_MESSAGE, OBSTACLE_DISTANCE) == "ACCEPTED"
    assert vehicle.newest["onboard"]["OBSTACLE_DISTANCE"].distances[36] == NOTHING_CM
    assert vehicle.command(SET_MESSAGE_INTERVAL, OBSTACLE_DISTANCE, 100_000) == "ACCEPTED"
    vehicle.receive()
    vehicle.step(4.0)
    reported = [one for one in vehicle.receive() if one.get_type() == "OBSTACLE_DISTANCE"]
    assert len(reported) == pytest.approx(39, abs=1)  # 9.85 Hz
    vehicle.set_mode("HOLD")
    vehicle.step(0.1)
    assert vehicle.command(REQUEST_MESSAGE, OBSTACLE_DISTANCE) == "DENIED"  # PX4 publishes none now


def range_below(vehicle: LockstepVehicle) -> float:
    assert vehicle.command(REQUEST_MESSAGE, 132) == "ACCEPTED"
    return float(vehicle.newest["onboard"]["DISTANCE_SENSOR"].current_distance) / 100.0


def test_range_below_is_to_nearest_surface() -> None:
    vehicle = flying(BLOCK, obstacle_sensor=False)
    height = vehicle.truth.height_m
    assert range_below(vehicle) == pytest.approx(height, abs=0.02)
    airframe = vehicle.vehicle.airframe
    airframe.position = (0.0, 3.0, airframe.position[2])
    assert range_below(vehicle) == pytest.approx(height - 1.5, abs=0.05)
    tree = flying(WorldObject(0, "tree", (0.0, 3.0, 0.0), appearance=0), obstacle_sensor=False, height_m=8.0)
    tree.vehicle.airframe.position = (0.0, 3.0, -8.0)
    assert 1.5 < range_below(tree) < 5.0


def test_range_below_is_zero_on_roof() -> None:
    vehicle = LockstepVehicle(LINKS, scene=World((BLOCK,)), gusts_mps=0.0, noise=False)
    airframe = vehicle.vehicle.airframe
    airframe.on_ground, airframe.position = False, (0.0, 3.0, -1.52)
    vehicle.step(1.0)
    assert airframe.on_ground
    assert range_below(vehicle) == 0.0


def test_tilted_vehicle_measures_past_the_edge() -> None:
    vehicle = flying(BLOCK, obstacle_sensor=False)
    airframe = vehicle.vehicle.airframe
    airframe.position = (0.0, 2.2, -3.0)
    airframe.set_attitude(0.0, 0.0, 0.0)
    around = vehicle.vehicle.collision_world
    assert around is not None
    assert around.range_below_m() == pytest.approx(1.5, abs=0.01)
    airframe.set_attitude(0.4, 0.0, 0.0)  # the right side down: its belly looks to the left
    assert around.range_below_m() == math.inf
