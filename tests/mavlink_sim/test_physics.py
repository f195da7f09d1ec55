"""The airframe's motion, its position control, and the vehicle's estimate of it."""

import itertools
import math
import statistics
from bisect import bisect_left
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from mavlink_sim import LockstepVehicle
from mavlink_sim.flight.position_control import PositionController, TrajectorySetpoint
from mavlink_sim.physics.airframe import GRAVITY_MPS2, MAX_THRUST_MPS2, Multirotor
from mavlink_sim.physics.estimate_errors import DRIFT_STEP_S, POSITION_TIME_CONSTANT_S, Estimate
from mavlink_sim.physics.rotations import rotation_matrix
from mavlink_sim.px4.parameters import Parameters

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


def test_ten_metre_step_matches_real_vehicle() -> None:
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


def test_velocity_limit_cuts_feed_forward_first() -> None:
    _, controller = hovering()
    setpoint = TrajectorySetpoint(position=(9.0 / 0.95, 0.0, -5.0), velocity=(0.0, 20.0, 0.0))
    controller.update(STEP_S, setpoint, (0.0, 0.0, -5.0), (0.0,) * 3, (0.0,) * 3, 0.0)
    x, y, _ = controller.velocity
    assert x == pytest.approx(9.0)  # MPC_XY_P demands 9 m/s, which is within the limit
    assert math.hypot(x, y) == pytest.approx(12.0)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(-50.0, 50.0), min_size=4, max_size=4))
def test_no_velocity_setpoint_is_over_the_limit(values: list[float]) -> None:
    _, controller = hovering()
    setpoint = TrajectorySetpoint(position=(values[0], values[1], -5.0), velocity=(values[2], values[3], 0.0))
    controller.update(STEP_S, setpoint, (0.0, 0.0, -5.0), (0.0,) * 3, (0.0,) * 3, 0.0)
    assert math.hypot(*controller.velocity[:2]) <= 12.0 + 1e-6


def test_a_steady_wind_is_held_against_with_a_tilt() -> None:
    airframe, controller = hovering()
    airframe.wind = (0.0, 5.0, 0.0)
    fly(airframe, controller, TrajectorySetpoint(position=(0.0, 0.0, -5.0), yaw_rad=0.0), 40.0)
    assert math.dist(airframe.position, (0.0, 0.0, -5.0)) < 0.1
    assert math.degrees(airframe.roll_rad) < -20.0  # into the wind that comes from the west
    assert abs(math.degrees(airframe.pitch_rad)) < 1.0


def test_seed_determines_the_flight() -> None:
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


