"""Collisions between vehicles of one world."""

from __future__ import annotations

import math
import re
import threading

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mavlink_sim import FleetWorld, LockstepVehicle
from mavlink_sim.physics.airframe import GRAVITY_MPS2, Multirotor
from mavlink_sim.physics.contact import CRASH_MPS, Collision
from mavlink_sim.physics.midair import REACH_UP_M, Body, Midair, apart
from mavlink_sim.physics.rotations import Vector
from mavlink_sim.realtime.fleet import Fleet, instance_options
from mavlink_sim.realtime.options import SimulationOptions
from mavlink_sim.testing import free_port, free_udp_port_range
from mavlink_sim.vehicles.vehicle import STEP_S
from mavlink_sim.wire.messages import dialect

pytestmark = pytest.mark.realtime

speeds = st.floats(-8.0, 8.0, allow_subnormal=False)
velocities = st.tuples(speeds, speeds, speeds)
offsets = st.floats(-0.7, 0.7, allow_subnormal=False)


class World4ms:
    """Airframes stepped together, 4 ms a step."""

    def __init__(self, *airframes: Multirotor) -> None:
        self.airframes = airframes
        self.midair = Midair()
        self.now_s = 0.0
        for number, airframe in enumerate(airframes, start=1):
            self.midair.join(Body(airframe, (0.0, 0.0), number, f"vehicle {number}", lambda: self.now_s))

    def resolve(self) -> None:
        self.midair.resolve(STEP_S)

    def step(self) -> None:
        for airframe in self.airframes:
            airframe.advance(STEP_S)
        self.now_s += STEP_S
        self.resolve()

    def apart(self) -> float:
        return apart(*self.midair.bodies)


def flying(position: Vector, velocity: Vector) -> Multirotor:
    airframe = Multirotor()
    put(airframe, position, velocity)
    return airframe


def put(airframe: Multirotor, position: Vector, velocity: Vector) -> None:
    airframe.on_ground = False
    airframe.position, airframe.velocity = position, velocity


@given(position=st.tuples(offsets, offsets, offsets), one=velocities, other=velocities)
def test_overlapping_bodies_are_separated(position: Vector, one: Vector, other: Vector) -> None:
    first, second = flying((0.0, 0.0, -5.0), one), flying((9.0, 0.0, -5.0), other)
    world = World4ms(first, second)
    put(second, (position[0], position[1], position[2] - 5.0), other)
    touching = world.apart() < 1.0
    world.resolve()
    if not touching:
        assert (first.velocity, second.velocity) == (one, other)
        assert first.collisions == second.collisions == 0
        return
    assert world.apart() >= 1.0 - 1e-9
    # they are of one mass: momentum stays, energy does not grow
    for axis in range(3):
        assert first.velocity[axis] + second.velocity[axis] == pytest.approx(
            one[axis] + other[axis], abs=1e-9
        )
    before, after = (
        sum(v * v for velocity in pair for v in velocity)
        for pair in ((one, other), (first.velocity, second.velocity))
    )
    assert after <= before + 1e-9
    assert first.collisions == second.collisions <= 1


@settings(max_examples=40)
@given(
    positions=st.lists(st.tuples(*[st.floats(-4.0, 4.0)] * 3), min_size=2, max_size=5),
    directions=st.lists(velocities, min_size=5, max_size=5),
    thrusts=st.lists(st.floats(0.0, 20.0), min_size=5, max_size=5),
    tilts=st.lists(st.floats(-1.5, 1.5), min_size=5, max_size=5),
)
def test_no_contact_missed_between_calls(
    positions: list[Vector], directions: list[Vector], thrusts: list[float], tilts: list[float]
) -> None:
    """Distant bodies are not checked, whatever their acceleration, and no contact is missed."""

    def first_meeting(*, always: bool) -> tuple[int, list[int]] | None:
        bodies = [flying((20.0 * number, 0.0, -50.0), (0.0, 0.0, 0.0)) for number in range(len(positions))]
        world = World4ms(*bodies)
        for body, (x, y, z), direction, thrust, tilt in zip(
            bodies, positions, directions, thrusts, tilts, strict=False
        ):
            put(body, (x, y, z - 50.0), direction)
            body.command(thrust, tilt, -tilt, 0.0)
        for step in range(150):
            if always:
                world.midair._free_m = 0.0
            world.step()
            if any(body.collisions for body in bodies):
                return step, [body.collisions for body in bodies]
        return None

    assert first_meeting(always=False) == first_meeting(always=True)


