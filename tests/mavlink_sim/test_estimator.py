"""The vehicle's estimate of its motion, and its telemetry."""

import itertools
import math
import statistics
from typing import Any

import pytest

from mavlink_sim import LockstepVehicle
from mavlink_sim.physics.airframe import GRAVITY_MPS2, Multirotor
from mavlink_sim.physics.estimator import Estimate

REPORTED = {"LOCAL_POSITION_NED": 20.0, "GPS_RAW_INT": 8.0, "ATTITUDE": 50.0, "HIGHRES_IMU": 50.0}


def holding(seconds: float, **options: Any) -> tuple[dict[str, list[Any]], list[Any], LockstepVehicle]:
    """A vehicle holding its position in OFFBOARD: its messages by type, and the truth at the same time."""
    vehicle = LockstepVehicle({"onboard": REPORTED}, **options)
    vehicle.take_off(5.0)
    vehicle.set_position(0.0, 0.0, -5.0, yaw_rad=0.0)
    vehicle.step(12.0)
    vehicle.receive()
    reported: dict[str, list[Any]] = {name: [] for name in REPORTED}
    truths = []
    for _ in range(round(seconds / 0.05)):
        vehicle.step(0.05)
        truths.append(vehicle.truth)
        for message in vehicle.receive():
            if message.get_type() in reported:
                reported[message.get_type()].append(message)
    return reported, truths, vehicle


def test_held_position_error_matches_real_vehicle() -> None:
    spreads, farthest = [], []
    for seed in range(6):
        reported, _, _ = holding(40.0, seed=seed)
        positions = [(one.x, one.y, one.z) for one in reported["LOCAL_POSITION_NED"]]
        spreads.append([statistics.pstdev(axis) for axis in zip(*positions, strict=True)])
        farthest.append(max(math.hypot(x, y) for x, y, _ in positions))
    north, east, down = (statistics.mean(axis) for axis in zip(*spreads, strict=True))
    assert 0.15 < north < 0.37  # measured 0.26
    assert 0.15 < east < 0.37  # 0.25
    assert 0.05 < down < 0.14  # 0.09
    # measured 0.55 in one run of 40 s; of the vehicle's runs one in six reaches 0.83
    assert statistics.median(farthest) < 0.7
    assert max(farthest) < 0.9


def test_estimate_differs_slightly_from_truth() -> None:
    reported, truths, vehicle = holding(40.0, seed=4)
    errors = []
    for one in reported["LOCAL_POSITION_NED"]:
        then = min(truths, key=lambda truth: abs(truth.time_s - one.time_boot_ms / 1000))
        assert abs(then.time_s - one.time_boot_ms / 1000) < 0.06
        errors.append(math.dist((one.x, one.y, one.z), then.position_ned_m))
    assert len(errors) > 30
    assert 0.05 < statistics.mean(errors) < 0.6
    assert max(errors) < 0.7
    assert math.dist(vehicle.vehicle.estimate.position, vehicle.truth.position_ned_m) > 0.0


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


@pytest.mark.parametrize("noise", [True, False])
def test_estimate_offset_moves_vehicle(noise: bool) -> None:
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
