"""Collisions of a vehicle with the objects of a scene."""

from __future__ import annotations

import math
from pathlib import Path as FilePath
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mavlink_sim.camera.scene import Path, Scene
from mavlink_sim.cli.main import main
from mavlink_sim.lockstep import LockstepVehicle
from mavlink_sim.physics.airframe import Multirotor
from mavlink_sim.physics.contact import (
    CRASH_MPS,
    HALF_HEIGHT_M,
    INERTIA_XY_KGM2,
    INERTIA_Z_KGM2,
    RADIUS_M,
    Collision,
    after_contact,
)
from mavlink_sim.physics.rotations import rotation_matrix
from mavlink_sim.realtime.options import SimulationOptions
from mavlink_sim.realtime.simulation import Simulation
from mavlink_sim.testing import free_udp_ports
from mavlink_sim.vehicles.collision_world import CollidingMultirotor
from mavlink_sim.vehicles.vehicle import STEP_S
from mavlink_sim.wire.setpoints import position_setpoint, velocity_setpoint
from mavlink_sim.world.fiducials import Print
from mavlink_sim.world.obstacles import Obstacles
from mavlink_sim.world.world import World, WorldObject

WALL = WorldObject(2, "wall", (8.0, 0.0, 0.0), math.pi, size_m=(8.0, 0.3, 5.0))
BLOCK = WorldObject(5, "box", (4.0, 0.0, 0.0), size_m=(2.0, 2.0, 1.5))
FACE_M = 8.0 - 0.18  # the coping stands out a little


def flying(*objects: WorldObject, height_m: float = 2.0, **options: Any) -> LockstepVehicle:
    vehicle = LockstepVehicle(
        {"onboard": {}}, **{"scene": World(objects), "gusts_mps": 0.0, "noise": 0.0, **options}
    )
    vehicle.take_off(height_m)
    return vehicle


def steer(vehicle: LockstepVehicle, setpoint: Any, seconds: float) -> None:
    repeated = vehicle.repeat(setpoint, 20.0)
    vehicle.step(0.1)
    if vehicle.truth.mode != "OFFBOARD" and vehicle.truth.armed:
        vehicle.set_mode("OFFBOARD")
    vehicle.step(seconds)
    repeated.stop()


def airframe(
    *objects: WorldObject, paths: dict[int, Path] | None = None, start: tuple[float, float] = (0.0, 0.0)
) -> tuple[CollidingMultirotor, list[float]]:
    """An airframe among obstacles, without a vehicle, and the scene's clock."""
    clock = [0.0]
    obstacles = Obstacles(objects, paths or {}, RADIUS_M, HALF_HEIGHT_M)
    return CollidingMultirotor(0, 0.0, obstacles, start, lambda: clock[0]), clock


def throw(body: Multirotor, position: tuple[float, float, float], speed: tuple[float, float, float]) -> None:
    body.on_ground = False
    body.position, body.velocity = position, speed


def let_pass(body: Multirotor, clock: list[float], seconds: float) -> None:
    for _ in range(round(seconds / STEP_S)):
        clock[0] += STEP_S
        body.advance(STEP_S)


def test_several_steps_search_obstacles_after_each() -> None:
    (one, _), (other, _) = airframe(WALL), airframe(WALL)
    for body in (one, other):
        throw(body, (FACE_M - RADIUS_M - 0.02, 0.0, -2.0), (3.0, 0.0, 0.0))
    one.advance(STEP_S, 10)
    for _ in range(10):
        other.advance(STEP_S)
    assert one.collisions == other.collisions == 1
    assert (one.position, one.velocity) == (other.position, other.velocity)