@pytest.mark.parametrize("speed_mps", [2.0, 3.0])
def test_head_on_collision_bounces_or_breaks(speed_mps: float) -> None:
    first = flying((0.0, 0.0, -20.0), (speed_mps, 0.0, 0.0))
    second = flying((0.601, 0.0, -20.0), (-speed_mps, 0.0, 0.0))
    events: list[Collision] = []
    first.on_collision = second.on_collision = events.append
    world = World4ms(first, second)
    for _ in range(50):
        world.step()
        assert world.apart() > 0.99
    breaks = 2.0 * speed_mps > CRASH_MPS
    assert [collision.name for collision in events] == ["vehicle 2", "vehicle 1"]
    assert all(collision.speed_mps == pytest.approx(2.0 * speed_mps, rel=0.02) for collision in events)
    assert [collision.crashed for collision in events] == [breaks] * 2
    assert first.crashed == second.crashed == breaks
    assert first.velocity[0] < 0.0 < second.velocity[0]


def test_vehicle_stands_on_another_until_it_leaves() -> None:
    below, above = Multirotor(), flying((0.1, 0.0, -1.0), (0.0, 0.0, 0.4))
    world = World4ms(below, above)
    above.thrust_mps2 = GRAVITY_MPS2 - 0.4  # its drag at 0.4 m/s does the rest
    above.command(GRAVITY_MPS2 - 0.4, 0.0, 0.0, 0.0)
    while not above.on_ground:
        world.step()
        assert world.apart() > 0.99
        assert world.now_s < 10.0
    above.command(0.0, 0.0, 0.0, 0.0)
    for _ in range(250):
        world.step()
    assert above.on_ground
    assert -above.position[2] == pytest.approx(REACH_UP_M, abs=0.02)
    assert above.acceleration == (0.0, 0.0, 0.0)
    assert (below.position, below.on_ground) == ((0.0, 0.0, 0.0), True)
    touched = above.last_collision
    assert touched is not None
    assert (touched.name, touched.standing, touched.crashed) == ("vehicle 1", True, False)
    assert str(touched).startswith("touched down")
    assert str(below.last_collision) == "hit vehicle 2 at 0.4 m/s"
    below.position = (5.0, 0.0, 0.0)
    for _ in range(250):
        world.step()
    assert (above.on_ground, above.position[2]) == (True, 0.0)  # it fell


def test_falling_vehicle_bounces_off_another() -> None:
    below, above = Multirotor(), flying((0.1, 0.0, -1.0), (0.0, 0.0, 2.0))
    world = World4ms(below, above)
    for _ in range(500):
        world.step()
        assert world.apart() > 0.99
        assert below.position[2] == 0.0
        assert above.position[2] <= 0.0
    assert below.on_ground
    assert above.last_collision is not None
    assert above.last_collision.speed_mps > 2.0


def test_sliding_vehicles_stop_each_other() -> None:
    first, second = Multirotor(), Multirotor()
    second.position = (1.0, 0.0, 0.0)
    world = World4ms(first, second)
    first.velocity = (3.5, 0.0, 0.0)
    for _ in range(250):
        world.step()
        assert world.apart() > 0.99
    assert first.collisions == second.collisions == 1
    assert first.position[2] == second.position[2] == 0.0


