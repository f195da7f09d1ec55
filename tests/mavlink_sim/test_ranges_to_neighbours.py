"""The range sensors of one vehicle with the others of its fleet world."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from mavlink_sim import FleetWorld, LockstepVehicle
from mavlink_sim.flight.transmitter import Sticks
from mavlink_sim.physics.airframe import Multirotor
from mavlink_sim.physics.contact import HALF_HEIGHT_M, RADIUS_M
from mavlink_sim.physics.midair import Body, Neighbours
from mavlink_sim.physics.obstacle_sensor import MAXIMUM_M, NOTHING_CM
from mavlink_sim.physics.rotations import Vector
from mavlink_sim.vehicles.vehicle import STEP_S
from mavlink_sim.world.world import World
from tests.mavlink_sim.conftest import CALIBRATION

REQUEST_MESSAGE, DISTANCE_SENSOR = 512, 132

positions = st.tuples(*[st.floats(-4.0, 4.0)] * 3)
angles = st.floats(-1.0, 1.0)


def body(number: int, position: Vector, start: tuple[float, float] = (0.0, 0.0)) -> Body:
    airframe = Multirotor()
    airframe.on_ground = False
    airframe.position = position
    return Body(airframe, start, number, f"vehicle {number}", lambda: 0.0)


def inside(point: Vector, middle: Vector) -> float:
    """Less than 1 in the ellipsoid around `middle`."""
    x, y, z = (a - b for a, b in zip(point, middle, strict=True))
    return (x * x + y * y) / RADIUS_M**2 + z * z / HALF_HEIGHT_M**2


@given(position=positions, roll_rad=angles, pitch_rad=angles)
def test_the_range_below_ends_where_the_first_other_begins(
    position: Vector, roll_rad: float, pitch_rad: float
) -> None:
    own, other = body(1, (0.0, 0.0, -9.0)), body(2, (position[0], position[1], position[2] - 9.0))
    own.airframe.set_attitude(roll_rad, pitch_rad, 0.3)
    middle = position  # from the middle of one's own
    assume(inside((0.0, 0.0, 0.0), middle) > 1.0)
    found = Neighbours([own, other], own).range_below_m()
    if found == 0.0:  # it begins within one's own hull
        return
    _, _, x, _, _, y, _, _, z = own.airframe.matrix
    reach = found + HALF_HEIGHT_M if math.isfinite(found) else 20.0
    before = [inside((x * t, y * t, z * t), middle) for t in (reach * k / 400 for k in range(400))]
    assert min(before[:-1]) >= 1.0 - 1e-6
    if math.isfinite(found):
        assert inside((x * reach, y * reach, z * reach), middle) == pytest.approx(1.0, abs=1e-6)


def test_range_below_to_nearest_other_vehicle() -> None:
    own, near, far = body(1, (0.0, 0.0, -9.0)), body(2, (0.1, 0.0, -6.0)), body(3, (0.0, 0.0, -2.0))
    bodies = [own]
    neighbours = Neighbours(bodies, own)
    assert neighbours.range_below_m() == math.inf
    assert neighbours.outlines(MAXIMUM_M) == []
    bodies += [far, near]  # they join later
    top = HALF_HEIGHT_M * math.sqrt(1.0 - (0.1 / RADIUS_M) ** 2)
    assert neighbours.range_below_m() == pytest.approx(3.0 - top - HALF_HEIGHT_M)


def test_outlines_at_height_respect_start_offsets() -> None:
    own = body(1, (1.0, 2.0, -5.0), start=(10.0, 20.0))
    level = body(2, (4.0, 0.0, -5.05), start=(10.0, 25.0))  # 3 m north, 3 m east, 5 cm higher
    above = body(3, (1.0, 5.0, -5.0 - 1.01 * HALF_HEIGHT_M), start=(10.0, 20.0))
    away = body(4, (1.0, 2.0, -5.0), start=(40.0, 20.0))
    sides = Neighbours([own, level, above, away], own).outlines(MAXIMUM_M)
    radius = RADIUS_M * math.sqrt(1.0 - (0.05 / HALF_HEIGHT_M) ** 2)
    assert len(sides) == 24
    for start, end in sides:
        assert math.dist(start, (3.0, 3.0)) == pytest.approx(radius)
        assert math.dist(start, end) == pytest.approx(2.0 * radius * math.sin(math.pi / 24))


def pair(**options: object) -> tuple[FleetWorld, LockstepVehicle, LockstepVehicle]:
    """Two in one fleet_world, the other 5 m north of the first."""
    calm: dict[str, Any] = {
        "scene": World(()),
        "gusts_mps": 0.0,
        "noise": False,
        "obstacle_sensor": True,
        **options,
    }
    one = LockstepVehicle(system_id=1, **calm)
    other = LockstepVehicle(system_id=2, start_ned_m=(5.0, 0.0), gusts_mps=0.0, noise=False)
    fleet_world = FleetWorld(2)
    for vehicle in (one, other):
        fleet_world.join(vehicle.vehicle)
    return fleet_world, one, other


def around(vehicle: LockstepVehicle) -> list[int]:
    return list(vehicle.vehicle.autopilot.navigator.obstacles.distances_cm)


def beside(one: LockstepVehicle, other: LockstepVehicle) -> None:
    """Put them at one height, the other 5 m ahead of the first."""
    one.vehicle.airframe.yaw_rad = 0.0
    north, east, down = one.vehicle.airframe.position
    other.vehicle.airframe.position = (north, east, down)  # from its own start


def below_m(vehicle: LockstepVehicle) -> float:
    """The value of its DISTANCE_SENSOR."""
    assert vehicle.command(REQUEST_MESSAGE, DISTANCE_SENSOR) == "ACCEPTED"
    return float(vehicle.newest["onboard"]["DISTANCE_SENSOR"].current_distance) / 100.0


def test_sensor_measures_vehicle_ahead_not_above() -> None:
    _, one, other = pair()
    for vehicle in (one, other):
        vehicle.take_off(3.0)
        vehicle.step(3.0)  # level again, where the take-off ended
    beside(one, other)
    one.step(0.2)
    found = around(one)
    assert found[0] == pytest.approx(100 * (5.0 - RADIUS_M), abs=3)
    assert sum(value < NOTHING_CM for value in found) <= 3
    other.vehicle.airframe.position = (0.0, 0.0, -4.0)
    one.step(0.2)
    assert set(around(one)) == {NOTHING_CM}


def test_range_below_over_another_vehicle() -> None:
    _, one, other = pair(scene=None, obstacle_sensor=False)
    for vehicle, height_m in ((one, 5.0), (other, 3.0)):
        vehicle.take_off(height_m)
    height_m = one.truth.height_m
    assert below_m(one) == pytest.approx(height_m, abs=0.02)
    other.vehicle.airframe.position = (-5.0, 0.0, -3.0)
    one.vehicle.airframe.position = (0.0, 0.0, -5.0)
    assert below_m(one) == pytest.approx(5.0 - 3.0 - 2 * HALF_HEIGHT_M, abs=0.02)
    assert below_m(other) == pytest.approx(3.0, abs=0.02)  # and not what is above it


def test_copy_is_in_no_fleet_world() -> None:
    _, one, other = pair()
    for vehicle in (one, other):
        vehicle.take_off(3.0)
    beside(one, other)
    twin = one.copy()
    for vehicle in (one, twin):
        vehicle.step(0.2)
    assert min(around(one)) < NOTHING_CM
    assert set(around(twin)) == {NOTHING_CM}


def test_a_pilot_at_full_stick_stops_before_another_vehicle() -> None:
    fleet_world, one, other = pair(
        parameters={**CALIBRATION, "COM_RC_IN_MODE": 0, "CP_GUIDE_ANG": 0, "CP_DIST": 1.5}
    )
    for vehicle in (one, other):
        vehicle.take_off(3.0)
    one.vehicle.transmitter.on = True
    one.step(0.5)
    one.set_mode("POSCTL")
    beside(one, other)
    one.vehicle.transmitter.sticks = Sticks(pitch=1.0)
    for _ in range(3000):
        one.step(STEP_S)
        north, east, _ = other.vehicle.airframe.position
        other.vehicle.airframe.position = (north, east, one.vehicle.airframe.position[2])  # it stays level
        fleet_world.meet()
    assert one.truth.mode == "POSCTL"
    assert one.truth.collisions == other.truth.collisions == 0
    assert 1.2 < 5.0 - RADIUS_M - one.truth.position_ned_m[0] < 2.6  # as before a wall
    assert math.hypot(*one.truth.velocity_ned_mps) < 0.2