def test_a_wall_stops_a_vehicle_and_leaves_it_flying() -> None:
    vehicle = flying(WALL)
    steer(vehicle, velocity_setpoint(2.0, 0.0, 0.0), 8.0)
    truth = vehicle.truth
    assert truth.position_ned_m[0] == pytest.approx(FACE_M - RADIUS_M, abs=0.05)
    assert not truth.crashed
    assert truth.armed
    assert truth.collisions == 1
    assert isinstance(truth.collision, Collision)
    assert (truth.collision.name, truth.collision.identifier) == ("wall-2", 2)
    assert 1.0 < truth.collision.speed_mps < 2.2
    assert vehicle.events[-1] == f"hit wall-2 at {truth.collision.speed_mps:.1f} m/s"
    steer(vehicle, velocity_setpoint(-2.0, 0.0, 0.0), 7.0)  # and it can leave
    assert vehicle.truth.position_ned_m[0] < 4.0


def test_without_scene_flight_is_bit_equal() -> None:
    plain = flying(scene=None, seed=4, gusts_mps=None)
    among = flying(WorldObject(0, "wall", (500.0, 0.0, 0.0)), seed=4, gusts_mps=None)
    assert type(plain.vehicle.airframe) is Multirotor
    assert plain.vehicle.collision_world is None
    for vehicle in (plain, among):
        steer(vehicle, velocity_setpoint(2.0, 1.0, 0.0), 5.0)
        vehicle.land()
    assert plain.truth == among.truth
    assert plain.events == among.events


def test_the_same_seed_gives_the_same_collisions() -> None:
    truths = []
    for _ in range(2):
        vehicle = flying(WALL, seed=9, gusts_mps=0.8, wind_mps=2.0)
        steer(vehicle, velocity_setpoint(3.0, 0.0, 0.0), 5.0)
        truths.append((vehicle.truth, vehicle.events))
    assert truths[0] == truths[1]
    assert truths[0][0].collisions > 0


def test_too_fast_it_breaks_and_falls() -> None:
    vehicle = flying(WALL, height_m=3.0)
    steer(vehicle, velocity_setpoint(9.0, 0.0, 0.0), 4.0)
    crash = next(event for event in vehicle.events if event.startswith("crashed into"))
    assert crash.split()[2] == "wall-2"
    assert float(crash.split()[-2]) > CRASH_MPS
    truth = vehicle.truth
    assert truth.crashed
    assert truth.on_ground
    assert truth.position_ned_m[0] < FACE_M - RADIUS_M + 0.05
    assert truth.collision is not None
    assert truth.collision.crashed


def test_a_bounce_takes_speed_and_friction_slows_along_the_wall() -> None:
    body, clock = airframe(WALL)
    throw(body, (FACE_M - RADIUS_M - 0.05, 0.0, -2.0), (3.0, 2.0, 0.0))
    let_pass(body, clock, 0.05)
    north, east, _ = body.velocity
    assert -1.0 < north < -0.5  # a quarter of it
    assert 0.5 < east < 1.5
    assert body.collisions == 1


LEVEL = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


