from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink

from companion.vehicle.state import FlightMode, LandedState, VehicleState
from companion.vehicle.telemetry import TELEMETRY_MESSAGES, apply_message

QUADROTOR = {"type": 2, "autopilot": 12}
HEARTBEAT = {"custom_mode": 0x03040000, "base_mode": 29, "system_status": 3, **QUADROTOR}


@pytest.mark.parametrize(
    ("base_mode", "system_status", "armed", "failsafe"),
    [
        pytest.param(29, 3, False, False, id="standing by"),
        pytest.param(157, 4, True, False, id="flying"),
        pytest.param(145, 5, True, True, id="critical"),
        pytest.param(145, 6, True, True, id="emergency"),
        pytest.param(1, 0, False, False, id="uninitialised"),
    ],
)
def test_heartbeat_sets_armed_and_failsafe(
    base_mode: int, system_status: int, armed: bool, failsafe: bool
) -> None:
    fields = {**HEARTBEAT, "custom_mode": 0x00060000, "base_mode": base_mode, "system_status": system_status}
    state = apply_message(VehicleState(), "HEARTBEAT", fields, 77)
    assert (state.armed, state.failsafe, state.heartbeat_ns) == (armed, failsafe, 77)
    assert state.mode is FlightMode.OFFBOARD


def test_message_without_change_returns_the_same_object() -> None:
    state = apply_message(VehicleState(), "HEARTBEAT", HEARTBEAT, 1)
    assert apply_message(state, "VFR_HUD", {"airspeed": 1.0}, 2) is state
    assert apply_message(state, "CURRENT_MODE", {"custom_mode": 0x03040000}, 2) is state
    assert apply_message(state, "BATTERY_STATUS", {"id": 0, "battery_remaining": -1}, 2) is state
    assert apply_message(state, "BATTERY_STATUS", {"id": 1, "battery_remaining": 50}, 2) is state


@pytest.mark.parametrize("number", [0x01030000, 0x0B040000, 0x12040000], ids=["orbit", "external", "last"])
def test_current_mode_without_a_name_here_is_another_mode(number: int) -> None:
    state = apply_message(VehicleState(), "HEARTBEAT", HEARTBEAT, 1)
    state = apply_message(state, "CURRENT_MODE", {"custom_mode": number, "intended_custom_mode": number}, 2)
    assert (state.mode, state.custom_mode) == (FlightMode.UNKNOWN, number)
    assert state.intended_beside is state.intended_mode is FlightMode.UNKNOWN


def test_empty_current_mode_is_ignored() -> None:
    state = apply_message(VehicleState(), "HEARTBEAT", HEARTBEAT, 1)
    state = apply_message(state, "CURRENT_MODE", {"custom_mode": 0x06040000}, 2)
    assert state.mode is FlightMode.LAND
    assert apply_message(state, "CURRENT_MODE", {"custom_mode": 0}, 3).mode is FlightMode.LAND


@pytest.mark.parametrize(
    ("number", "landed"),
    [
        (0, LandedState.UNKNOWN),
        (1, LandedState.ON_GROUND),
        (2, LandedState.IN_AIR),
        (3, LandedState.TAKING_OFF),
        (4, LandedState.LANDING),
        (99, LandedState.UNKNOWN),
    ],
)
def test_landed_state_is_decoded(number: int, landed: LandedState) -> None:
    state = apply_message(VehicleState(), "EXTENDED_SYS_STATE", {"landed_state": number, "vtol_state": 0}, 5)
    assert state.landed is landed


@pytest.mark.parametrize("bad", [None, math.nan, math.inf])
@pytest.mark.parametrize("field", ["x", "y", "z", "vx", "vy", "vz"])
def test_position_with_a_non_finite_field_is_ignored(field: str, bad: float | None) -> None:
    """NaN from pymavlink; null in MAVSDK's JSON."""
    whole = dict.fromkeys(("time_boot_ms", "x", "y", "z", "vx", "vy", "vz"), 1.0)
    before = apply_message(VehicleState(), "LOCAL_POSITION_NED", whole, 5)
    assert apply_message(before, "LOCAL_POSITION_NED", whole | {field: bad}, 9) is before


def test_attitude_is_normalised_or_ignored() -> None:
    rates = {"rollspeed": 0.1, "pitchspeed": 0.2, "yawspeed": 0.3}
    state = apply_message(
        VehicleState(), "ATTITUDE_QUATERNION", {"q1": 1.01, "q2": 0, "q3": 0, "q4": 0, **rates}, 5
    )
    assert state.attitude == (1.0, 0.0, 0.0, 0.0)
    assert state.angular_velocity_frd_radps == (0.1, 0.2, 0.3)
    for w in (0.0, None, math.nan, 50.0):
        assert (
            apply_message(state, "ATTITUDE_QUATERNION", {"q1": w, "q2": 0, "q3": 0, "q4": 0, **rates}, 9)
            is state
        )