def test_accelerometer_on_ground_reads_gravity() -> None:
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
def test_absurd_setpoints_keep_motion_finite(
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


def axis(airframe: Multirotor) -> tuple[float, float, float]:
    """The body's down axis, NED."""
    matrix = airframe.matrix
    return (matrix[2], matrix[5], matrix[8])


def test_body_rate_reached_as_fast_as_in_px4() -> None:
    airframe, _ = hovering()
    reached = []
    for _ in range(100):
        airframe.step_rates(STEP_S, GRAVITY_MPS2, (1.0, 0.0, 0.0))
        reached.append(airframe.rates[0])
    assert 0.04 < next(i for i, p in enumerate(reached) if p > 0.63) * STEP_S < 0.12
    assert max(reached) < 1.2
    assert abs(reached[-1] - 1.0) < 0.05


def test_it_loops_the_loop_without_a_jump() -> None:
    airframe, _ = hovering()
    airframe.position = (0.0, 0.0, -200.0)
    before = axis(airframe)
    upside_down = False
    for _ in range(round(2.0 / STEP_S)):
        airframe.step_rates(STEP_S, GRAVITY_MPS2, (0.0, 4.0, 0.0))
        after = axis(airframe)
        assert math.dist(before, after) < 5.0 * STEP_S  # the pitch passes 90 degrees as any other angle
        assert abs(math.hypot(*airframe.quaternion) - 1.0) < 1e-9
        before = after
        upside_down = upside_down or after[2] < -0.95
    assert upside_down
    assert abs(airframe.rates[0]) < 0.05


def test_it_rights_itself_from_any_attitude() -> None:
    for roll, pitch in ((math.pi, 0.0), (2.5, 0.4), (0.0, math.pi / 2), (-1.0, -1.4)):
        airframe, _ = hovering()
        airframe.position = (0.0, 0.0, -100.0)
        airframe.set_attitude(roll, pitch, 0.3)
        for _ in range(round(4.0 / STEP_S)):
            airframe.step(STEP_S, GRAVITY_MPS2, 0.0, 0.0, 0.0)
        assert axis(airframe)[2] > 0.99, (roll, pitch)


def test_the_matrix_is_that_of_the_quaternion() -> None:
    airframe, _ = hovering()
    for _ in range(50):
        airframe.step_rates(STEP_S, GRAVITY_MPS2, (1.0, -2.0, 0.5))
    assert airframe.matrix == pytest.approx(rotation_matrix(airframe.quaternion), abs=1e-12)
    other = Multirotor()
    other.set_attitude(airframe.roll_rad, airframe.pitch_rad, airframe.yaw_rad)
    assert max(abs(a - b) for a, b in zip(other.matrix, airframe.matrix, strict=True)) < 1e-12


def test_without_one_motor_it_spins_and_falls() -> None:
    for motor in range(4):
        airframe, controller = hovering()
        airframe.position = (0.0, 0.0, -30.0)
        setpoint = TrajectorySetpoint(position=(0.0, 0.0, -30.0), yaw_rad=0.0)
        fly(airframe, controller, setpoint, 2.0)
        airframe.fail_motor(motor)
        fly(airframe, controller, setpoint, 3.0)
        assert math.hypot(*airframe.rates) > 2.0
        assert airframe.velocity[2] > 2.0
        fly(airframe, controller, setpoint, 10.0)
        assert airframe.on_ground
        assert airframe.crashed
        assert airframe.thrust_mps2 < 0.1


def test_a_weak_motor_is_flown_with() -> None:
    airframe, controller = hovering()
    airframe.fail_motor(2, 0.8)
    setpoint = TrajectorySetpoint(position=(0.0, 0.0, -5.0), yaw_rad=0.0)
    fly(airframe, controller, setpoint, 20.0)
    assert math.dist(airframe.position, (0.0, 0.0, -5.0)) < 1.0
    airframe.fail_motor(2, 1.0)
    fly(airframe, controller, setpoint, 20.0)
    assert math.dist(airframe.position, (0.0, 0.0, -5.0)) < 0.1


@pytest.mark.parametrize(
    ("down_mps", "bounces", "crashes"), [(0.5, False, False), (2.5, True, False), (7.0, True, True)]
)
def test_ground_allows_landing_and_breaks_a_fall(down_mps: float, bounces: bool, crashes: bool) -> None:
    airframe = Multirotor()
    airframe.position, airframe.velocity, airframe.on_ground = (0.0, 0.0, -0.001), (1.0, 0.0, down_mps), False
    met: list[float] = []
    airframe.on_touch = met.append
    upwards = 0.0
    for _ in range(500):
        airframe.step(STEP_S, 0.0, 0.0, 0.0, 0.0)
        upwards = min(upwards, airframe.velocity[2])
    assert met[0] == pytest.approx(down_mps, abs=0.1)
    assert (upwards < 0.0) is bounces
    assert airframe.crashed is crashes
    assert airframe.velocity == (0.0, 0.0, 0.0)  # friction stopped it
    assert 0.0 < airframe.position[0] < 1.0


shares = st.floats(-3.0, 3.0)


def rotor_commands(thrust: float, p: float, q: float, r: float) -> tuple[float, float, float, float]:
    """Of a vehicle that does not rotate, with a demanded thrust (0..1) and body rates."""
    airframe, _ = hovering()
    airframe.step_rates(STEP_S, thrust * MAX_THRUST_MPS2, (p, q, r))
    return airframe.rotor_commands


@given(shares, shares, shares, shares)
def test_mixer_output_within_limits(thrust: float, roll: float, pitch: float, yaw: float) -> None:
    rotors = rotor_commands(thrust, 10 * roll, 10 * pitch, 10 * yaw)
    assert all(-1e-9 <= rotor <= 1.0 + 1e-9 for rotor in rotors)
    assert sum(rotors) / 4 <= min(max(thrust, 0.0), 1.0) + 1e-9  # without air mode it adds no thrust


def test_small_demands_are_not_changed() -> None:
    front_right, rear_left, front_left, rear_right = rotor_commands(0.5, 0.5, 0.0, 0.0)
    assert front_left == rear_left > front_right == rear_right  # a roll to the right
    nose_up = rotor_commands(0.5, 0.0, 0.5, 0.0)
    assert nose_up[0] == nose_up[2] > nose_up[1] == nose_up[3]
    clockwise = rotor_commands(0.5, 0.0, 0.0, 0.1)
    assert clockwise[0] == clockwise[1] > clockwise[2] == clockwise[3]


def test_full_thrust_climbs_and_drag_bounds_the_speed() -> None:
    airframe, _ = hovering()
    for _ in range(round(8.0 / STEP_S)):
        airframe.step(STEP_S, 10 * MAX_THRUST_MPS2, 0.0, 0.0, 0.0)
    assert -airframe.velocity[2] == pytest.approx(MAX_THRUST_MPS2 - GRAVITY_MPS2, rel=0.01)


REPORTED = {"LOCAL_POSITION_NED": 20.0, "GPS_RAW_INT": 8.0, "ATTITUDE": 50.0, "HIGHRES_IMU": 50.0}


def holding(
    seconds: float, rates_hz: Mapping[str, float] = REPORTED, **options: Any
) -> tuple[dict[str, list[Any]], list[Any], LockstepVehicle]:
    """A vehicle holding its position in OFFBOARD: its messages by type, and the truth at the same time."""
    vehicle = LockstepVehicle({"onboard": rates_hz}, **options)
    vehicle.take_off(5.0)
    vehicle.set_position(0.0, 0.0, -5.0, yaw_rad=0.0)
    vehicle.step(12.0)
    vehicle.receive()
    reported: dict[str, list[Any]] = {name: [] for name in rates_hz}
    truths = []
    for _ in range(round(seconds / 0.05)):
        vehicle.step(0.05)
        truths.append(vehicle.truth)
        for message in vehicle.receive():
            if message.get_type() in reported:
                reported[message.get_type()].append(message)
    return reported, truths, vehicle


@pytest.fixture(scope="module")
def held() -> list[tuple[dict[str, list[Any]], list[Any], LockstepVehicle]]:
    return [holding(40.0, {"LOCAL_POSITION_NED": 20.0}, seed=seed) for seed in range(4)]


def test_held_position_error_matches_real_vehicle(held: list[Any]) -> None:
    spreads, farthest = [], []
    for reported, _, _ in held:
        positions = [(one.x, one.y, one.z) for one in reported["LOCAL_POSITION_NED"]]
        spreads.append([statistics.pstdev(axis) for axis in zip(*positions, strict=True)])
        farthest.append(max(math.hypot(x, y) for x, y, _ in positions))
    north, east, down = (statistics.mean(axis) for axis in zip(*spreads, strict=True))
    assert 0.15 < north < 0.40  # measured in four runs of 40 s: 0.26, 0.16, 0.23, 0.20
    assert 0.15 < east < 0.40  # 0.25, 0.17, 0.54, 0.32
    assert 0.05 < down < 0.14  # 0.09, 0.09, 0.12, 0.16
    # 0.55, 0.49, 1.28, 0.81
    assert statistics.median(farthest) < 1.0
    assert max(farthest) < 1.3


def test_estimate_differs_slightly_from_truth(held: list[Any]) -> None:
    reported, truths, vehicle = held[3]
    errors = []
    times_s = [truth.time_s for truth in truths]
    for one in reported["LOCAL_POSITION_NED"]:
        then = truths[min(bisect_left(times_s, one.time_boot_ms / 1000), len(truths) - 1)]
        assert abs(then.time_s - one.time_boot_ms / 1000) < 0.06
        errors.append(math.dist((one.x, one.y, one.z), then.position_ned_m))
    assert len(errors) > 30
    assert 0.05 < statistics.mean(errors) < 0.6
    assert max(errors) < 0.7
    assert math.dist(vehicle.vehicle.estimate.position, vehicle.truth.position_ned_m) > 0.0


def errors_in_the_air(seed: int, noise: float = 1.0) -> tuple[NDArray[Any], NDArray[Any]]:
    """Errors of position and velocity, every `DRIFT_STEP_S` of 4 minutes."""
    airframe = Multirotor()
    airframe.position, airframe.on_ground = (0.0, 0.0, -5.0), False
    estimate = Estimate(airframe, seed, noise)
    errors = []
    for _ in range(10_000):
        estimate.update(DRIFT_STEP_S / 3)
        estimate.update(DRIFT_STEP_S / 3)
        estimate.update(DRIFT_STEP_S / 3)
        errors.append((np.subtract(estimate.position, airframe.position), estimate.velocity))
    position, velocity = zip(*errors, strict=True)
    return np.array(position), np.array(velocity)


def test_velocity_error_in_the_air_is_that_of_a_px4() -> None:
    _, velocity = zip(*(errors_in_the_air(seed) for seed in range(4)), strict=True)
    off = np.hypot(*np.concatenate(velocity)[:, :2].T)
    assert 0.25 < np.median(off) < 0.39  # measured in three flights: 0.28, 0.39, 0.25
    assert 0.5 < np.percentile(off, 95) < 0.75  # 0.53, 0.74, 0.50
    for one in velocity:
        assert np.abs(np.diff(one, axis=0)).max() < 0.03
        north = one[:, 0] - one[:, 0].mean()
        for after_s, least, most in ((0.5, 0.93, 1.0), (2.0, 0.5, 0.85), (8.0, -0.4, 0.4)):
            after = round(after_s / DRIFT_STEP_S)  # measured 0.96, 0.53 to 0.79, -0.2 to 0.2
            assert least < np.mean(north[after:] * north[:-after]) / north.var() < most


def test_position_error_is_the_velocity_error_pulled_back() -> None:
    position, velocity = errors_in_the_air(1)
    pulled = position[:-1] / POSITION_TIME_CONSTANT_S
    assert np.diff(position, axis=0) / DRIFT_STEP_S == pytest.approx(velocity[1:] - pulled, abs=1e-9)
    assert np.corrcoef(position[:, 0], velocity[:, 0])[0, 1] > 0.85  # measured 0.91, 0.93, 0.87
    assert 0.12 < position[:, 0].std() < 0.26  # 0.15, 0.25, 0.10


def test_noise_scales_the_errors() -> None:
    position, velocity = errors_in_the_air(2)
    twice_position, twice_velocity = errors_in_the_air(2, noise=2.0)
    assert twice_position == pytest.approx(2.0 * position)
    assert twice_velocity == pytest.approx(2.0 * velocity)
    assert not np.any(errors_in_the_air(2, noise=0.0))


def test_estimate_has_no_steps_and_receiver_is_noisier_than_it() -> None:
    reported, _, _ = holding(20.0, seed=2, gusts_mps=0.0)
    positions = [one.x for one in reported["LOCAL_POSITION_NED"]]
    assert max(abs(b - a) for a, b in itertools.pairwise(positions)) < 0.05
    fixes = [one.lat * 1e-7 / math.degrees(1.0 / 6371000.0) for one in reported["GPS_RAW_INT"]]
    jumps = statistics.pstdev(b - a for a, b in itertools.pairwise(fixes))
    assert 0.1 < jumps < 0.35  # metres; the recorded receiver's: 0.19


def test_rates_and_accelerations_are_noisy_as_recorded() -> None:
    reported, _, _ = holding(10.0, seed=2, gusts_mps=0.0)
    assert 0.02 < statistics.pstdev(one.rollspeed for one in reported["ATTITUDE"]) < 0.06
    assert 0.15 < statistics.pstdev(one.xacc for one in reported["HIGHRES_IMU"]) < 0.6
    assert statistics.mean(one.zacc for one in reported["HIGHRES_IMU"]) == pytest.approx(
        -GRAVITY_MPS2, abs=0.2
    )


def test_on_the_ground_it_hardly_drifts() -> None:
    vehicle = LockstepVehicle({"onboard": REPORTED}, seed=1)
    vehicle.step(4.0)
    vehicle.receive()
    vehicle.step(20.0)
    positions = [one for one in vehicle.receive() if one.get_type() == "LOCAL_POSITION_NED"]
    assert 0.0 < max(abs(one.x) for one in positions) < 0.1


def test_without_noise_estimate_is_truth() -> None:
    reported, truths, vehicle = holding(2.0, seed=4, noise=False)
    truth, last = truths[-1], reported["LOCAL_POSITION_NED"][-1]
    assert (last.x, last.y, last.z) == pytest.approx(truth.position_ned_m, abs=0.05)
    estimate = vehicle.vehicle.estimate
    assert estimate.position == truth.position_ned_m
    assert estimate.quaternion == truth.quaternion
    assert estimate.rates == truth.rates_radps
    assert (estimate.roll_rad, estimate.pitch_rad, estimate.yaw_rad) == pytest.approx(
        (truth.roll_rad, truth.pitch_rad, truth.yaw_rad), abs=1e-12
    )


@pytest.mark.parametrize("noise", [0.3, 0.0])
def test_estimate_offset_moves_vehicle(noise: float) -> None:
    _, _, vehicle = holding(0.5, seed=4, noise=noise, gusts_mps=0.0)
    before = vehicle.truth.position_ned_m
    vehicle.vehicle.estimate.offset = (2.0, 0.0, 0.0)
    vehicle.step(12.0)
    assert vehicle.truth.position_ned_m[0] == pytest.approx(before[0] - 2.0, abs=0.8)
    assert vehicle.vehicle.estimate.position[0] == pytest.approx(0.0, abs=0.5)


def test_attitude_and_quaternion_agree() -> None:
    airframe = Multirotor()
    airframe.set_attitude(0.4, -0.3, 2.0)
    estimate = Estimate(airframe, seed=3)
    for _ in range(500):
        estimate.update(0.004)
    estimate.yaw_offset_rad = 0.5
    other = Multirotor()
    other.set_attitude(estimate.roll_rad, estimate.pitch_rad, estimate.yaw_rad)
    alignment = abs(sum(a * b for a, b in zip(other.quaternion, estimate.quaternion, strict=True)))
    assert alignment == pytest.approx(1.0, abs=1e-4)
    assert estimate.yaw_rad == pytest.approx(2.5, abs=0.05)


def test_demands_reach_true_airframe() -> None:
    airframe = Multirotor()
    estimate = Estimate(airframe, noise=False)
    estimate.step(0.004, 2.0 * GRAVITY_MPS2, 0.0, 0.0, 0.0)
    assert airframe.thrust_mps2 == 0.0
    for _ in range(100):
        airframe.advance(0.004)
    estimate.update(0.004)
    assert estimate.position == airframe.position
    assert estimate.position[2] < -0.1