def test_sliding_contact_rotates_vehicle() -> None:
    """A wall to the north, the nose north: going east its nose is held back, so that it turns west."""
    into, velocity, rates = after_contact((3.0, 2.0, 0.0), (0.0, 0.0, 0.0), LEVEL, (-1.0, 0.0, 0.0))
    assert into == pytest.approx(3.0)
    # Friction stops the touching point: by a quarter it slows the middle, by the rest it turns.
    assert velocity == pytest.approx((-0.75, 1.5, 0.0))
    assert rates == pytest.approx((0.0, 0.0, -0.5 * RADIUS_M / INERTIA_Z_KGM2))
    # Faster along it friction is at its limit: 0.3 of the push of 3.75 Ns.
    _, velocity, rates = after_contact((3.0, 0.0, 8.0), (0.0, 0.0, 0.0), LEVEL, (-1.0, 0.0, 0.0))
    assert velocity == pytest.approx((-0.75, 0.0, 8.0 - 1.125))
    assert rates == pytest.approx((0.0, 1.125 * RADIUS_M / INERTIA_XY_KGM2, 0.0))  # nose up
    # Turned away by what it looks like from the body: the nose east, the wall on its left.
    east = (0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    _, velocity, rates = after_contact((3.0, 2.0, 0.0), (0.0, 0.0, 0.0), east, (-1.0, 0.0, 0.0))
    assert velocity == pytest.approx((-0.75, 1.5, 0.0))
    assert rates == pytest.approx((0.0, 0.0, -0.5 * RADIUS_M / INERTIA_Z_KGM2))


def test_scraping_a_wall_yaws_vehicle() -> None:
    for east_mps in (-2.0, 2.0):
        body, clock = airframe(WALL)
        throw(body, (FACE_M - RADIUS_M - 0.05, 0.0, -2.0), (3.0, east_mps, 0.0))
        let_pass(body, clock, 0.05)
        assert body.collisions == 1
        assert body.rates[2] * east_mps < -1.0


def test_vehicle_recovers_from_wall_contact() -> None:
    vehicle = flying(WALL)
    steer(vehicle, velocity_setpoint(2.0, 0.6, 0.0), 6.0)
    assert vehicle.truth.collisions >= 1
    steer(vehicle, position_setpoint(0.0, 0.0, -2.0), 8.0)
    truth = vehicle.truth
    assert not truth.crashed
    assert math.dist(truth.position_ned_m, (0.0, 0.0, -2.0)) < 0.6
    assert max(abs(truth.roll_rad), abs(truth.pitch_rad)) < 0.2


unit = st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-1, 1)).filter(lambda v: math.hypot(*v) > 0.1)
triple = st.tuples(st.floats(-8, 8), st.floats(-8, 8), st.floats(-8, 8))


@given(triple, triple, unit, st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: math.hypot(*q) > 0.1))
def test_contact_adds_no_energy_and_no_penetration(
    velocity: Any, rates: Any, normal: Any, quaternion: Any
) -> None:
    normal = tuple(value / math.hypot(*normal) for value in normal)
    w, x, y, z = (value / math.hypot(*quaternion) for value in quaternion)
    matrix = rotation_matrix((w, x, y, z))

    def energy(velocity: Any, rates: Any) -> float:
        turning = zip(rates, (INERTIA_XY_KGM2, INERTIA_XY_KGM2, INERTIA_Z_KGM2), strict=True)
        total: float = sum(v * v for v in velocity) / 2 + sum(i * r * r for r, i in turning) / 2
        return total

    into, after, turned_rates = after_contact(velocity, rates, matrix, normal)
    if into < 0.0:
        assert (after, turned_rates) == (velocity, rates)
        return
    assert energy(after, turned_rates) <= energy(velocity, rates) + 1e-9
    # Friction may turn what bounced a little back in, by far less than what it came with.
    again, _, _ = after_contact(after, turned_rates, matrix, normal)
    assert again <= 0.5 * into + 1e-9


@settings(max_examples=25, deadline=None)
@given(
    st.floats(-math.pi, math.pi),
    st.floats(0.5, 20.0),
    st.floats(-3.0, 3.0),
    st.floats(-math.pi, math.pi),
    st.tuples(st.floats(-1.2, 1.2), st.floats(-1.2, 1.2)),
)
def test_vehicle_cannot_leave_walled_yard(
    heading: float, speed: float, climb: float, yaw: float, start: tuple[float, float]
) -> None:
    sides = [
        WorldObject(
            index, "box", (2.0 * math.cos(angle), 2.0 * math.sin(angle), 0.0), angle, size_m=(0.2, 6.0, 40.0)
        )
        for index, angle in enumerate(yaw + side * math.pi / 2 for side in range(4))
    ]
    body, clock = airframe(*sides)
    throw(body, (*start, -5.0), (speed * math.cos(heading), speed * math.sin(heading), climb))
    body.thrust_mps2 = 0.0
    for _ in range(300):
        let_pass(body, clock, STEP_S)
        # push on, whatever was taken
        vx, vy, vz = body.velocity
        body.velocity = (vx + 0.1 * math.cos(heading), vy + 0.1 * math.sin(heading), vz)
        north, east, _ = body.position
        along = max(
            abs(north * math.cos(yaw) + east * math.sin(yaw)),
            abs(east * math.cos(yaw) - north * math.sin(yaw)),
        )
        assert along < 2.0 - 0.1 - RADIUS_M + 0.1
    assert body.collisions >= 1 or speed < 3.0


