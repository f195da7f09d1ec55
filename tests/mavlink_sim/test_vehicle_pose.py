"""A vehicle's pose between its telemetry messages: interpolation, clock, sources."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mavlink_sim.camera.vehicle_pose import BootClock, PoseHistory
from mavlink_sim.lockstep import LockstepVehicle
from mavlink_sim.wire.messages import dialect
from vision.attitude import euler_from_quaternion, quaternion_from_euler

MS = 1_000_000
BOOTED_NS = 7_000_000_000
"""CLOCK_MONOTONIC when the vehicle booted."""
SMALLEST_DELAY_NS = 300_000


def position(boot_ms: int, north: float, velocity: float = 0.0) -> object:
    return dialect.MAVLink_local_position_ned_message(boot_ms, north, 0.0, -2.0, velocity, 0.0, 0.0)


def attitude_quaternion(boot_ms: int, yaw_rad: float) -> object:
    quaternion = quaternion_from_euler(0.0, 0.0, yaw_rad)
    return dialect.MAVLink_attitude_quaternion_message(boot_ms, *quaternion, 0.0, 0.0, 0.0)


def attitude(boot_ms: int, yaw_rad: float) -> object:
    return dialect.MAVLink_attitude_message(boot_ms, 0.0, 0.0, yaw_rad, 0.0, 0.0, 0.0)


def truth(lat: int, lon: int, alt_mm: int, time_us: int = 0) -> object:
    level = [1.0, 0.0, 0.0, 0.0]
    return dialect.MAVLink_hil_state_quaternion_message(
        time_us, level, 0.0, 0.0, 0.0, lat, lon, alt_mm, 100, 0, 0, 0, 0, 0, 0, 0
    )


def history_of(*messages: object) -> PoseHistory:
    history = PoseHistory()
    for message in messages:
        boot_ns = getattr(message, "time_boot_ms", 0) * MS
        history.add(message, BOOTED_NS + boot_ns)
    return history


def test_pose_is_interpolated_between_messages() -> None:
    history = history_of(
        position(1000, 1.0, 2.0),
        attitude_quaternion(1000, 3.0),
        attitude_quaternion(1020, -3.0),
        position(1040, 2.0, 4.0),
    )
    assert history.span_ns == (1000 * MS, 1020 * MS)
    pose = history.at(1010 * MS)
    assert pose.position == pytest.approx((1.25, 0.0, -2.0))
    assert pose.velocity == pytest.approx((2.5, 0.0, 0.0))
    # across the half turn, by the shorter way
    assert abs(euler_from_quaternion(pose.attitude)[2]) == pytest.approx(math.pi)


def test_missing_messages_are_named() -> None:
    assert history_of().missing == ("ATTITUDE_QUATERNION", "LOCAL_POSITION_NED")
    assert history_of(attitude(1000, 0.0)).missing == ("LOCAL_POSITION_NED",)
    assert history_of(attitude(1000, 0.0)).span_ns is None


def test_euler_attitude_serves_only_without_quaternions() -> None:
    history = history_of(position(990, 0.0), attitude(1000, 0.5), position(1010, 0.0))
    assert euler_from_quaternion(history.at(1000 * MS).attitude)[2] == pytest.approx(0.5, abs=1e-6)
    history = history_of(
        position(990, 0.0), attitude_quaternion(1000, 0.1), attitude(1005, 0.9), position(1010, 0.0)
    )
    assert history.span_ns == (1000 * MS, 1000 * MS)
    history.add(attitude(2100, 0.9), BOOTED_NS + 2100 * MS)  # no quaternion for more than a second
    history.add(position(2100, 0.0), BOOTED_NS + 2100 * MS)
    assert euler_from_quaternion(history.at(2100 * MS).attitude)[2] == pytest.approx(0.9, abs=1e-6)


def test_simulator_truth_replaces_the_estimate() -> None:
    history = history_of(position(1000, 5.0), attitude_quaternion(1000, 1.0))
    history.add(truth(473977000, 85456000, 488_000), 50 * MS)
    history.add(position(1033, 6.0), 60 * MS)
    history.add(truth(473977900, 85456000, 487_000), 90 * MS)
    assert history.truth
    # PX4 leaves time_usec at zero: the time is that of the arrival
    assert history.span_ns == (50 * MS, 90 * MS)
    assert history.at(90 * MS).position == pytest.approx((10.007, 0.0, 1.0), abs=1e-3)
    assert history.at(70 * MS).position[2] == pytest.approx(0.5)
    assert history.monotonic_ns(90 * MS) == 90 * MS


def test_clock_restart_resets_history() -> None:
    history = history_of(position(90_000, 1.0), attitude_quaternion(90_000, 0.0))
    history.add(position(500, 3.0), BOOTED_NS + 99_000 * MS)
    history.add(attitude_quaternion(500, 0.0), BOOTED_NS + 99_000 * MS)
    assert history.span_ns == (500 * MS, 500 * MS)
    assert history.monotonic_ns(500 * MS) == BOOTED_NS + 99_000 * MS


def test_non_finite_values_are_no_pose() -> None:
    history = history_of(position(1000, math.nan), attitude_quaternion(1000, math.nan))
    assert history.span_ns is None


def test_clock_uses_least_delayed_message() -> None:
    rng = np.random.default_rng(5)
    clock = BootClock()
    errors = []
    for boot_ms in range(0, 20_000, 10):
        delay_ns = SMALLEST_DELAY_NS + round(rng.exponential(4e6))
        clock.add(boot_ms * MS, BOOTED_NS + boot_ms * MS + delay_ns)
        if boot_ms > 1000:
            errors.append(clock.monotonic_ns(0) - BOOTED_NS)
    assert min(errors) >= SMALLEST_DELAY_NS
    assert max(errors) < SMALLEST_DELAY_NS + 300_000


def test_clock_follows_a_simulation_slower_than_real_time() -> None:
    clock = BootClock()
    for step in range(2000):
        clock.add(step * 9 * MS, BOOTED_NS + step * 10 * MS)
    lag_ns = BOOTED_NS + 1999 * 10 * MS - clock.monotonic_ns(1999 * 9 * MS)
    assert 0 <= lag_ns < 0.45e9  # a tenth of two windows, with a margin


def test_drawn_pose_is_the_vehicles_in_a_manoeuvre() -> None:
    """PX4's onboard rates, jittered arrival: within 5 cm and half a degree of the truth."""
    vehicle = LockstepVehicle(seed=3, noise=False, wind_mps=0.0, gusts_mps=0.0)
    vehicle.take_off(4.0)
    rng = np.random.default_rng(1)
    history = PoseHistory()
    truths: list[tuple[int, tuple[float, float, float], tuple[float, ...]]] = []
    arrivals: list[tuple[int, object]] = []
    setpoint = dialect.MAVLink_set_position_target_local_ned_message(
        0, 1, 1, 1, 0b011111000111, 0, 0, 0, 3.0, -2.0, 0.0, 0, 0, 0, 0, 1.5
    )
    vehicle.repeat(setpoint, 20.0)
    vehicle.step(0.2)
    vehicle.set_mode("OFFBOARD")
    for _ in range(1500):
        vehicle.step(0.004)
        now_ns = round(vehicle.now_s * 1e9)
        truths.append((now_ns, vehicle.truth.position_ned_m, vehicle.truth.quaternion))
        for message in vehicle.receive():
            arrivals.append((now_ns + BOOTED_NS + round(rng.exponential(2e6)), message))
    for arrived_ns, message in sorted(arrivals, key=lambda item: item[0]):
        history.add(message, arrived_ns)
    span = history.span_ns
    assert span is not None
    moved_m = math.dist(truths[0][1], truths[-1][1])
    assert moved_m > 8.0
    errors_m, errors_deg = [], []
    for now_ns, position, quaternion in truths:
        if not span[0] <= now_ns <= span[1]:
            continue
        stamp_ns = history.monotonic_ns(now_ns) - BOOTED_NS  # the frame's stamp, less the boot
        pose = history.at(now_ns)
        errors_m.append(math.dist(pose.position, position) + 3.6 * abs(stamp_ns - now_ns) / 1e9)
        cosine = abs(sum(a * b for a, b in zip(pose.attitude, quaternion, strict=True)))
        errors_deg.append(math.degrees(2 * math.acos(min(cosine, 1.0))))
    assert len(errors_m) > 500
    assert max(errors_m) < 0.05
    assert max(errors_deg) < 0.5
