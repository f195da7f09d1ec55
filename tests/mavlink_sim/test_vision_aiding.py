"""VISION_POSITION_ESTIMATE in the simulated estimator, by the rules of PX4's EKF2."""

from __future__ import annotations

import math
from typing import Any

import pytest

from mavlink_sim.lockstep import LockstepVehicle
from mavlink_sim.testing import QUICK_FLIGHT
from mavlink_sim.wire.messages import dialect

Vector = tuple[float, float, float]


def hovering(control: int = 1, **parameters: Any) -> LockstepVehicle:
    parameters = {**QUICK_FLIGHT, "EKF2_EV_CTRL": control, **parameters}
    vehicle = LockstepVehicle({"onboard": {}}, seed=3, wind_mps=0.0, ready_after_s=0.0, parameters=parameters)
    vehicle.take_off(4.0)
    return vehicle


def send(
    vehicle: LockstepVehicle,
    seconds: float,
    off: Vector = (0.0, 0.0, 0.0),
    *,
    yaw_off: float = 0.0,
    rate_hz: float = 20.0,
    variance: float = 0.01,
    reset_counter: int = 0,
) -> None:
    """Positions that are off the true one."""
    for _ in range(round(seconds * rate_hz)):
        truth = vehicle.truth
        x, y, z = (place + error for place, error in zip(truth.position_ned_m, off, strict=True))
        covariance = [0.0] * 21
        covariance[0] = covariance[6] = covariance[11] = variance
        covariance[20] = 0.0004
        yaw = vehicle.vehicle.airframe.yaw_rad + yaw_off
        vehicle.send(
            dialect.MAVLink_vision_position_estimate_message(
                0, x, y, z, 0.0, 0.0, yaw, covariance, reset_counter
            )
        )
        vehicle.step(1.0 / rate_hz)


def error(vehicle: LockstepVehicle) -> Vector:
    now, truth = vehicle.vehicle.estimate.position, vehicle.truth.position_ned_m
    return (now[0] - truth[0], now[1] - truth[1], now[2] - truth[2])


def test_position_follows_vision_without_gnss_and_stays_valid() -> None:
    vehicle = hovering()
    number = vehicle.vehicle.faults.begin("gps_loss")
    send(vehicle, 12.0, (0.5, -0.3, 0.0))
    assert vehicle.vehicle.vision.position_fused
    assert vehicle.vehicle.estimate.position_valid
    assert error(vehicle)[:2] == pytest.approx((0.5, -0.3), abs=0.1)
    assert vehicle.vehicle.estimate.reset_counter >= 1
    vehicle.vehicle.faults.finish(number)
    vehicle.step(3.0)
    assert math.hypot(*error(vehicle)[:2]) < 0.6  # GNSS again: the drift of the filter alone
    assert not vehicle.vehicle.vision.position_fused


def test_vision_moves_nothing_with_gnss_fused_or_its_bits_off() -> None:
    for control, lose in ((1, False), (0, True), (8, True)):
        vehicle = hovering(control)
        before = error(vehicle)
        if lose:
            vehicle.vehicle.faults.begin("gps_loss")
        send(vehicle, 1.5, (2.0, 0.0, 0.0))
        assert error(vehicle)[:2] == pytest.approx(before[:2], abs=0.3)
        assert not vehicle.vehicle.vision.position_fused


def test_fusion_needs_five_hertz_and_ends_after_the_last_sample() -> None:
    vehicle = hovering()
    vehicle.vehicle.faults.begin("gps_loss")
    send(vehicle, 2.0, rate_hz=4.0)
    assert not vehicle.vehicle.vision.position_fused
    send(vehicle, 1.0, rate_hz=8.0)
    assert vehicle.vehicle.vision.position_fused
    vehicle.step(0.6)
    assert not vehicle.vehicle.vision.position_fused
    vehicle.step(4.0)
    assert vehicle.vehicle.estimate.position_valid  # dead reckoning
    vehicle.step(2.0)
    assert not vehicle.vehicle.estimate.position_valid
    send(vehicle, 0.5)
    assert vehicle.vehicle.estimate.position_valid
    assert vehicle.vehicle.autopilot.position_valid
    assert math.hypot(*error(vehicle)[:2]) < 0.1


def test_outlier_is_rejected_by_the_gate_until_the_timeout() -> None:
    vehicle = hovering()
    vehicle.vehicle.faults.begin("gps_loss")
    send(vehicle, 2.0)
    resets = vehicle.vehicle.estimate.reset_counter
    send(vehicle, 3.0, (4.0, 0.0, 0.0))
    assert abs(error(vehicle)[0]) < 0.3
    assert vehicle.vehicle.estimate.reset_counter == resets
    send(vehicle, 3.0, (4.0, 0.0, 0.0))  # EKF2_NOAID_TOUT: believed then
    assert error(vehicle)[0] == pytest.approx(4.0, abs=0.2)
    assert vehicle.vehicle.estimate.reset_counter == resets + 1


def test_reset_counter_of_the_source_resets_the_estimate() -> None:
    vehicle = hovering()
    vehicle.vehicle.faults.begin("gps_loss")
    send(vehicle, 1.0)
    send(vehicle, 0.2, (4.0, 0.0, 0.0), reset_counter=1)
    assert error(vehicle)[0] == pytest.approx(4.0, abs=0.1)


def test_large_variance_is_trusted_less() -> None:
    errors = []
    for variance in (0.0, 4.0):
        vehicle = hovering()
        vehicle.vehicle.faults.begin("gps_loss")
        send(vehicle, 1.0, variance=variance)
        send(vehicle, 0.3, (0.4, 0.0, 0.0), variance=variance)
        errors.append(error(vehicle)[0])
    assert errors[0] > 0.3
    assert errors[1] < 0.15


def test_yaw_and_height_follow_their_bits() -> None:
    vehicle = hovering(1 | 2 | 8, EKF2_HGT_REF=3)
    vehicle.vehicle.faults.begin("gps_loss")
    send(vehicle, 6.0, (0.0, 0.0, 0.5), yaw_off=0.2)
    estimate = vehicle.vehicle.estimate
    assert vehicle.vehicle.vision.yaw_fused
    assert estimate.yaw_rad - vehicle.vehicle.airframe.yaw_rad == pytest.approx(0.2, abs=0.06)
    assert error(vehicle)[2] == pytest.approx(0.5, abs=0.15)
    other = hovering(1, EKF2_HGT_REF=3)
    other.vehicle.faults.begin("gps_loss")
    send(other, 6.0, (0.0, 0.0, 0.5), yaw_off=0.2)
    assert abs(other.vehicle.estimate.yaw_rad - other.vehicle.airframe.yaw_rad) < 0.05
    assert abs(error(other)[2]) < 0.25


def test_copy_fuses_its_own_samples() -> None:
    vehicle = hovering()
    other = vehicle.copy()
    for each in (vehicle, other):
        each.vehicle.faults.begin("gps_loss")
    send(other, 2.0, (1.0, 0.0, 0.0))
    assert other.vehicle.vision.position_fused
    assert error(other)[0] == pytest.approx(1.0, abs=0.1)
    assert not vehicle.vehicle.vision.position_fused
    assert abs(error(vehicle)[0]) < 0.4