def test_it_lands_on_a_roof_stands_and_takes_off_again() -> None:
    vehicle = flying(BLOCK, height_m=4.0)
    steer(vehicle, position_setpoint(4.0, 0.0, -4.0), 7.0)
    vehicle.land()
    truth = vehicle.truth
    landing = vehicle.events.index("touched down on box-5")
    assert vehicle.events[landing + 1 : landing + 3] == ["landed", "disarmed (after landing)"]
    events_text = len(vehicle.events)
    assert truth.on_ground
    assert truth.landed
    assert truth.position_ned_m[2] == pytest.approx(-1.5, abs=1e-6)
    vehicle.step(20.0)
    assert vehicle.truth.position_ned_m == truth.position_ned_m
    assert len(vehicle.events) == events_text
    vehicle.set_mode("HOLD")
    vehicle.take_off(4.0)
    assert vehicle.events[-4:] == ["armed", "mode TAKEOFF", "takeoff", "mode HOLD"]
    assert vehicle.truth.position_ned_m[2] < -3.0
    steer(vehicle, position_setpoint(0.0, 4.0, -4.0), 7.0)
    vehicle.land()
    assert vehicle.truth.position_ned_m[2] == 0.0
    assert vehicle.truth.collisions == 1


def test_a_roof_breaks_it_as_the_ground_does() -> None:
    body, clock = airframe(BLOCK)
    throw(body, (4.0, 0.0, -6.0), (0.0, 0.0, 0.0))
    let_pass(body, clock, 4.0)  # its motors stand still
    assert body.crashed
    assert body.on_ground
    assert body.position[2] == pytest.approx(-1.5, abs=1e-6)
    assert body.last_collision is not None
    events: list[Collision] = []
    body, clock = airframe(BLOCK)
    body.on_collision = events.append
    throw(body, (4.0, 0.0, -1.5 - 0.5), (0.0, 0.0, 0.0))
    let_pass(body, clock, 3.0)
    assert not body.crashed
    assert str(events[0]).startswith("hit box-5 at 2.")  # a hard landing
    assert events[0].standing


def test_falls_over_roof_edge() -> None:
    body, clock = airframe(BLOCK)
    throw(body, (4.0, 0.0, -1.5), (0.0, 0.0, 0.2))
    let_pass(body, clock, 0.5)
    assert body.on_ground
    body.velocity = (0.0, 6.0, 0.0)
    let_pass(body, clock, 4.0)
    assert body.position[1] > 1.0
    assert body.position[2] == 0.0
    assert body.floor_down_m == 0.0


def test_moving_obstacle_pushes_and_hits() -> None:
    path = Path(((10.0, 0.0, 0.0), (-5.0, 0.0, 0.0)), 3.0, "once", fixed_yaw_rad=0.0)
    body, clock = airframe(WorldObject(1, "box", (10.0, 0.0, 0.0), size_m=(1, 2, 2)), paths={1: path})
    events: list[Collision] = []
    body.on_collision = events.append
    let_pass(body, clock, 2.9)
    assert body.position == (0.0, 0.0, 0.0)
    assert not events
    let_pass(body, clock, 3.0)
    assert body.position[0] < -5.0
    assert events[0].speed_mps == pytest.approx(3.0, abs=0.01)
    assert not body.crashed


def test_rides_on_moving_support() -> None:
    path = Path(((4.0, 0.0, 0.0), (4.0, 9.0, 0.0)), 1.5, "once", fixed_yaw_rad=0.0)
    body, clock = airframe(BLOCK, paths={5: path})
    throw(body, (4.0, 0.0, -1.55), (0.0, 0.0, 0.0))
    let_pass(body, clock, 4.0)
    assert body.on_ground
    _, box_east, _ = path.pose_at(clock[0])[0]
    assert body.position[1] == pytest.approx(box_east, abs=0.4)  # it slid until it had the speed
    assert body.velocity[1] == pytest.approx(1.5, abs=0.01)