def test_home_altitude_without_local_position() -> None:
    fields = {"altitude": 488_123, "x": None, "y": None, "z": None}
    state = apply_message(VehicleState(), "HOME_POSITION", fields, 5)
    assert state.home_altitude_amsl_m == pytest.approx(488.123)
    assert state.home_position_ned_m is None
    moved = apply_message(state, "HOME_POSITION", {"altitude": 488_123, "x": 1.0, "y": 2.0, "z": -0.5}, 6)
    assert moved.home_position_ned_m == (1.0, 2.0, -0.5)


@pytest.mark.parametrize(
    ("health", "remaining", "ready", "fraction"),
    [(0x1000_0000, 80, True, 0.8), (0x0FFF_FFFF, 0, False, 0.0), (0, -1, False, None), (0, 120, False, 1.0)],
)
def test_sys_status_sets_readiness_and_battery(
    health: int, remaining: int, ready: bool, fraction: float | None
) -> None:
    fields = {
        "onboard_control_sensors_present": 0,
        "onboard_control_sensors_health": health,
        "battery_remaining": remaining,
    }
    state = apply_message(VehicleState(), "SYS_STATUS", fields, 5)
    assert (state.ready_to_arm, state.battery_fraction) == (ready, fraction)


@pytest.mark.parametrize(
    ("autopilot", "enabled", "alters"),
    [
        ("ArduPilot", mavlink.MAV_SYS_STATUS_GEOFENCE, True),
        ("ArduPilot", mavlink.MAV_SYS_STATUS_SENSOR_PROXIMITY, True),
        ("ArduPilot", mavlink.MAV_SYS_STATUS_SENSOR_GPS, False),
        ("PX4", mavlink.MAV_SYS_STATUS_GEOFENCE, False),
    ],
)
def test_ardupilots_avoidance_alters_velocities(autopilot: str, enabled: int, alters: bool) -> None:
    fields = {
        "onboard_control_sensors_present": 0,
        "onboard_control_sensors_enabled": enabled,
        "onboard_control_sensors_health": 0,
        "battery_remaining": 80,
    }
    state = apply_message(VehicleState(autopilot=autopilot), "SYS_STATUS", fields, 5)
    assert state.alters_velocities is alters


@given(name=st.sampled_from(sorted(TELEMETRY_MESSAGES - {"CURRENT_MODE"})), payload=st.binary(max_size=60))
def test_apply_message_survives_any_payload(name: str, payload: bytes) -> None:
    definition = getattr(mavlink, f"MAVLink_{name.lower()}_message")
    size = definition.unpacker.size
    values = definition.unpacker.unpack(payload[:size].ljust(size, b"\0"))
    fields = {}
    for field, index, count in zip(
        definition.fieldnames,
        definition.orders,
        (definition.lengths[order] for order in definition.orders),
        strict=True,
    ):
        first = sum(definition.lengths[:index])
        fields[field] = values[first] if count == 1 else list(values[first : first + count])
    state = apply_message(VehicleState(), name, fields, 5)
    for vector in (state.position_ned_m, state.velocity_ned_mps, state.attitude, state.home_position_ned_m):
        assert vector is None or all(math.isfinite(value) for value in vector)
    if state.gimbal is not None and state.gimbal.attitude is not None:
        assert math.hypot(*state.gimbal.attitude) == pytest.approx(1.0)


def at(boot_ms: int, north_m: float, velocity_mps: float = 3.0) -> dict[str, float]:
    moved = {"x": north_m, "y": 0.0, "z": -5.0, "vx": velocity_mps, "vy": 0.0, "vz": 0.0}
    return {"time_boot_ms": boot_ms, **moved}


def odometry(time_us: int, north_m: float, counter: int) -> dict[str, float]:
    return {"time_usec": time_us, "reset_counter": counter, "frame_id": 1, "x": north_m, "y": 0.0, "z": -5.0}


def test_position_jump_is_a_reset_that_keeps_the_position() -> None:
    home = {"altitude": 10_000, "x": 1.0, "y": 0.0, "z": 0.0}
    state = apply_message(VehicleState(), "HOME_POSITION", home, 0)
    for boot_ms in range(0, 200, 20):
        state = apply_message(state, "LOCAL_POSITION_NED", at(boot_ms, 0.003 * boot_ms), boot_ms)
    state = apply_message(state, "LOCAL_POSITION_NED", at(200, 0.6 + 7.0), 200)
    assert state.position_ned_m == pytest.approx((0.6, 0.0, -5.0))
    assert state.reset_offset_ned_m == pytest.approx((7.0, 0.0, 0.0))
    assert state.reset_count == 1
    # Home keeps its coordinates in the autopilot's frame, so it is another point on the ground now.
    assert state.home_position_ned_m == pytest.approx((-6.0, 0.0, 0.0))
    state = apply_message(state, "HOME_POSITION", {**home, "x": 8.0}, 210)
    assert state.home_position_ned_m == pytest.approx((1.0, 0.0, 0.0))
    state = apply_message(state, "LOCAL_POSITION_NED", at(220, 0.66 + 7.0), 220)
    assert state.position_ned_m == pytest.approx((0.66, 0.0, -5.0))
    assert state.reset_count == 1


