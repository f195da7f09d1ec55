"""The gimbal: its geometry, and the gimbal protocol around it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mavlink_sim.physics.gimbal import Aim, Gimbal, Target
from mavlink_sim.px4.parameters import Parameters
from mavlink_sim.realtime.options import SimulationOptions
from mavlink_sim.realtime.sim_outputs import camera_turn_rad
from mavlink_sim.realtime.simulation import Simulation
from mavlink_sim.testing import free_udp_ports
from mavlink_sim.wire.messages import dialect
from tests.mavlink_sim.conftest import SIH_FRAME, SimHarness
from vision.attitude import quaternion_from_euler
from vision.rotation import matrix_from_quaternion

NAN = math.nan
LEVEL = (1.0, 0.0, 0.0, 0.0)
GROUND_STATION = (245, 190)
COMPANION = (1, 191)
angles = st.floats(-3.1, 3.1)


def gimbal(**values: float) -> Gimbal:
    return Gimbal(Parameters(values, gimbal=True))


def settled(
    device: Gimbal, attitude: Any = LEVEL, position: Any = (0.0, 0.0, 0.0), landed: bool = False
) -> Gimbal:
    for _ in range(300):
        device.step(0.01, attitude, position, landed)
    return device


def sight(device: Gimbal) -> Any:
    return matrix_from_quaternion(device.quaternion)[:, 0]


@settings(deadline=None, max_examples=30)
@given(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), angles, st.floats(-1.3, 0.2), angles)
def test_locked_angles_independent_of_vehicle(
    roll: float, pitch: float, yaw: float, aim_pitch: float, aim_yaw: float
) -> None:
    device = gimbal(MNT_MAX_PITCH=90, MNT_MIN_PITCH=-180)
    device.point(Target(Aim.ANGLES, aim_pitch, aim_yaw, pitch_locked=True, yaw_locked=True))
    settled(device, quaternion_from_euler(roll, pitch, yaw))
    expected = [
        math.cos(aim_pitch) * math.cos(aim_yaw),
        math.cos(aim_pitch) * math.sin(aim_yaw),
        -math.sin(aim_pitch),
    ]
    assert sight(device) == pytest.approx(expected, abs=1e-6)


@settings(deadline=None, max_examples=30)
@given(st.floats(-0.4, 0.4), st.floats(-0.4, 0.4), angles, st.floats(-1.0, 0.5), st.floats(-1.5, 1.5))
def test_a_locked_pitch_with_a_following_yaw(
    roll: float, pitch: float, yaw: float, aim_pitch: float, pan: float
) -> None:
    device = gimbal(MNT_MAX_PITCH=90, MNT_MIN_PITCH=-135)
    device.point(Target(Aim.ANGLES, aim_pitch, pan, pitch_locked=True))
    settled(device, quaternion_from_euler(roll, pitch, yaw))
    assert device.pan_rad == pytest.approx(pan, abs=1e-6)
    assert device.pitch_rad == pytest.approx(aim_pitch, abs=1e-5)


@settings(deadline=None, max_examples=30)
@given(st.floats(-0.4, 0.4), st.floats(-0.4, 0.4), angles, st.floats(-2.0, 0.7), angles)
def test_its_two_poses_agree(roll: float, pitch: float, yaw: float, tilt: float, pan: float) -> None:
    device = gimbal()
    device.point(Target(Aim.ANGLES, tilt, pan))
    attitude = quaternion_from_euler(roll, pitch, yaw)
    settled(device, attitude)
    assert (device.pan_rad, device.tilt_rad) == pytest.approx((pan, tilt), abs=1e-6)
    whole = matrix_from_quaternion(attitude) @ matrix_from_quaternion(device.body_quaternion)
    assert np.allclose(whole, matrix_from_quaternion(device.quaternion), atol=1e-9)


def test_tracks_location_while_vehicle_passes() -> None:
    device = gimbal()
    device.point(Target(Aim.LOCATION, location=(10.0, 0.0, 0.0)))
    for north in (0.0, 5.0, 10.0, 15.0):
        settled(device, position=(north, -4.0, -8.0))
        towards = np.array([10.0 - north, 4.0, 8.0])
        assert sight(device) == pytest.approx(towards / np.linalg.norm(towards), abs=1e-3)


def test_limits_are_respected() -> None:
    device = gimbal(MNT_MAX_PITCH=30, MNT_MIN_PITCH=-60, MNT_RANGE_YAW=180)
    device.point(Target(Aim.ANGLES, 1.5, 3.0))
    settled(device)
    assert (math.degrees(device.tilt_rad), math.degrees(device.pan_rad)) == pytest.approx((30.0, 90.0))
    device.point(Target(Aim.ANGLES, -1.5, -3.0))
    settled(device)
    assert (math.degrees(device.tilt_rad), math.degrees(device.pan_rad)) == pytest.approx((-60.0, -90.0))
    device = gimbal(MNT_LND_P_MIN=-10)
    device.point(Target(Aim.ANGLES, -1.0, 0.0))
    assert math.degrees(settled(device, landed=True).tilt_rad) == pytest.approx(-10.0)


def test_slews_and_rate_ends_without_repeats() -> None:
    device = gimbal()
    device.point(Target(Aim.ANGLES, -1.5, 0.0))
    for _ in range(50):
        device.step(0.01, LEVEL, (0.0, 0.0, 0.0), False)
    assert math.degrees(device.tilt_rad) == pytest.approx(-60.0, abs=1.0)
    device = gimbal()
    device.point(Target(Aim.ANGLES, yaw_rate_radps=0.2, pitch_rate_radps=-0.1))
    for _ in range(100):
        device.step(0.01, LEVEL, (0.0, 0.0, 0.0), False)
    assert (device.pan_rad, device.tilt_rad) == pytest.approx((0.2, -0.1), abs=0.01)
    assert device.angular_velocity((0.0, 0.0, 0.0))[1] == pytest.approx(-0.1, abs=1e-6)
    settled(device)
    assert device.pan_rad == pytest.approx(0.4, abs=0.01)  # 2 s after the last message it stops


def test_a_rate_against_a_stop_does_not_wind_up() -> None:
    device = gimbal(MNT_MAX_PITCH=20)
    for rate in (0.5, -0.5):
        for _ in range(20):
            device.point(Target(Aim.ANGLES, pitch_rate_radps=rate))
            for _ in range(10):
                device.step(0.01, LEVEL, (0.0, 0.0, 0.0), False)
    assert device.tilt_rad == pytest.approx(math.radians(20.0) - 1.0, abs=0.05)


# ---- the protocol


@pytest.fixture
def steered() -> SimHarness:
    harness = SimHarness(gimbal=True)
    harness.wait_ready()
    assert harness.command(1001, *COMPANION, -1, -1) == [0]
    return harness


def degrees(harness: SimHarness) -> tuple[float, float]:
    device = harness.vehicle.gimbal
    assert device is not None
    return math.degrees(device.pitch_rad), math.degrees(device.yaw_rad)


def test_no_gimbal_by_default(harness: SimHarness) -> None:
    harness.wait_ready()
    assert harness.vehicle.gimbal is None
    assert harness.command(512, 280) == [2]
    assert harness.command(1000, -30, 0, NAN, NAN, 12) == []
    assert harness.received("GIMBAL_MANAGER_STATUS") == []
    assert "MNT_MODE_OUT" not in harness.vehicle.parameters


def test_gimbal_telemetry_is_sent() -> None:
    harness = SimHarness(gimbal=True)
    harness.wait_ready()
    assert harness.command(512, 280) == [0]
    information = harness.received("GIMBAL_MANAGER_INFORMATION")[-1]
    assert information.gimbal_device_id == 1
    assert math.degrees(information.pitch_min) == pytest.approx(-135.0)
    assert math.isnan(information.yaw_max)
    assert harness.command(512, 283) == [0]
    assert harness.received("GIMBAL_DEVICE_INFORMATION")[-1].gimbal_device_id == 1
    harness.forget()
    harness.fly(2.0)
    assert len(harness.received("GIMBAL_DEVICE_ATTITUDE_STATUS")) == pytest.approx(10, abs=1)
    status = harness.received("GIMBAL_MANAGER_STATUS")[-1]
    assert (status.primary_control_sysid, status.primary_control_compid) == (0, 0)


def test_only_the_one_in_control_moves_it() -> None:
    harness = SimHarness(gimbal=True)
    harness.wait_ready()
    assert harness.command(1000, -45, 0, NAN, NAN, 12) == [2]
    assert harness.command(1001, *COMPANION, -1, -1) == [0]
    assert harness.command(1000, -45, 0, NAN, NAN, 12) == [0]
    assert harness.command(1000, 10, 0, NAN, NAN, 12, source=GROUND_STATION, link="gcs") == [2]
    harness.fly(2.0)
    assert degrees(harness)[0] == pytest.approx(-45.0, abs=0.1)
    assert harness.command(1001, *GROUND_STATION, -1, -1, source=GROUND_STATION, link="gcs") == [0]
    assert harness.vehicle.gimbal_manager is not None
    assert harness.vehicle.gimbal_manager.primary == GROUND_STATION
    assert harness.command(1001, -3, -3, -1, -1) == [0]  # not released by another component
    assert harness.vehicle.gimbal_manager.primary == GROUND_STATION
    assert harness.command(1001, -3, -3, -1, -1, source=GROUND_STATION, link="gcs") == [0]
    assert harness.vehicle.gimbal_manager.primary == (0, 0)


def test_messages_move_it_too(steered: SimHarness) -> None:
    q = list(quaternion_from_euler(0.0, -0.5, 0.8))
    steered.send(dialect.MAVLink_gimbal_manager_set_attitude_message(1, 1, 12, 0, q, NAN, NAN, NAN))
    steered.fly(2.0)
    assert degrees(steered) == pytest.approx((math.degrees(-0.5), math.degrees(0.8)), abs=0.1)
    steered.send(dialect.MAVLink_gimbal_manager_set_pitchyaw_message(1, 1, 12, 0, -1.0, 0.0, NAN, NAN))
    steered.fly(2.0)
    assert degrees(steered)[0] == pytest.approx(math.degrees(-1.0), abs=0.1)
    before = degrees(steered)[1]
    message = dialect.MAVLink_gimbal_manager_set_manual_control_message(1, 1, 12, 0, NAN, NAN, 0.0, 1.0)
    for _ in range(20):
        steered.send(message)
        steered.fly(0.05)
    assert degrees(steered)[1] - before == pytest.approx(30.0, abs=2.0)  # MNT_RATE_YAW


def test_roi_location_set_and_cleared(steered: SimHarness) -> None:
    x, y, _ = steered.vehicle.airframe.position
    latitude, longitude, altitude = SIH_FRAME.geographic((x + 20.0, y + 20.0, 0.0))
    position = (0, 0, 0, 0)
    assert steered.command_int(195, position, round(latitude * 1e7), round(longitude * 1e7), altitude) == [0]
    steered.fly(2.0)
    assert degrees(steered)[1] == pytest.approx(45.0, abs=1.0)
    assert steered.command(197) == [0]
    steered.fly(2.0)
    assert degrees(steered) == pytest.approx((0.0, 0.0), abs=0.1)
    assert steered.command(195, 0, 0, 0, 0, NAN, NAN, NAN) == [2]


def test_reported_attitude_is_the_gimbals(steered: SimHarness) -> None:
    assert steered.command(1000, -60, 30, NAN, NAN, 12) == [0]
    steered.fly(2.0)
    steered.forget()
    steered.fly(0.3)
    reported = steered.received("GIMBAL_DEVICE_ATTITUDE_STATUS")[-1]
    assert steered.vehicle.gimbal is not None
    assert list(reported.q) == pytest.approx(steered.vehicle.gimbal.quaternion, abs=1e-6)
    assert reported.flags & 64
    assert steered.received("MOUNT_ORIENTATION")[-1].pitch == pytest.approx(-60.0, abs=0.1)


def test_landing_centres_gimbal_once(steered: SimHarness) -> None:
    assert steered.command(1000, -45, 0, NAN, NAN, 12) == [0]
    steered.take_off()
    steered.forget()
    assert steered.command(21) == [0]
    steered.fly(3.0)
    sent = [m for m in steered.received("COMMAND_LONG") if m.command in (1000, 1001)]
    assert [m.command for m in sent] == [1001, 1000, 1001]
    assert steered.vehicle.gimbal is not None
    assert steered.vehicle.gimbal.tilt_rad == pytest.approx(0.0, abs=0.01)
    assert steered.vehicle.gimbal_manager is not None
    assert steered.vehicle.gimbal_manager.primary == (0, 0)


@pytest.mark.parametrize("equipped", [True, False])
def test_the_camera_of_a_simulation_turns_with_the_gimbal(equipped: bool) -> None:
    onboard_port, gcs_port = free_udp_ports(2)
    options = SimulationOptions(
        onboard_port=onboard_port,
        onboard_bind=0,
        gcs_port=gcs_port,
        gcs_bind=0,
        ready_after_s=0.0,
        gimbal=equipped,
        noise=False,
        console=False,
    )
    with Simulation(options, lambda line: None) as simulation:
        if not equipped:
            assert camera_turn_rad(simulation.vehicle) is None
            return
        vehicle = simulation.vehicle
        assert vehicle.gimbal is not None
        vehicle.gimbal.point(Target(Aim.ANGLES, math.radians(-20.0), math.radians(30.0)))
        vehicle.step(3.0)
        wanted = (0.0, math.radians(-20.0), math.radians(30.0))
        assert camera_turn_rad(vehicle) == pytest.approx(wanted, abs=0.01)
