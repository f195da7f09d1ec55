"""Positions and ranges of a world's objects."""

from __future__ import annotations

import math
import pickle

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavlink_sim.world.shapes import CLASS_NAMES
from mavlink_sim.world.world import World, WorldObject, demo_world, range_to

SEEDS = range(12)


@pytest.fixture(scope="module", params=SEEDS)
def world(request: pytest.FixtureRequest) -> World:
    return demo_world(request.param)


def cars(world: World) -> list[WorldObject]:
    return [item for item in world.objects if item.class_name == "car"]


def test_a_world_has_every_class_and_one_or_two_cars(world: World) -> None:
    assert {item.class_name for item in world.objects} >= set(CLASS_NAMES)
    assert 1 <= len(cars(world)) <= 2


def test_cars_stand_18_to_35_metres_from_the_origin(world: World) -> None:
    for car in cars(world):
        assert 18.0 <= math.hypot(*car.position_ned_m[:2]) <= 35.0


def test_no_object_within_6_m_of_origin(world: World) -> None:
    assert min(range_to(item, (0.0, 0.0, 0.0)) for item in world.objects) > 6.0


def test_no_object_between_origin_and_car(world: World) -> None:
    for car in cars(world):
        north, east, _ = car.position_ned_m
        for step in range(1, 18):
            point = (north * step / 20, east * step / 20, 0.0)
            others = (range_to(item, point) for item in world.objects if item is not car)
            assert min(others) > 0.0


def test_objects_do_not_overlap(world: World) -> None:
    for item in world.objects:
        for other in world.objects:
            if other is not item:
                assert range_to(item, other.position_ned_m) > 0.0


def test_identifiers_number_the_objects(world: World) -> None:
    assert [item.identifier for item in world.objects] == list(range(len(world.objects)))


def test_seed_makes_same_world_again_and_another_seed_another() -> None:
    assert demo_world(3) == demo_world(3)
    assert demo_world(3) != demo_world(4)


def test_world_pickle_is_small() -> None:
    world = demo_world(1)
    packed = pickle.dumps(world)
    assert pickle.loads(packed) == world
    assert len(packed) < 20_000


@given(
    yaw=st.floats(-math.pi, math.pi),
    bearing=st.floats(-math.pi, math.pi),
    distance=st.floats(0.0, 60.0),
    north=st.floats(-50.0, 50.0),
    scale=st.floats(0.5, 2.0),
)
def test_range_is_least_distance_to_any_point_of_footprint(
    yaw: float, bearing: float, distance: float, north: float, scale: float
) -> None:
    car = WorldObject(0, "car", (north, -7.0, 0.0), yaw, scale, 3)
    point = (north + distance * math.cos(bearing), -7.0 + distance * math.sin(bearing), -12.0)
    rear, front, left, right = car.footprint_m
    c, s = math.cos(yaw), math.sin(yaw)
    steps = [i / 60 for i in range(61)]
    sampled = math.inf
    for a in steps:
        for b in steps:
            x, y = rear + (front - rear) * a, left + (right - left) * b
            sampled = min(
                sampled, math.hypot(north + c * x - s * y - point[0], -7.0 + s * x + c * y - point[1])
            )
    assert range_to(car, point) == pytest.approx(sampled, abs=0.1 * scale)


def test_range_ahead_of_car_is_to_its_bumper() -> None:
    car = WorldObject(0, "car", (10.0, 0.0, 0.0), math.pi, 1.0, 0)
    _, front, _, _ = car.footprint_m
    assert range_to(car, (0.0, 0.0, -3.0)) == pytest.approx(10.0 - front)
    assert range_to(car, (10.0, 0.0, 0.0)) == 0.0


def test_unknown_class_refused() -> None:
    with pytest.raises(ValueError, match="unknown class 'zebra'"):
        WorldObject(0, "zebra", (0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="scale must be positive"):
        WorldObject(0, "car", (0.0, 0.0, 0.0), scale=0.0)
