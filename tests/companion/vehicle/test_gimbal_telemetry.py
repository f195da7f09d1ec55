"""A gimbal's messages in the state: the quaternion's frames, NaN, several gimbals."""

from __future__ import annotations

import math
from typing import Any

import pytest

from companion.vehicle.gimbal import GimbalAim, GimbalState, YawFrame
from companion.vehicle.gimbal_telemetry import from_gimbal_device
from companion.vehicle.state import VehicleState
from companion.vehicle.telemetry import apply_message
from companion.vehicle.telemetry_state import TelemetryState
from tests.companion.vehicle.fake_autopilot import gimbal_of
from vision.attitude import quaternion_from_euler

NEUTRAL, YAW_LOCK, IN_VEHICLE, IN_EARTH = 2, 16, 32, 64
INFORMATION, STATUS, ATTITUDE = (
    "GIMBAL_MANAGER_INFORMATION",
    "GIMBAL_MANAGER_STATUS",
    "GIMBAL_DEVICE_ATTITUDE_STATUS",
)


def attitude(
    flags: int = IN_EARTH, pitch_deg: float = -30.0, yaw_deg: float = 0.0, device: int = 1
) -> dict[str, Any]:
    q = quaternion_from_euler(0.0, math.radians(pitch_deg), math.radians(yaw_deg))
    return {"flags": flags, "q": list(q), "gimbal_device_id": device}


def information(device: int = 1, low: float | None = -1.5, high: float | None = 0.5) -> dict[str, Any]:
    return {"gimbal_device_id": device, "pitch_min": low, "pitch_max": high}


@pytest.mark.parametrize(
    ("flags", "frame"),
    [
        pytest.param(IN_EARTH, YawFrame.NORTH, id="north"),
        pytest.param(IN_VEHICLE, YawFrame.NOSE, id="nose"),
        pytest.param(IN_VEHICLE | YAW_LOCK, YawFrame.NOSE, id="flag before the lock"),
        pytest.param(IN_EARTH | NEUTRAL | YAW_LOCK, YawFrame.NORTH, id="flag before neutral"),
        pytest.param(YAW_LOCK, YawFrame.NORTH, id="no flag: locked is north"),
        pytest.param(0, YawFrame.NOSE, id="no flag: not locked is the nose"),
        pytest.param(NEUTRAL, YawFrame.NOSE, id="no flag: neutral is the nose"),
        pytest.param(NEUTRAL | YAW_LOCK | 12, None, id="PX4 on servo outputs: ambiguous"),
        pytest.param(IN_EARTH | IN_VEHICLE, None, id="both flags: invalid"),
    ],
)
def test_yaw_frame_follows_from_the_flags(flags: int, frame: YawFrame | None) -> None:
    gimbal = apply_message(VehicleState(), ATTITUDE, attitude(flags), 5).gimbal
    assert gimbal is not None
    if frame is None:
        assert gimbal.attitude is None
        assert "ambiguous" in (gimbal.why_not_looking(5) or "")
        return
    assert (gimbal.yaw_frame, gimbal.attitude_ns) == (frame, 5)
    assert gimbal.why_not_looking(5) is None
    assert gimbal.pitch_rad is not None
    assert math.degrees(gimbal.pitch_rad) == pytest.approx(-30.0)


def test_stale_attitude_is_reported() -> None:
    gimbal = gimbal_of(apply_message(VehicleState(), ATTITUDE, attitude(), 1_000_000_000))
    assert gimbal.attitude_fresh(1_500_000_000)
    assert not gimbal.attitude_fresh(1_600_000_000)
    assert "2.0 s" in (gimbal.why_not_looking(3_000_000_000) or "")
    assert "not received" in (GimbalState().why_not_looking(0) or "")


@pytest.mark.parametrize("q", [None, [None] * 4, [0.0] * 4, [math.nan, 0, 0, 0], [1.0, 0.0], 0])
def test_invalid_quaternion_is_ignored(q: object) -> None:
    before = apply_message(VehicleState(), ATTITUDE, attitude(), 5)
    assert apply_message(before, ATTITUDE, {**attitude(), "q": q}, 9) is before