def test_gap_is_not_a_reset() -> None:
    """Below a second if the velocities explain the displacement; a longer one cannot be measured."""
    state = apply_message(VehicleState(), "LOCAL_POSITION_NED", at(0, 0.0), 0)
    state = apply_message(state, "LOCAL_POSITION_NED", at(900, 2.7), 1)
    state = apply_message(state, "LOCAL_POSITION_NED", at(9000, 80.0), 2)
    assert state.reset_count == 0


@pytest.mark.parametrize("first", ["LOCAL_POSITION_NED", "ODOMETRY"])
def test_reset_in_both_messages_is_counted_once(first: str) -> None:
    state = apply_message(VehicleState(), "LOCAL_POSITION_NED", at(100, 0.3), 0)
    state = apply_message(state, "ODOMETRY", odometry(100_000, 0.3, 5), 0)
    new = [("LOCAL_POSITION_NED", at(120, 4.36)), ("ODOMETRY", odometry(120_000, 4.36, 6))]
    for name, fields in new if first == "LOCAL_POSITION_NED" else reversed(new):
        state = apply_message(state, name, fields, 1)
    assert state.reset_count == 1
    assert state.position_ned_m == pytest.approx((0.36, 0.0, -5.0))


def test_small_reset_is_detected_by_its_counter() -> None:
    state = apply_message(VehicleState(), "LOCAL_POSITION_NED", at(100, 0.3), 0)
    state = apply_message(state, "ODOMETRY", odometry(100_000, 0.3, 255), 0)
    jumped = apply_message(state, "ODOMETRY", odometry(120_000, 0.36 + 0.4, 0), 1)
    assert jumped.reset_offset_ned_m == pytest.approx((0.4, 0.0, 0.0))
    assert apply_message(state, "ODOMETRY", odometry(120_000, 0.36 + 0.4, 255), 1).reset_count == 0


@pytest.mark.parametrize(
    ("flags", "valid"),
    [
        pytest.param(895, True, id="PX4 in flight"),
        pytest.param(831, True, id="ArduPilot in flight"),
        pytest.param(1 | 4 | 32 | 64 | 128, False, id="no horizontal aiding"),
        pytest.param(164, False, id="PX4 starting"),
        pytest.param(1 | 2 | 4 | 8 | 32, True, id="optical flow: relative position"),
    ],
)
def test_estimator_flags_set_position_valid(flags: int, valid: bool) -> None:
    state = apply_message(VehicleState(), "ESTIMATOR_STATUS", {"flags": flags}, 1)
    assert state.position_valid is valid


def test_a_position_that_stands_still_at_speed_ages() -> None:
    state = apply_message(VehicleState(), "LOCAL_POSITION_NED", at(1_000, 5.0), 10)
    frozen = apply_message(state, "LOCAL_POSITION_NED", at(1_033, 5.0), 20)
    assert frozen.position_ns == 10
    assert apply_message(frozen, "LOCAL_POSITION_NED", at(1_066, 5.2), 30).position_ns == 30
    resting = apply_message(VehicleState(), "LOCAL_POSITION_NED", at(1_000, 5.0, 0.0), 10)
    assert apply_message(resting, "LOCAL_POSITION_NED", at(1_033, 5.0, 0.0), 20).position_ns == 20


def test_an_attitude_that_stands_still_while_turning_ages() -> None:
    def turned(yaw_rad: float, rate_radps: float) -> dict[str, float]:
        rates = {"rollspeed": 0.0, "pitchspeed": 0.0, "yawspeed": rate_radps}
        return {"q1": math.cos(yaw_rad / 2), "q2": 0.0, "q3": 0.0, "q4": math.sin(yaw_rad / 2)} | rates

    state = apply_message(VehicleState(), "ATTITUDE_QUATERNION", turned(0.3, 1.0), 10)
    assert apply_message(state, "ATTITUDE_QUATERNION", turned(0.3, 1.0), 20).attitude_ns == 10
    assert apply_message(state, "ATTITUDE_QUATERNION", turned(0.3, 0.0), 20).attitude_ns == 20
    assert apply_message(state, "ATTITUDE_QUATERNION", turned(0.31, 1.0), 20).attitude_ns == 20


def test_both_battery_messages_set_the_stamp() -> None:
    state = apply_message(VehicleState(), "BATTERY_STATUS", {"id": 0, "battery_remaining": 40}, 5)
    assert (state.battery_fraction, state.battery_ns) == (0.4, 5)
    sensors = {"onboard_control_sensors_present": 0, "onboard_control_sensors_health": 0}
    fields = {**sensors, "battery_remaining": 39}
    state = apply_message(state, "SYS_STATUS", fields, 9)
    assert (state.battery_fraction, state.battery_ns) == (0.39, 9)
    unknown = apply_message(state, "BATTERY_STATUS", {"id": 0, "battery_remaining": -1}, 20)
    assert unknown.battery_ns == 9
