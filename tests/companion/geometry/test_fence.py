"""Polygon fence: containment, velocity limits, clipped goals, settings."""

from __future__ import annotations

import math

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from companion.geometry.fence import Fence, Point, Polygon
from companion.settings.reading import load_settings

SQUARE = ((-20.0, -20.0), (20.0, -20.0), (20.0, 20.0), (-20.0, 20.0))
POND = ((5.0, 5.0), (10.0, 5.0), (10.0, 10.0), (5.0, 10.0))
# A notch in the north side, its tip at the centre.
BAY = ((-20.0, -20.0), (20.0, -20.0), (0.0, 0.0), (20.0, 20.0), (-20.0, 20.0))
coordinate = st.floats(-30, 30)
point = st.tuples(coordinate, coordinate)
speed = st.tuples(st.floats(-10, 10), st.floats(-10, 10))
directions = st.floats(-math.pi, math.pi)


def braking(left_m: float) -> float:
    return math.sqrt(2.0 * 1.0 * max(0.0, left_m))


@st.composite
def stars(draw: st.DrawFn) -> tuple[tuple[float, float], ...]:
    """Polygons whose edges do not cross: corners at growing angles about their middle."""
    count = draw(st.integers(3, 8))
    radii = draw(st.lists(st.floats(3, 25), min_size=count, max_size=count))
    turn = draw(st.floats(0, math.tau))
    return tuple(
        (r * math.cos(turn + math.tau * i / count), r * math.sin(turn + math.tau * i / count))
        for i, r in enumerate(radii)
    )


def test_inside_and_outside() -> None:
    fence = Fence(SQUARE, (POND,))
    assert fence.contains((0.0, 0.0))
    assert not fence.contains((7.0, 7.0))
    assert not fence.contains((21.0, 0.0))
    assert Fence().contains((1e6, 0.0))


@given(stars(), point)
def test_inside_agrees_with_the_winding_number(polygon: Polygon, here: Point) -> None:
    angles = [math.atan2(e - here[1], n - here[0]) for n, e in polygon]
    winding = sum(
        math.remainder(b - a, math.tau) for a, b in zip(angles, angles[1:] + angles[:1], strict=True)
    )
    # On an edge both answers are accepted.
    edges = zip(polygon, polygon[1:] + polygon[:1], strict=True)
    assume(
        all(abs((b[0] - a[0]) * (here[1] - a[1]) - (b[1] - a[1]) * (here[0] - a[0])) > 1e-6 for a, b in edges)
    )
    assert Fence(polygon).contains(here) == (abs(winding) > 1.0)
    assert Fence(exclude=(polygon,)).contains(here) == (abs(winding) < 1.0)


@given(stars(), point, speed, st.booleans())
def test_limiting_never_speeds_up_and_is_idempotent(
    polygon: Polygon, here: Point, velocity: Point, inside: bool
) -> None:
    fence = Fence(polygon) if inside else Fence(exclude=(polygon,))
    limited = fence.limit_velocity(velocity, here, braking)
    assert math.hypot(*limited) <= math.hypot(*velocity) + 1e-9
    assert math.dist(fence.limit_velocity(limited, here, braking), limited) < 1e-6


@given(stars(), speed, st.booleans(), st.floats(0, math.tau))
@settings(max_examples=60, deadline=None)
def test_limited_velocity_never_crosses_the_fence(
    polygon: Polygon, velocity: Point, inside: bool, turn: float
) -> None:
    fence = Fence(polygon) if inside else Fence(exclude=(polygon,))
    here = (0.0, 0.0) if inside else (40.0 * math.cos(turn), 40.0 * math.sin(turn))
    assume(fence.contains(here))
    for step in range(400):
        # The wanted direction turns, so that corners are reached as well.
        angle = turn + 0.05 * step
        wanted = (
            velocity[0] * math.cos(angle) - velocity[1] * math.sin(angle),
            velocity[0] * math.sin(angle) + velocity[1] * math.cos(angle),
        )
        north, east = fence.limit_velocity(wanted, here, braking)
        here = (here[0] + 0.02 * north, here[1] + 0.02 * east)
        assert fence.contains(here)


def test_velocity_along_or_away_from_an_edge_is_kept() -> None:
    fence = Fence(SQUARE)
    assert fence.limit_velocity((0.0, 3.0), (19.0, 0.0), braking) == (0.0, 3.0)
    assert fence.limit_velocity((-4.0, 1.0), (19.0, 0.0), braking) == (-4.0, 1.0)
    north, east = fence.limit_velocity((4.0, 1.0), (19.0, 0.0), braking)
    assert north == pytest.approx(braking(0.5))
    assert east == 1.0


def test_velocity_is_limited_in_a_concave_corner() -> None:
    north, east = Fence(BAY).limit_velocity((3.0, 0.0), (-0.9, 0.0), braking)
    assert 0.0 <= north < 1.0
    assert abs(east) < 0.5