def test_unreported_end_stops_are_infinite() -> None:
    """MAVSDK passes None for NaN, which JSON lacks."""
    for nothing in (None, math.nan):
        gimbal = gimbal_of(apply_message(VehicleState(), INFORMATION, information(1, nothing, nothing), 5))
        assert gimbal.reaches(-1.57)
        assert gimbal.reaches(1.57)
    gimbal = gimbal_of(apply_message(VehicleState(), INFORMATION, information(), 5))
    assert [gimbal.reaches(pitch) for pitch in (-1.6, -1.5, 0.5, 0.6)] == [False, True, True, False]


def test_first_of_several_gimbals_is_used() -> None:
    state = apply_message(VehicleState(), INFORMATION, information(1), 5)
    state = apply_message(state, STATUS, status(1, 245), 6)
    for name, fields in (
        (INFORMATION, information(2, -0.1, 0.1)),
        (STATUS, status(2, 9)),
        (ATTITUDE, attitude(device=2)),
    ):
        assert apply_message(state, name, fields, 9) is state
    assert (gimbal_of(state).primary_control, gimbal_of(state).status_ns) == ((245, 190), 6)
    assert gimbal_of(apply_message(state, ATTITUDE, attitude(device=0), 9)).attitude_ns == 9


def test_attitude_of_another_gimbal_component_is_ignored() -> None:
    state = apply_message(VehicleState(), INFORMATION, information(154), 5)
    assert apply_message(state, ATTITUDE, attitude(device=171), 9) is state
    for device in (0, 154):
        assert gimbal_of(apply_message(state, ATTITUDE, attitude(device=device), 9)).attitude_ns == 9


def status(device: int, system: int) -> dict[str, Any]:
    return {
        "gimbal_device_id": device,
        "primary_control_sysid": system,
        "primary_control_compid": 190,
    }


def test_gimbal_device_is_the_managers_component() -> None:
    attached, separate = (apply_message(VehicleState(), INFORMATION, information(n), 5) for n in (1, 154))
    assert from_gimbal_device(separate, ATTITUDE, 154)
    assert not from_gimbal_device(separate, ATTITUDE, 171)
    assert not from_gimbal_device(separate, "HEARTBEAT", 154)
    assert not from_gimbal_device(attached, ATTITUDE, 154)
    assert not from_gimbal_device(VehicleState(), ATTITUDE, 154)


def test_old_stamp_of_gimbal_information_keeps_the_clock() -> None:
    """PX4 resends this with the stamp of its first sending, minutes ago."""
    telemetry = TelemetryState("test", lambda: None)
    telemetry.clock.answer(1_000_000_000, 500_000_000_000, 1_001_000_000)
    assert telemetry.clock.offset(1_001_000_000) is not None
    telemetry.apply(INFORMATION, {**information(), "time_boot_ms": 1_000})
    assert telemetry.clock.offset(1_001_000_000) is not None
    assert gimbal_of(telemetry.state).information_ns > 0


@pytest.mark.parametrize("frame_flags", [IN_EARTH, IN_VEHICLE])
def test_angle_between_gimbal_and_aim(frame_flags: int) -> None:
    heading = math.radians(70.0)
    yaw_deg = 70.0 + 20.0 if frame_flags == IN_EARTH else 20.0
    gimbal = gimbal_of(apply_message(VehicleState(), ATTITUDE, attitude(frame_flags, -30.0, yaw_deg), 5))
    exact = GimbalAim(math.radians(-30.0), math.radians(20.0))
    assert gimbal.off_rad(exact, heading) == pytest.approx(0.0, abs=1e-6)
    assert gimbal.off_rad(GimbalAim(math.radians(-35.0), exact.yaw_rad), heading) == pytest.approx(
        math.radians(5.0)
    )
    from_north = GimbalAim(exact.pitch_rad, math.radians(90.0), YawFrame.NORTH)
    assert gimbal.off_rad(from_north, heading) == pytest.approx(0.0, abs=1e-6)
