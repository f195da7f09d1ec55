"""Separation limits, detours and repulsion."""

from __future__ import annotations

import itertools
import math
from random import Random

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from companion.guidance.formation.neighbours import Neighbour
from companion.guidance.formation.separation import (
    SpeedConstraint,
    allowed_speed,
    apply_separation,
    avoid,
    constraints_at,
    level_constraints,
    repulsion,
)
from companion.guidance.limits.envelope import Envelope, Limits
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import Vector3
from tests.companion.guidance.kinematic_vehicle import KinematicVehicle

speeds = st.floats(-5, 5)
velocity = st.tuples(speeds, speeds, st.floats(-2, 2))


def neighbour(
    position: Vector3,
    moving: Vector3 = (0.0, 0.0, 0.0),
    *,
    name: str = "alpha",
    age_s: float = 0.1,
    role: str = "alone",
) -> Neighbour:
    return Neighbour(name, position, moving, 0.0, 0.0, age_s, role)


@given(st.floats(-5, 50), st.floats(-8, 8), st.floats(0, 1), st.floats(0.5, 5))
def test_allowed_speed_is_monotonic(left: float, ahead: float, age: float, braking: float) -> None:
    allowed = allowed_speed(left, ahead, age, braking)
    assert allowed >= 0.0
    assert allowed_speed(left - 0.5, ahead, age, braking) <= allowed
    assert allowed_speed(left, ahead, age + 0.1, braking) <= allowed + 1e-9
    assert allowed_speed(left, ahead - 0.5, age, braking) <= allowed + 1e-9


@given(st.floats(0.1, 50), st.floats(0, 8), st.floats(0.5, 5))
def test_both_can_stop_from_the_allowed_speed(left: float, ahead: float, braking: float) -> None:
    speed = allowed_speed(left, ahead, 0.1, braking)
    own_way = speed * 0.5 + speed**2 / 2 / braking
    assert own_way <= left + ahead**2 / 2 / braking + 1e-6


directions = st.floats(-math.pi, math.pi)
constraints = st.lists(
    st.tuples(directions, st.floats(-1.5, 1.5), st.floats(0, 4)).map(
        lambda one: SpeedConstraint(
            math.cos(one[0]) * math.cos(one[1]),
            math.sin(one[0]) * math.cos(one[1]),
            math.sin(one[1]),
            one[2],
            "x",
        )
    ),
    max_size=8,
)


def at_bearing(degrees: float, allowed_mps: float) -> SpeedConstraint:
    bearing_rad = math.radians(degrees)
    return SpeedConstraint(math.cos(bearing_rad), math.sin(bearing_rad), 0.0, allowed_mps, "x")


# Between two neighbours the projections approach the allowed velocity slowly: it is scaled down at the end.
@example((5.0, 0.0, 0.0), [at_bearing(85.0, 0.1), at_bearing(-85.0, 0.1)])
@settings(max_examples=200)
@given(velocity, constraints)
def test_limited_velocity_satisfies_every_constraint(asked: Vector3, limits: list[SpeedConstraint]) -> None:
    left, names = apply_separation(asked, limits)
    assert math.hypot(*left) <= math.hypot(*asked) + 1e-6
    for one in limits:
        assert left[0] * one.north + left[1] * one.east + left[2] * one.down <= one.allowed_mps + 1e-5
    assert (left == asked) or names


def test_virtual_vehicle_is_no_obstacle() -> None:
    assert constraints_at((0, 0, 0), [neighbour((1.0, 0.0, 0.0), role="virtual")], 3.0, 2.0) == []


def test_above_a_vehicle_only_the_descent_is_limited() -> None:
    (one,) = constraints_at((0.0, 0.0, -10.0), [neighbour((0.0, 0.0, -6.0))], 3.0, 2.0)
    assert one.down == 1.0
    assert level_constraints([one], 0.0) == []
    assert apply_separation((3.0, 0.0, 1.0), [one])[0] == pytest.approx((3.0, 0.0, one.allowed_mps))