def test_no_outward_velocity_on_the_edge() -> None:
    fence = Fence(SQUARE, (POND,))
    assert fence.limit_velocity((5.0, 0.0), (20.0, 0.0), braking) == pytest.approx((0.0, 0.0))
    assert fence.limit_velocity((-5.0, 0.0), (20.0, 0.0), braking) == (-5.0, 0.0)
    assert fence.limit_velocity((0.0, 4.0), (7.0, 5.0), braking) == pytest.approx((0.0, 0.0))


def test_speed_is_continuous_in_an_acute_corner() -> None:
    fence = Fence(((0.0, 0.0), (30.0, -17.32), (30.0, 17.32)))
    here, before = (25.0, 0.0), (-5.0, 0.0)
    for _ in range(1500):
        now = fence.limit_velocity((-5.0, 0.5), here, braking)
        assert math.dist(now, before) < 0.7
        before, here = now, (here[0] + 0.02 * now[0], here[1] + 0.02 * now[1])
        assert fence.contains(here)
    assert 0.4 < here[0] < 2.5


def test_additional_constraint_holds_together_with_edges() -> None:
    fence = Fence(exclude=(((40.0, -5.0), (60.0, 15.0), (60.0, -25.0)),))
    for step in range(200):
        angle = 0.05 * step
        velocity = (4.0 * math.cos(angle), 4.0 * math.sin(angle))
        north, east = fence.limit_velocity(velocity, (38.0, -4.0), braking, also=[(1.0, 0.0, 0.3)])
        assert north <= 0.3 + 1e-6
        assert math.hypot(north, east) <= 4.0 + 1e-9


def test_return_from_outside_stops_at_exclusion() -> None:
    fence = Fence(SQUARE, (POND,))
    assert fence.clip((30.0, 7.0), (-15.0, 7.0))[0] == pytest.approx(10.5)


def test_outside_the_fence_no_further_out() -> None:
    fence = Fence(SQUARE)
    assert fence.limit_velocity((2.0, 0.5), (25.0, 0.0), braking) == pytest.approx((0.0, 0.5))
    assert fence.limit_velocity((-2.0, 0.5), (25.0, 0.0), braking) == (-2.0, 0.5)


def test_goal_beyond_an_edge_is_clipped() -> None:
    fence = Fence(SQUARE, (POND,))
    assert fence.clip((0.0, 0.0), (40.0, 0.0)) == pytest.approx((19.5, 0.0))
    assert fence.clip((0.0, 7.0), (15.0, 7.0)) == pytest.approx((4.5, 7.0))
    assert fence.clip((0.0, 0.0), (3.0, 3.0)) == (3.0, 3.0)
    assert fence.clip((30.0, 0.0), (40.0, 0.0)) == (30.0, 0.0)
    assert fence.clip((30.0, 0.0), (0.0, 0.0)) == (0.0, 0.0)


def test_settings_become_the_fence() -> None:
    overrides = {
        "guidance.fence_include": "-5,-5 5,-5 5,5 -5,5",
        "guidance.fence_exclude": "3,3 4,3 4,4 | 1,1 2,1 2,2",
    }
    settings = load_settings("/dev/null", overrides, {})
    fence = settings.guidance.fence()
    assert fence.contains((0.0, 0.0))
    assert not fence.contains((1.8, 1.2))
    assert not fence.contains((6.0, 0.0))


@given(
    speed,
    st.lists(st.tuples(directions, st.floats(0.0, 1.0)), max_size=12),
    st.tuples(directions, st.floats(-2.0, 0.0)),
)
def test_further_constraints_hold_while_one_backs_away(
    wanted: Point, bounds: list[tuple[float, float]], retreat: tuple[float, float]
) -> None:
    also = [(math.cos(angle), math.sin(angle), allowed) for angle, allowed in (retreat, *bounds)]
    limited = Fence().limit_velocity(wanted, (0.0, 0.0), braking, also)
    assert math.hypot(*limited) <= math.hypot(*wanted, retreat[1]) + 1e-5
    for north, east, allowed in also:
        assert limited[0] * north + limited[1] * east <= max(allowed, 0.0) + 1e-5


def test_backing_away_gives_way_to_what_is_behind() -> None:
    # Too near to an obstacle over 60 degrees in the east, drifting there; another one 1.6 m away, behind.
    towards = [(angle, 0.0) for angle in range(60, 121, 5)]
    bounds = [(85, -1.28), *towards, (-100, 0.76), (-80, 0.68), (-75, 0.63), (-70, 0.22)]
    also = [(math.cos(math.radians(a)), math.sin(math.radians(a)), allowed) for a, allowed in bounds]
    north, east = Fence().limit_velocity((0.0, -1.0), (0.0, 0.0), braking, also)
    assert -0.7 < east < -0.25
    assert north * also[-1][0] + east * also[-1][1] == pytest.approx(0.22, abs=1e-6)
    # Without the one behind, as fast as asked for.
    assert Fence().limit_velocity((0.0, -1.0), (0.0, 0.0), braking, also[:-4])[1] < -1.2