def test_overlapping_start_refused() -> None:
    fleet_world = FleetWorld(3)
    first = LockstepVehicle({"onboard": {}}).vehicle
    fleet_world.join(first)
    with pytest.raises(ValueError, match=r"vehicle 1 .* already: .* system id"):
        fleet_world.join(first)
    near = LockstepVehicle({"onboard": {}}, system_id=2, start_ned_m=(0.0, 0.5)).vehicle
    with pytest.raises(ValueError, match=r"vehicle 2 .*0\.5 m.*vehicle 1.*0\.6 m"):
        fleet_world.join(near)
    fleet_world.join(LockstepVehicle({"onboard": {}}, system_id=3, start_ned_m=(0.0, 0.6)).vehicle)
    fleet_world.join(LockstepVehicle({"onboard": {}}, system_id=4, start_ned_m=(0.0, 1.2)).vehicle)
    with pytest.raises(ValueError, match=r"vehicle 5.*3"):
        fleet_world.join(LockstepVehicle({"onboard": {}}, system_id=5, start_ned_m=(9.0, 0.0)).vehicle)


def test_lockstep_vehicles_collide() -> None:
    pair = [
        LockstepVehicle(
            {"onboard": {}}, system_id=number, seed=number, noise=0.0, gusts_mps=0.0, start_ned_m=(start, 0.0)
        )
        for number, start in ((1, 0.0), (2, 6.0))
    ]
    fleet_world = FleetWorld(2)
    for vehicle in pair:
        fleet_world.join(vehicle.vehicle, offset=9)
        vehicle.take_off(3.0)
    # each towards where the other is, in its own frame
    for vehicle, north in zip(pair, (6.0, -6.0), strict=True):
        vehicle.set_position(north, 0.0, -3.0)
    first, second = fleet_world._midair.bodies
    for _ in range(1500):
        for vehicle in pair:
            vehicle.step(STEP_S)
        fleet_world.meet()
        assert apart(first, second) > 0.95
    assert pair[0].truth.collision is not None
    assert (pair[0].truth.collision.name, pair[0].truth.collision.identifier) == ("vehicle 2", 11)
    assert any("vehicle 1 at" in event for event in pair[1].events)


def test_landing_on_another_vehicle_is_landed() -> None:
    pair = [
        LockstepVehicle(
            {"onboard": {}}, system_id=number, start_ned_m=(start, 0.0), noise=False, gusts_mps=0.0
        )
        for number, start in ((1, 0.0), (2, 3.0))
    ]
    fleet_world = FleetWorld(2)
    for vehicle in pair:
        fleet_world.join(vehicle.vehicle)
    upper = pair[1]
    upper.take_off(3.0)
    airframe = upper.vehicle.airframe
    airframe.position = (-2.95, 0.0, airframe.position[2])  # above the other, 0.1 m beside its centre
    upper.send(dialect.MAVLink_command_long_message(2, 1, 21, 0, 0, 0, 0, 0, math.nan, math.nan, math.nan))
    for _ in range(10_000):
        upper.step(STEP_S)
        fleet_world.meet()
        if not upper.truth.armed:
            break
    assert (upper.truth.armed, upper.truth.landed, upper.truth.on_ground) == (False, True, True)
    assert upper.truth.height_m == pytest.approx(REACH_UP_M, abs=0.03)


@pytest.mark.parametrize("speed", [1.0, 20.0])
def test_real_time_fleet_reports_collisions(speed: float) -> None:
    events_text: list[str] = []
    options = SimulationOptions(
        onboard_port=free_udp_port_range(2),
        onboard_bind=0,
        gcs_port=free_port(),
        gcs_bind=0,
        noise=False,
        gusts_mps=0.0,
        speed=speed,
    )

    def on_event(text: str) -> None:
        events_text.append(text)
        if "vehicle 2 at" in text:
            fleet.stop()

    with Fleet(instance_options(options, 2, 12.0), on_event) as fleet:
        first, second = (simulation.vehicle.airframe for simulation in fleet.simulations)
        put(first, (0.0, 0.0, -40.0), (0.0, 15.0, 0.0))
        put(second, (0.0, 0.0, -40.0), (0.0, -15.0, 0.0))
        given_up = threading.Timer(30.0, fleet.stop)
        given_up.start()
        fleet.run()
        given_up.cancel()
        truth = fleet.simulations[0].truth()
    assert any(re.match(r"vehicle 1: crashed \w+ vehicle 2 at \d", text) for text in events_text), events_text
    assert truth["collisions"] == 1
    assert (truth["last_collision"]["object"], truth["crashed"]) == ("vehicle 2", True)
