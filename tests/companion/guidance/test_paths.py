"""goto, follow-path and figure-eight, and the path follower."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.guidance import grammar
from companion.guidance.behaviour import Behaviour, BehaviourContext, Outcome
from companion.guidance.behaviours.figure_eight import FigureEightBehaviour, lemniscate
from companion.guidance.behaviours.goto import Goto, GotoBehaviour
from companion.guidance.command import NO_CONTEXT
from companion.guidance.limits.envelope import Limits
from companion.guidance.path import ACCELERATION_MPS2, Path, PathFollower
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import Vector3
from tests.companion.guidance.guidance_harness import STEP_S, Flight, assert_failed, assert_succeeded, known
from tests.companion.guidance.kinematic_vehicle import KinematicVehicle
from vision.attitude import wrap_angle

WIDE = Limits(max_distance_m=1000.0, max_altitude_m=100.0)
positions = st.tuples(*[st.floats(-50, 50)] * 3)


def active(
    command: Behaviour | str, seconds: float = 120.0, vehicle: KinematicVehicle | None = None
) -> tuple[Flight, Outcome]:
    flight = Flight(command, vehicle or KinematicVehicle(), limits=WIDE)
    return flight, known(flight.run(seconds))


def off_the_line(position: Sequence[float], start: Sequence[float], end: Sequence[float]) -> float:
    path = [b - a for a, b in zip(start, end, strict=True)]
    length = math.hypot(*path)
    fraction = sum((p - a) * w for p, a, w in zip(position, start, path, strict=True)) / length**2
    fraction = min(max(fraction, 0.0), 1.0)
    return math.dist(position, [a + fraction * w for a, w in zip(start, path, strict=True)])


@dataclass(frozen=True)
class Way:
    """A command, and the points that the vehicle passes in this order, in lines from where it is.

    Attributes:
        within_m: of the lines and of the points.
    """

    command: str
    points: list[Vector3]
    within_m: float = 0.8
    start: Vector3 = (0.0, 0.0, -5.0)
    yaw_rad: float = 0.0


def level(*points: tuple[float, float]) -> list[Vector3]:
    return [(north, east, -5.0) for north, east in points]


RING = level((0, 0), (15, 0), (15, 15), (0, 15))
WAYS = {
    "straight": Way("goto 20 -10 altitude=8", [(20, -10, -8)], 0.5),
    "in the body frame": Way(
        "goto forward=10 right=2 heading=180", level((3, 15)), 0.5, (5.0, 5.0, -5.0), math.pi / 2
    ),
    "in the body frame, aslant": Way("goto forward=6 right=8", level((0, 10)), 0.5, yaw_rad=math.atan2(3, 4)),
    "where it is": Way("goto forward=0 right=0", level((0, 0))),
    "one point, where it is": Way("follow-path 0,0", level((0, 0))),
    "steep, within the climb limit": Way("goto 30 0 altitude=35 speed=8", [(30, 0, -35)], 1.5),
    "corners": Way(
        "follow-path 0,0;20,0;20,20,8;0,20 speed=4", [*level((0, 0), (20, 0)), (20, 20, -8), (0, 20, -8)]
    ),
    "there and back": Way("follow-path 10,0;0,0", level((10, 0), (0, 0))),
    "there and back again": Way("follow-path 0,0;4,0 laps=3", level(*[(0, 0), (4, 0)] * 3, (0, 0))),
    "closed": Way(
        "follow-path 0,0;15,0;15,15;0,15 speed=4 laps=2", [*RING * 2, RING[0]], 1.5, (15.0, -15.0, -5.0)
    ),
    "closed, from far away": Way(
        "follow-path 0,0;15,0;15,15;0,15 laps=2", [*RING * 2, RING[0]], 1.0, (-40.0, 0.0, -5.0)
    ),
}


@pytest.mark.parametrize("name", WAYS)
def test_way_is_flown_in_order_along_its_lines(name: str) -> None:
    way = WAYS[name]
    vehicle = KinematicVehicle(position=list(way.start), yaw_rad=way.yaw_rad)
    flight, outcome = active(way.command, 200.0, vehicle)
    assert_succeeded(outcome, *(["2 laps"] if "closed" in name else []))
    begin = 0
    for point in way.points:
        near = (math.dist(here, point) < way.within_m for here in flight.track[begin:])
        begin += next(index for index, passed in enumerate(near) if passed)
    assert math.dist(vehicle.position, way.points[-1]) < 0.5
    legs = [leg for leg in itertools.pairwise([way.start, *way.points]) if leg[0] != leg[1]]
    assert all(min(off_the_line(here, *leg) for leg in legs) < way.within_m for here in flight.track if legs)
    if name == "straight":
        assert vehicle.yaw_rad == pytest.approx(math.atan2(-10, 20), abs=0.1)
        steps_m = [math.dist(*pair) for pair in itertools.pairwise(flight.track)]
        assert max(steps_m) < 3.2 * STEP_S
    if name == "in the body frame":
        assert abs(wrap_angle(vehicle.yaw_rad - math.pi)) < 0.05


def test_goto_by_latitude_needs_a_global_position() -> None:
    assert_failed(active("goto latitude=47 longitude=8")[1], "not received")


def test_goto_by_latitude_and_longitude() -> None:
    vehicle = KinematicVehicle()
    state = replace(
        vehicle.state,
        global_ns=vehicle.now_ns,
        latitude_deg=47.397742,
        longitude_deg=8.545594,
        altitude_amsl_m=490.0,
    )
    behaviour = GotoBehaviour(Goto(latitude_deg=47.397742 + 1e-4, longitude_deg=8.545594))
    behaviour.on_activate(BehaviourContext(vehicle.now_ns, state))
    step = behaviour.update(0.0, BehaviourContext(vehicle.now_ns, state))
    assert isinstance(step, Setpoint)
    assert known(behaviour._follower).path.length_m == pytest.approx(11.12, abs=0.01)
    assert step.velocity_ned_mps is not None
    assert step.velocity_ned_mps[0] > 0.3
    assert abs(step.velocity_ned_mps[1]) < 1e-6


def wrong_velocity(error_mps: float) -> KinematicVehicle:
    """Its estimate of the velocity is too far east, and that is what it controls."""
    return KinematicVehicle(velocity_error=(0.0, error_mps, 0.0))


def test_goto_arrives_though_the_estimated_speed_is_wrong() -> None:
    flight, outcome = active("goto 15 0", 60.0, wrong_velocity(0.5))
    assert outcome.success, outcome.reason
    assert math.dist(flight.vehicle.position, (15.0, 0.0, -5.0)) < 0.5


@pytest.mark.parametrize(("error_mps", "reached"), [(1.0, True), (1.8, False)])
def test_goto_that_stays_beside_its_goal_states_the_distance(error_mps: float, reached: bool) -> None:
    vehicle = wrong_velocity(error_mps)
    _, outcome = active("goto 15 0", 60.0, vehicle)
    away_m = math.dist(vehicle.position, (15.0, 0.0, -5.0))
    assert outcome.success
    assert outcome.goal_ned_m == (15.0, 0.0, -5.0)
    assert (away_m <= 0.3) is reached
    assert (f"{away_m:.2f} m" in outcome.reason) is not reached


@pytest.mark.parametrize(
    ("command", "limits", "down_error_mps", "away_m"),
    [
        ("goto 0 0 altitude=20", Limits(max_altitude_m=20.0), 0.0, 0.3),
        ("goto 0 0 altitude=20", Limits(max_altitude_m=20.0), -0.5, 0.65),
        ("goto 0 0 altitude=3", Limits(min_altitude_m=3.0), 0.5, 0.65),
        ("goto 30 0", Limits(max_distance_m=30.0), 0.0, 0.3),
    ],
)
def test_goal_at_a_limit_is_reached_though_it_slows_down(
    command: str, limits: Limits, down_error_mps: float, away_m: float
) -> None:
    vehicle = KinematicVehicle(velocity_error=(0.0, 0.0, down_error_mps))
    outcome = known(Flight(command, vehicle, limits=limits).run(60.0))
    assert outcome.success, outcome.reason
    assert math.dist(vehicle.position, known(outcome.goal_ned_m)) <= away_m
    assert -limits.max_altitude_m <= vehicle.position[2] <= -limits.min_altitude_m


def test_vehicle_that_stays_far_from_a_limit_has_not_reached_it() -> None:
    vehicle = KinematicVehicle(velocity_error=(0.0, 0.0, -1.2))
    flight = Flight("goto 0 0 altitude=20", vehicle, limits=Limits(max_altitude_m=20.0))
    assert_failed(flight.run(60.0), "no progress")


def test_goal_beyond_a_limit_ends_without_progress() -> None:
    flight = Flight("goto north=60 east=0", limits=Limits(max_distance_m=30.0))
    assert_failed(flight.run(120.0), "no progress", "guidance")


def test_route_ahead_ends_at_a_reversal_until_it_is_reached() -> None:
    follower = PathFollower(Path([(0.0, 0.0, -3.0), (10.0, 0.0, -3.0), (2.0, 0.0, -3.0)], 2.0))
    follower.velocity((3.0, 0.5, -3.0), 1.0)
    ahead = follower.ahead(15.0)
    assert ahead[0] == pytest.approx((3.0, 0.0, -3.0), abs=0.01)
    assert ahead[-1] == pytest.approx((10.0, 0.0, -3.0), abs=0.3)
    assert follower.ahead(4.0)[-1] == pytest.approx((7.0, 0.0, -3.0), abs=0.01)
    follower.velocity((6.5, 0.0, -3.0), 1.0)
    follower.velocity((9.6, 0.0, -3.0), 1.0)
    assert follower.ahead(15.0)[-1] == pytest.approx((2.0, 0.0, -3.0), abs=0.01)
    assert follower.along_m >= 10.0


def test_slow_climb_keeps_its_speed() -> None:
    flight, outcome = active("goto forward=0 right=0 altitude=8 speed=0.2")
    assert outcome.success
    steps = itertools.pairwise(flight.track)
    assert max(abs(b[2] - a[2]) for a, b in steps) < 0.25 * STEP_S


@pytest.mark.parametrize("text", ["goto 1 2", "follow-path 1,2 3,4", "goto forward=1 right=1 altitude=5"])
def test_point_relative_to_home_needs_home(text: str) -> None:
    vehicle = KinematicVehicle()
    state = replace(vehicle.state, home_position_ned_m=None)
    behaviour = grammar.parse(text).build(NO_CONTEXT)
    behaviour.on_activate(BehaviourContext(vehicle.now_ns, state))
    step = behaviour.update(0.0, BehaviourContext(vehicle.now_ns, state))
    assert isinstance(step, Outcome)
    assert "home position" in step.reason


def test_figure_eight_stays_on_its_line() -> None:
    flight, outcome = active(FigureEightBehaviour(10.0, 2.5, 1.0), vehicle=KinematicVehicle(yaw_rad=0.7))
    assert outcome.success, outcome.reason
    line = lemniscate((0.0, 0.0, -5.0), 0.7, 10.0)
    legs = list(zip(line, line[1:] + line[:1], strict=True))
    settled = flight.track[50::3]
    assert max(min(off_the_line(position, *leg) for leg in legs) for position in settled) < 0.8
    ends = [(s * 10 * math.cos(0.7), s * 10 * math.sin(0.7), -5.0) for s in (1, -1)]
    for end in ends:
        assert min(math.dist(end, position) for position in flight.track) < 0.8


@given(st.lists(positions, min_size=1, max_size=8), st.booleans(), st.floats(0.5, 15))
@settings(max_examples=60, deadline=None)
def test_speed_profile_of_any_path_is_feasible(points: list[Vector3], closed: bool, speed_mps: float) -> None:
    try:
        path = Path(points, speed_mps, closed=closed)
    except ValueError as error:
        if "closed path" not in str(error):
            raise
        return
    at = [path.length_m * step / 300 for step in range(301)]
    speeds = [path.point(along).speed_mps for along in at]
    assert all(speed <= speed_mps + 1e-9 for speed in speeds)
    if not closed:
        assert speeds[-1] == pytest.approx(0.0, abs=1e-3)
        assert math.dist(path.point(path.length_m).position_ned_m, points[-1]) < 0.011
    step_m = path.length_m / 300
    for before, after in itertools.pairwise(speeds):
        assert before**2 <= after**2 + 2 * ACCELERATION_MPS2 * step_m * (1 + 1e-6) + 1e-6
    for along in at[:300]:
        assert math.hypot(*path.point(along).direction) == pytest.approx(1.0)


@given(st.lists(positions, min_size=2, max_size=6), st.tuples(*[st.floats(-200, 200)] * 3))
@settings(max_examples=60, deadline=None)
def test_progress_is_monotonic_and_velocities_finite(points: list[Vector3], position: Vector3) -> None:
    if all(math.dist(point, points[0]) < 0.01 for point in points):
        return
    follower = PathFollower(Path(points, 3.0))
    before = 0.0
    for step in range(10):
        north, east, down = (p + 0.3 * step for p in position)
        velocity = follower.velocity((north, east, down), 3.0)
        assert all(map(math.isfinite, velocity))
        assert follower.along_m >= before
        before = follower.along_m
