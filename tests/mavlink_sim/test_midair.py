"""Vehicles of one world that meet in the air."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavlink_sim import Flock, LockstepVehicle
from mavlink_sim.fleet import Fleet, instance_options
from mavlink_sim.physics.airframe import Multirotor, Vector
from mavlink_sim.physics.contact import CRASH_MPS, Collision
from mavlink_sim.physics.midair import REACH_M, REACH_UP_M, Body, Midair
from mavlink_sim.simulation import SimulationOptions
from mavlink_sim.vehicle import STEP_S
from mavlink_sim.wire.messages import dialect
from mavlink_sim.world.world import World, WorldObject

speeds = st.floats(-8.0, 8.0, allow_subnormal=False)
velocities = st.tuples(speeds, speeds, speeds)
offsets = st.floats(-0.7, 0.7, allow_subnormal=False)


def flying(place: Vector, velocity: Vector) -> Multirotor:
    airframe = Multirotor()
    airframe.on_ground = False
    airframe.position, airframe.velocity = place, velocity
    return airframe


def together(*airframes: Multirotor) -> Midair:
    midair = Midair()
    for number, airframe in enumerate(airframes, start=1):
        midair.join(Body(airframe, (0.0, 0.0), number, f"vehicle {number}"))
    return midair


def apart(first: Multirotor, second: Multirotor) -> float:
    """1 where their hulls touch, less where they overlap."""
    dx, dy, dz = (a - b for a, b in zip(first.position, second.position, strict=True))
    return math.sqrt((dx * dx + dy * dy) / REACH_M**2 + dz * dz / REACH_UP_M**2)


@given(place=st.tuples(offsets, offsets, offsets), one=velocities, other=velocities)
def test_those_that_overlap_are_parted_and_nothing_comes_of_nothing(
    place: Vector, one: Vector, other: Vector
) -> None:
    here = (0.0, 0.0, -5.0)
    first, second = flying(here, one), flying((place[0], place[1], place[2] - 5.0), other)
    touching = apart(first, second) < 1.0
    together(first, second).look(0.0)
    if not touching:
        assert (first.velocity, second.velocity) == (one, other)
        assert first.collisions == second.collisions == 0
        return
    assert apart(first, second) >= 1.0 - 1e-9
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


@given(
    places=st.lists(st.tuples(*[st.floats(-4.0, 4.0)] * 3), min_size=2, max_size=5),
    ways=st.lists(velocities, min_size=5, max_size=5),
)
def test_nobody_passes_by_unseen_between_two_looks(places: list[Vector], ways: list[Vector]) -> None:
    """Whoever is far enough off is not looked at, and nothing is missed by it."""

    def first_meeting(*, always: bool) -> tuple[int, list[int]] | None:
        bodies = [
            flying((x, y, z - 50.0), way) for (x, y, z), way in zip(places, ways[: len(places)], strict=True)
        ]
        midair = together(*bodies)
        for step in range(150):
            for body in bodies:
                body.position = tuple(  # type: ignore[assignment]
                    p + v * STEP_S for p, v in zip(body.position, body.velocity, strict=True)
                )
            if always:
                midair._until_s = -math.inf
            midair.look(step * STEP_S)
            if any(body.collisions for body in bodies):
                return step, [body.collisions for body in bodies]
        return None

    assert first_meeting(always=False) == first_meeting(always=True)


@pytest.mark.parametrize("speed_mps", [2.0, 3.0])
def test_two_that_meet_head_on_bounce_or_break(speed_mps: float) -> None:
    first = flying((0.0, 0.0, -20.0), (speed_mps, 0.0, 0.0))
    second = flying((0.601, 0.0, -20.0), (-speed_mps, 0.0, 0.0))
    told: list[Collision] = []
    first.on_collision = second.on_collision = told.append
    midair = together(first, second)
    for step in range(50):
        for one in (first, second):
            one.advance(STEP_S)
        midair.look(step * STEP_S)
    breaks = 2.0 * speed_mps > CRASH_MPS
    assert [collision.name for collision in told] == ["vehicle 2", "vehicle 1"]
    assert all(collision.speed_mps == pytest.approx(2.0 * speed_mps, rel=0.02) for collision in told)
    assert [collision.crashed for collision in told] == [breaks] * 2
    assert first.crashed == second.crashed == breaks
    assert first.velocity[0] < 0.0 < second.velocity[0]


def test_who_stands_on_the_ground_does_not_give_way() -> None:
    standing = Multirotor()
    falling = flying((0.1, 0.0, -1.0), (0.0, 0.0, 2.0))
    midair = together(standing, falling)
    lowest_m = 1.0
    for step in range(500):
        falling.advance(STEP_S)
        standing.advance(STEP_S)
        midair.look(step * STEP_S)
        assert apart(standing, falling) > 0.99
        lowest_m = min(lowest_m, -falling.position[2])
    assert standing.position == (0.0, 0.0, 0.0)
    assert standing.on_ground
    assert falling.last_collision is not None
    assert falling.last_collision.name == "vehicle 1"
    assert lowest_m < 0.3


def place(north: float, east: float, down: float) -> Any:
    return dialect.MAVLink_set_position_target_local_ned_message(
        0, 0, 1, 1, 3576, north, east, down, 0, 0, 0, 0, 0, 0, 0, 0
    )


def test_two_in_lockstep_do_not_fly_through_each_other() -> None:
    scene = World((WorldObject(9, "box", (30.0, 0.0, 0.0)),))
    pair = [
        LockstepVehicle({"onboard": {}}, system_id=number, seed=number, start_ned_m=(start, 0.0), scene=scene)
        for number, start in ((1, 0.0), (2, 6.0))
    ]
    flock = Flock(2)
    for vehicle in pair:
        flock.join(vehicle.vehicle)
        vehicle.take_off(3.0)
        vehicle.set_mode("HOLD")
    # each towards where the other is, in its own frame
    for vehicle, north in zip(pair, (6.0, -6.0), strict=True):
        vehicle.repeat(place(north, 0.0, -3.0), 20.0)
        vehicle.step(0.1)
        vehicle.set_mode("OFFBOARD")
    first, second = (vehicle.vehicle.airframe for vehicle in pair)
    nearest_m = math.inf
    for _ in range(1500):
        for vehicle in pair:
            vehicle.step(STEP_S)
        flock.meet()
        x, y, z = first.position
        ox, oy, oz = second.position
        nearest_m = min(nearest_m, math.dist((x, y, z), (ox + 6.0, oy, oz)))
    assert pair[0].truth.collisions >= 1
    assert pair[0].truth.collision is not None
    assert (pair[0].truth.collision.name, pair[0].truth.collision.identifier) == ("vehicle 2", 11)
    assert nearest_m > REACH_UP_M * 0.95
    assert any("vehicle 1 at" in event for event in pair[1].events)


def test_a_fleet_in_real_time_tells_who_ran_into_whom() -> None:
    said: list[str] = []
    options = SimulationOptions(onboard_bind=0, gcs_bind=0, noise=False, gusts_mps=0.0)

    def hear(text: str) -> None:
        said.append(text)
        if "hit" in text or "crashed into" in text:
            fleet.stop()

    with Fleet(instance_options(options, 2, 1.5), hear) as fleet:
        thrown = fleet.simulations[0].vehicle.airframe
        thrown.on_ground = False
        thrown.position, thrown.velocity = (0.0, 0.0, -0.1), (0.0, 4.5, -2.0)
        fleet.run()
        truth = fleet.simulations[0].truth()
    assert any(text.startswith("vehicle 1: hit vehicle 2 at ") for text in said)
    assert truth["collisions"] == 1
    assert truth["last_collision"]["object"] == "vehicle 2"