def test_detour_takes_the_nearer_side_and_right_head_on() -> None:
    def side(east: float) -> float:
        velocity, _ = avoid((2.0, 0.0), 20.0, (0.0, 0.0, 0.0), [neighbour((8.0, east, 0.0))], 4.0)
        assert math.hypot(*velocity) == pytest.approx(2.0)
        return velocity[1]

    assert side(0.0) > 0.5
    assert side(3.0) < -0.3
    assert side(-3.0) > 0.3
    assert side(6.0) == 0.0
    straight = ((2.0, 0.0), 1.0)
    # The goal is before it; and it is far above.
    assert avoid((2.0, 0.0), 4.0, (0.0, 0.0, 0.0), [neighbour((8.0, 0.0, 0.0))], 4.0) == straight
    assert avoid((2.0, 0.0), 20.0, (0.0, 0.0, 0.0), [neighbour((8.0, 0.0, -9.0))], 4.0) == straight
    # The side is kept unless the other is much better.
    (_, east), side_now = avoid((2.0, 0.0), 20.0, (0.0, 0.0, 0.0), [neighbour((8.0, 0.0, 0.0))], 4.0, -1.0)
    assert (east < 0.0, side_now) == (True, -1.0)
    # Enclosed on all sides: zero.
    ring = [neighbour((3.0 * math.cos(a), 3.0 * math.sin(a), 0.0)) for a in (0.0, 1.0, 2.0, 3.0, 4.0, 5.0)]
    assert avoid((2.0, 0.0), 20.0, (0.0, 0.0, 0.0), ring, 4.0)[0] == (0.0, 0.0)


def test_repulsion_only_from_vehicles_too_near() -> None:
    assert repulsion((0, 0, 0), [neighbour((3.0, 0.0, 0.0)), neighbour((0.0, 9.0, 0.0))], 4.0) == (
        -0.8,
        0.0,
    )
    assert repulsion((0, 0, 0), [neighbour((0.5, 0.0, 0.0))], 9.0) == (-1.0, 0.0)
    assert repulsion((0, 0, 0), [neighbour((0.5, 0.0, 0.0), role="virtual")], 9.0) == (0.0, 0.0)


@settings(max_examples=8, deadline=None)
@given(st.randoms(use_true_random=False), st.integers(2, 5), st.booleans())
def test_vehicles_flown_at_each_other_keep_separation(random: Random, count: int, by_position: bool) -> None:
    """Each vehicle is commanded to the same point, or at full speed in some direction."""
    fleet = [
        (
            KinematicVehicle([20.0 * math.cos(a), 20.0 * math.sin(a), -6.0 + random.uniform(-1, 1)]),
            Envelope(Limits()),
        )
        for a in (math.tau * index / count + random.uniform(-0.3, 0.3) for index in range(count))
    ]
    for turn in range(240):
        known = [
            neighbour(
                vehicle.position_ned_m, vehicle.state.velocity_ned_mps or (0.0, 0.0, 0.0), name=str(index)
            )
            for index, (vehicle, _) in enumerate(fleet)
        ]
        for index, (vehicle, envelope) in enumerate(fleet):
            others = [other for at, other in enumerate(known) if at != index]
            now_ns = vehicle.now_ns
            if by_position:
                asked = Setpoint.position((0.0, 0.0, -6.0), now_ns)
            else:
                north, east, down = (-p for p in vehicle.position)
                scale = 5.0 / max(0.1, math.hypot(north, east))
                asked = Setpoint.velocity((north * scale, east * scale, -0.2 * (6.0 - down)), now_ns)
            sent, _ = envelope.apply(asked, vehicle.state, now_ns, 0.05, others)
            vehicle.fly(sent, 0.05)
        for one, other in itertools.combinations(fleet, 2):
            assert math.dist(one[0].position, other[0].position) >= 3.0, turn


def test_envelope_names_the_limiting_neighbour() -> None:
    vehicle = KinematicVehicle()
    asked = Setpoint.velocity((1.0, 0.0, 0.0), vehicle.now_ns)
    vehicle.velocity = [1.0, 0.0, 0.0]
    sent, reasons = Envelope().apply(
        asked, vehicle.state, vehicle.now_ns, 0.05, [neighbour((3.2, 0.0, -5.0))]
    )
    assert sent.velocity_ned_mps == pytest.approx((0.0, 0.0, 0.0))
    assert [("3 m" in reason, "'alpha'" in reason) for reason in reasons] == [(True, True)]
