"""The airframe's motion and its position control."""

import itertools
import math
import statistics

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mavlink_sim.control import PositionController, TrajectorySetpoint
from mavlink_sim.parameters import Parameters
from mavlink_sim.physics import GRAVITY_MPS2, Multirotor

STEP_S = 0.004


def hovering(**options: float) -> tuple[Multirotor, PositionController]:
    airframe = Multirotor(**options)  # type: ignore[arg-type]
    airframe.position = (0.0, 0.0, -5.0)
    airframe.on_ground = False
    airframe.thrust_mps2 = GRAVITY_MPS2
    return airframe, PositionController(Parameters())


def fly(
    airframe: Multirotor, controller: PositionController, setpoint: TrajectorySetpoint, seconds: float
) -> list[tuple[float, float, float]]:
    track = []
    for _ in range(round(seconds / STEP_S)):
        demand = controller.update(
            STEP_S, setpoint, airframe.position, airframe.velocity, airframe.acceleration, airframe.yaw_rad
        )
        airframe.step(STEP_S, demand.thrust_mps2, demand.roll_rad, demand.pitch_rad, demand.yaw_rate_radps)
        track.append(airframe.position)
    return track


def test_a_ten_metre_step_is_flown_as_the_real_vehicle_flew_it() -> None:
    airframe, controller = hovering()
    fly(airframe, controller, TrajectorySetpoint(position=(0.0, 0.0, -5.0), yaw_rad=0.0), 3.0)
    track = fly(airframe, controller, TrajectorySetpoint(position=(10.0, 0.0, -5.0), yaw_rad=0.0), 15.0)

    north = [point[0] for point in track]
    speeds = [(b - a) / STEP_S for a, b in itertools.pairwise(north)]
    assert 4.5 < max(speeds) < 5.7
    assert 2.7 < next(i for i, x in enumerate(north) if x >= 10.0) * STEP_S < 3.5
    assert 0.6 < max(north) - 10.0 < 1.15
    assert abs(north[-1] - 10.0) < 0.15
    assert all(abs(point[2] + 5.0) < 0.6 for point in track)


def test_a_velocity_over_the_limit_is_cut_where_it_does_not_lead_to_the_position() -> None:
    _, controller = hovering()
    setpoint = TrajectorySetpoint(position=(9.0 / 0.95, 0.0, -5.0), velocity=(0.0, 20.0, 0.0))
    controller.update(STEP_S, setpoint, (0.0, 0.0, -5.0), (0.0,) * 3, (0.0,) * 3, 0.0)  # type: ignore[arg-type]
    x, y, _ = controller.velocity
    assert x == pytest.approx(9.0)  # MPC_XY_P asks for 9 m/s, all of it is granted
    assert math.hypot(x, y) == pytest.approx(12.0)


@given(st.lists(st.floats(-50.0, 50.0), min_size=4, max_size=4))
def test_no_velocity_setpoint_is_over_the_limit(values: list[float]) -> None:
    _, controller = hovering()
    setpoint = TrajectorySetpoint(position=(values[0], values[1], -5.0), velocity=(values[2], values[3], 0.0))
    controller.update(STEP_S, setpoint, (0.0, 0.0, -5.0), (0.0,) * 3, (0.0,) * 3, 0.0)  # type: ignore[arg-type]
    assert math.hypot(*controller.velocity[:2]) <= 12.0 + 1e-6


def test_a_held_position_wanders_as_the_real_vehicle_did() -> None:
    spreads, farthest = [], []
    for seed in range(4):
        airframe, controller = hovering(seed=seed, gusts_mps=0.6)
        setpoint = TrajectorySetpoint(position=(0.0, 0.0, -5.0), yaw_rad=0.0)
        fly(airframe, controller, setpoint, 10.0)
        track = fly(airframe, controller, setpoint, 40.0)
        spreads.append([statistics.pstdev(axis) for axis in zip(*track, strict=True)])
        farthest.append(max(math.hypot(x, y) for x, y, _ in track))
    north, east, down = (statistics.mean(axis) for axis in zip(*spreads, strict=True))
    assert 0.12 < north < 0.35
    assert 0.12 < east < 0.35
    assert 0.03 < down < 0.15
    assert max(farthest) < 1.2


def test_a_steady_wind_is_held_against_with_a_tilt() -> None:
    airframe, controller = hovering()
    airframe.wind = (0.0, 5.0, 0.0)
    fly(airframe, controller, TrajectorySetpoint(position=(0.0, 0.0, -5.0), yaw_rad=0.0), 40.0)
    assert math.dist(airframe.position, (0.0, 0.0, -5.0)) < 0.1
    assert math.degrees(airframe.roll_rad) < -20.0  # into the wind that comes from the west
    assert abs(math.degrees(airframe.pitch_rad)) < 1.0


def test_the_same_seed_gives_the_same_flight_and_another_seed_another_one() -> None:
    tracks = []
    for seed in (7, 7, 8):
        airframe, controller = hovering(seed=seed, gusts_mps=1.0)
        tracks.append(fly(airframe, controller, TrajectorySetpoint(position=(1.0, 2.0, -5.0)), 5.0))
    assert tracks[0] == tracks[1]
    assert tracks[0] != tracks[2]


def test_without_thrust_it_falls_to_the_ground_and_stays_there() -> None:
    airframe, _ = hovering()
    for _ in range(1000):
        airframe.step(STEP_S, 0.0, 0.0, 0.0, 0.0)
    assert airframe.position[2] == 0.0
    assert airframe.velocity == (0.0, 0.0, 0.0)
    assert airframe.on_ground


def test_on_the_ground_the_accelerometer_feels_gravity_alone() -> None:
    airframe = Multirotor()
    airframe.step(STEP_S, 0.0, 0.0, 0.0, 0.0)
    assert airframe.specific_force == (0.0, 0.0, -GRAVITY_MPS2)


def test_the_yaw_follows_a_setpoint_the_short_way_round() -> None:
    airframe, controller = hovering()
    airframe.yaw_rad = math.radians(170.0)
    setpoint = TrajectorySetpoint(position=(0.0, 0.0, -5.0), yaw_rad=math.radians(-170.0))
    fly(airframe, controller, setpoint, 0.2)
    assert airframe.rates[2] > 0.0
    fly(airframe, controller, setpoint, 5.0)
    assert abs(math.remainder(airframe.yaw_rad - math.radians(-170.0), math.tau)) < 0.01


any_number = st.one_of(st.just(math.nan), st.floats(-1e30, 1e30))
vectors = st.tuples(any_number, any_number, any_number)


@settings(max_examples=40, deadline=None)
@given(vectors, vectors, vectors, any_number, any_number)
def test_no_setpoint_however_absurd_makes_the_motion_a_nonsense(
    position: tuple[float, float, float],
    velocity: tuple[float, float, float],
    acceleration: tuple[float, float, float],
    yaw: float,
    yaw_rate: float,
) -> None:
    airframe, controller = hovering()
    setpoint = TrajectorySetpoint(position, velocity, acceleration, yaw, yaw_rate)
    fly(airframe, controller, setpoint, 1.0)
    assert all(math.isfinite(value) for value in (*airframe.position, *airframe.velocity, *airframe.rates))
    assert math.hypot(*airframe.velocity) < 30.0
    assert abs(math.degrees(airframe.roll_rad)) < 75.0
    assert abs(math.degrees(airframe.pitch_rad)) < 75.0