def test_obstacles_respect_start_offset() -> None:
    body, clock = airframe(WALL, start=(5.0, 0.0))
    throw(body, (0.0, 0.0, -4.0), (5.0, 0.0, 0.0))
    let_pass(body, clock, 0.8)
    assert body.collisions == 1
    assert body.position[0] < FACE_M - 5.0 - RADIUS_M + 0.01


def test_start_inside_obstacle_refused() -> None:
    with pytest.raises(ValueError, match=r"north 4 m, east 0 m.*box-5"):
        LockstepVehicle(scene=World((BLOCK,)), start_ned_m=(4.0, 0.0))
    flat = WorldObject(0, "plate", (0.0, 0.0, 0.0), printed=Print("4X4_50", 1, 1.0))
    assert LockstepVehicle(scene=World((flat,))).truth.collisions == 0


def test_fleet_start_inside_obstacle_is_one_line(
    tmp_path: FilePath, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = tmp_path / "block.toml"
    scene.write_text('[[objects]]\nclass = "box"\nplace_m = [0, 5]\n', "utf-8")
    words = ["--scene", str(scene), "--vehicles", "2", "--onboard-bind", "0", "--gcs-bind", "0"]
    monkeypatch.setattr("sys.argv", ["mavlink-sim", *words])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "box-0" in line
    assert "north 0 m, east 5 m" in line


@pytest.mark.parametrize("name", ["village", "marker_landing", "obstacle_course"])
def test_the_examples_can_be_flown_in(name: str) -> None:
    vehicle = flying(scene=name, height_m=5.0)
    vehicle.step(5.0)
    assert vehicle.truth.collisions == 0
    assert not vehicle.truth.crashed


def free_ports() -> dict[str, Any]:
    onboard_port, gcs_port = free_udp_ports(2)
    return {"onboard_port": onboard_port, "onboard_bind": 0, "gcs_port": gcs_port, "gcs_bind": 0}


def test_simulation_scene_collides_and_truth_has_it(tmp_path: FilePath) -> None:
    scene = tmp_path / "block.toml"
    scene.write_text('[[objects]]\nclass = "box"\nplace_m = [4, 0]\nsize_m = [2, 2, 1.5]\n', "utf-8")
    events: list[str] = []
    options = SimulationOptions(**free_ports(), scene=str(scene), start_ned_m=(1.0, 0.0))
    with Simulation(options, events.append) as simulation:
        truth = simulation.truth()
        assert (truth["crashed"], truth["collisions"], truth["last_collision"]) == (False, 0, None)
        throw(simulation.vehicle.airframe, (1.0, 0.0, -0.8), (3.0, 0.0, 0.0))
        simulation.vehicle.step(0.4)
        truth = simulation.truth()
    assert truth["collisions"] == 1
    assert truth["last_collision"]["object"] == "box-0"
    assert truth["last_collision"]["identifier"] == 0
    assert truth["last_collision"]["speed_mps"] == pytest.approx(2.5, abs=0.5)
    assert not truth["last_collision"]["crashed"]
    assert truth["objects"][0]["range_m"] == pytest.approx(RADIUS_M, abs=0.25)
    assert any(event.startswith("hit box-0 at ") for event in events)


def test_demo_world_has_no_obstacles(tmp_path: FilePath) -> None:
    options = SimulationOptions(**free_ports(), truth=tmp_path / "truth.jsonl")
    with Simulation(options, lambda text: None) as simulation:
        assert simulation.truth()["objects"]
        assert simulation.vehicle.collision_world is None


def test_scene_object_accepted() -> None:
    scene = Scene(World((WALL,)))
    for form in (scene, scene.world, "obstacle_course"):
        vehicle = LockstepVehicle(scene=form)
        assert vehicle.vehicle.collision_world is not None
