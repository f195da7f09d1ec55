"""goto, follow-path and figure-eight, and the path follower."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.geometry.geodesy import north_east
from companion.guidance import grammar
from companion.guidance.behaviour import Behaviour, BehaviourContext, Outcome
from companion.guidance.behaviours.figure_eight import FigureEightBehaviour, lemniscate
from companion.guidance.behaviours.follow_path import FollowPathBehaviour
from companion.guidance.behaviours.goto import Goto, GotoBehaviour
from companion.guidance.command import NO_CONTEXT
from companion.guidance.limits.envelope import Limits
from companion.guidance.path import ACCELERATION_MPS2, Path, PathFollower
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import Vector3, VehicleState
from tests.companion.guidance.guidance_harness import STEP_S, Flight, assert_failed, assert_succeeded
from tests.companion.guidance.kinematic_vehicle import KinematicVehicle
from vision.attitude import wrap_angle

WIDE = Limits(max_distance_m=1000.0, max_altitude_m=100.0)
positions = st.tuples(*[st.floats(-50, 50)] * 3)


def active(
    behaviour: Behaviour, seconds: float = 120.0, vehicle: KinematicVehicle | None = None
) -> tuple[Flight, Outcome]:
    flight = Flight(behaviour, vehicle or KinematicVehicle(), limits=WIDE)
    outcome = flight.run(seconds)
    assert outcome is not None, behaviour.status
    return flight, outcome


def off_the_line(position: Sequence[float], start: Sequence[float], end: Sequence[float]) -> float:
    path = [b - a for a, b in zip(start, end, strict=True)]
    length = math.hypot(*path)
    fraction = sum((p - a) * w for p, a, w in zip(position, start, path, strict=True)) / length**2
    fraction = min(max(fraction, 0.0), 1.0)
    return math.dist(position, [a + fraction * w for a, w in zip(start, path, strict=True)])


def test_goto_flies_straight_with_yaw_along_the_path() -> None:
    flight, outcome = active(GotoBehaviour(Goto(north_m=20.0, east_m=-10.0, altitude_m=8.0)))
    assert outcome.success
    assert math.dist(flight.vehicle.position, (20.0, -10.0, -8.0)) < 0.5
    assert max(off_the_line(position, (0, 0, -5), (20, -10, -8)) for position in flight.track) < 0.3
    assert flight.vehicle.yaw_rad == pytest.approx(math.atan2(-10, 20), abs=0.1)
    assert (
        max(
            math.hypot(*(b - a for a, b in zip(*pair, strict=True)))
            for pair in zip(flight.track, flight.track[1:], strict=False)
        )
        < 3.2 * STEP_S
    )


def test_goto_in_body_frame_with_a_heading() -> None:
    vehicle = KinematicVehicle(position=[5.0, 5.0, -5.0], yaw_rad=math.pi / 2)
    flight, outcome = active(
        GotoBehaviour(Goto(forward_m=10.0, right_m=2.0, heading_deg=math.degrees(math.pi))), vehicle=vehicle
    )
    assert outcome.success
    assert math.dist(flight.vehicle.position, (3.0, 15.0, -5.0)) < 0.5
    assert abs(wrap_angle(flight.vehicle.yaw_rad - math.pi)) < 0.05


@pytest.mark.parametrize(
    "behaviour", [GotoBehaviour(Goto(forward_m=0.0, right_m=0.0)), FollowPathBehaviour([(0.0, 0.0)], 3.0)]
)
def test_path_to_the_current_position_succeeds(behaviour: Behaviour) -> None:
    _, outcome = active(behaviour, 10.0)
    assert outcome.success


def test_goto_by_latitude_needs_a_global_position() -> None:
    behaviour = GotoBehaviour(Goto(latitude_deg=47.0, longitude_deg=8.0))
    _, outcome = active(behaviour)
    assert_failed(outcome, "not received")


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
    assert behaviour._follower is not None
    assert behaviour._follower.path.length_m == pytest.approx(11.12, abs=0.01)
    assert step.velocity_ned_mps is not None
    assert step.velocity_ned_mps[0] > 0.3
    assert abs(step.velocity_ned_mps[1]) < 1e-6


@dataclass
class WrongVelocity(KinematicVehicle):
    """Its estimate of the velocity is too far east, and that is what it controls."""

    error_mps: float = 0.5

    @property
    def state(self) -> VehicleState:
        north, east, down = self.velocity
        return replace(super().state, velocity_ned_mps=(north, east + self.error_mps, down))

    def fly(self, setpoint: Setpoint, dt_s: float) -> None:
        assert setpoint.velocity_ned_mps is not None
        north, east, down = setpoint.velocity_ned_mps
        super().fly(replace(setpoint, velocity_ned_mps=(north, east - self.error_mps, down)), dt_s)


def test_goto_arrives_though_the_estimated_speed_is_wrong() -> None:
    flight, outcome = active(GotoBehaviour(Goto(north_m=15.0, east_m=0.0)), 60.0, WrongVelocity())
    assert outcome.success, outcome.reason
    assert math.dist(flight.vehicle.position, (15.0, 0.0, -5.0)) < 0.5


@pytest.mark.parametrize(("error_mps", "reached"), [(1.0, True), (1.8, False)])
def test_goto_that_stays_beside_its_goal_states_the_distance(error_mps: float, reached: bool) -> None:
    vehicle = WrongVelocity(error_mps=error_mps)
    _, outcome = active(GotoBehaviour(Goto(north_m=15.0, east_m=0.0)), 60.0, vehicle)
    away_m = math.dist(vehicle.position, (15.0, 0.0, -5.0))
    assert outcome.success
    assert outcome.goal_ned_m == (15.0, 0.0, -5.0)
    assert (away_m <= 0.3) is reached
    assert (f"{away_m:.2f} m" in outcome.reason) is not reached


def test_goal_beyond_a_limit_ends_without_progress() -> None:
    flight = Flight(GotoBehaviour(Goto(north_m=60.0, east_m=0.0)), limits=Limits(max_distance_m=30.0))
    assert_failed(flight.run(120.0), "no progress", "guidance")


def test_path_passes_all_points_and_slows_at_corners() -> None:
    points = [(0.0, 0.0), (20.0, 0.0), (20.0, 20.0, 8.0), (0.0, 20.0)]
    flight, outcome = active(FollowPathBehaviour(points, 4.0))
    assert outcome.success, outcome.reason
    corners = [(0, 0, -5), (20, 0, -5), (20, 20, -8), (0, 20, -8)]
    for corner in corners:
        assert min(math.dist(corner, position) for position in flight.track) < 0.8
    legs = list(itertools.pairwise(corners))
    assert max(min(off_the_line(position, *leg) for leg in legs) for position in flight.track) < 0.8


def test_closed_path_is_repeated_from_far_away() -> None:
    points = [(0.0, 0.0), (12.0, 0.0), (12.0, 12.0), (0.0, 12.0)]
    vehicle = KinematicVehicle(position=[-40.0, 0.0, -5.0])
    flight, outcome = active(FollowPathBehaviour(points, 3.0, laps=2.0), 200.0, vehicle)
    assert_succeeded(outcome, "2 laps")
    times_by = sum(
        math.dist(a, (12, 12, -5)) > 1.0 >= math.dist(b, (12, 12, -5))
        for a, b in zip(flight.track, flight.track[1:], strict=False)
    )
    assert times_by == 2


def test_path_reversal_is_flown_to_its_end() -> None:
    flight, outcome = active(FollowPathBehaviour([(10.0, 0.0), (0.0, 0.0)], 3.0))
    assert outcome.success
    assert max(position[0] for position in flight.track) > 9.5
    flight, outcome = active(FollowPathBehaviour([(0.0, 0.0), (4.0, 0.0)], 3.0, laps=3.0))
    assert outcome.success
    assert sum(a[0] < 3.4 <= b[0] for a, b in itertools.pairwise(flight.track)) == 3


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


def test_closed_path_starts_at_its_first_point() -> None:
    points = [(0.0, 0.0), (15.0, 0.0), (15.0, 15.0), (0.0, 15.0)]
    vehicle = KinematicVehicle(position=[15.0, -15.0, -5.0])
    flight, outcome = active(FollowPathBehaviour(points, 4.0, laps=2.0), 200.0, vehicle)
    assert outcome.success
    first = next(i for i, position in enumerate(flight.track) if math.dist(position, (0, 0, -5)) < 1.5)
    second = next(i for i, position in enumerate(flight.track) if math.dist(position, (15, 15, -5)) < 1.5)
    assert first < second


def test_steep_path_stays_on_its_line_within_climb_limit() -> None:
    flight, outcome = active(GotoBehaviour(Goto(north_m=30.0, east_m=0.0, altitude_m=35.0, speed_mps=8.0)))
    assert outcome.success
    assert max(off_the_line(position, (0, 0, -5), (30, 0, -35)) for position in flight.track) < 1.5


def test_slow_climb_keeps_its_speed() -> None:
    behaviour = GotoBehaviour(Goto(forward_m=0.0, right_m=0.0, altitude_m=8.0, speed_mps=0.2))
    flight, outcome = active(behaviour)
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


@given(st.floats(-60, 60), st.floats(-180, 180), st.floats(-2000, 2000), st.floats(-2000, 2000))
def test_north_east_agrees_with_the_ellipsoid(
    latitude: float, longitude: float, north_m: float, east_m: float
) -> None:
    """Compared with the chord between both points in earth-centred coordinates."""

    def earth_centred(position: tuple[float, float]) -> Vector3:
        phi, lam = map(math.radians, position)
        normal = 6378137.0 / math.sqrt(1 - 6.694379990141e-3 * math.sin(phi) ** 2)
        return (
            normal * math.cos(phi) * math.cos(lam),
            normal * math.cos(phi) * math.sin(lam),
            normal * (1 - 6.694379990141e-3) * math.sin(phi),
        )

    there = (latitude + north_m / 111_000, longitude + east_m / (111_000 * math.cos(math.radians(latitude))))
    found = north_east((latitude, longitude), there)
    chord = math.dist(earth_centred((latitude, longitude)), earth_centred(there))
    assert math.hypot(*found) == pytest.approx(chord, abs=0.02)
