"""Applies one message of the autopilot to the vehicle state. Pure: no link, no clock."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from companion.vehicle.gimbal_telemetry import GIMBAL_STEPS
from companion.vehicle.ground import GroundLevel, may_measure, range_below_m
from companion.vehicle.px4_modes import mode_of_custom_mode
from companion.vehicle.state import FlightMode, LandedState, Odometry, Vector3, VehicleState, with_fields
from companion.vehicle.vehicle_type import VtolState

Fields = Mapping[str, Any]

_SAFETY_ARMED = 128  # MAV_MODE_FLAG
_STATE_CRITICAL, _STATE_EMERGENCY = 5, 6  # MAV_STATE
_PREARM_CHECK = 0x1000_0000  # MAV_SYS_STATUS_PREARM_CHECK
_RC_RECEIVER = 0x1_0000  # MAV_SYS_STATUS_SENSOR_RC_RECEIVER: a remote control or a joystick
_AVOIDANCE = 0x10_0000 | 0x400_0000  # MAV_SYS_STATUS_GEOFENCE, MAV_SYS_STATUS_SENSOR_PROXIMITY
_LOCAL_NED = 1  # MAV_FRAME
# ESTIMATOR_STATUS_FLAGS; EKF_STATUS_REPORT has the same bits. CONST_POS_MODE (128) is not a fault: PX4 sets
# it at rest with a valid position.
_VELOCITY_HORIZ, _POS_HORIZ, _POS_VERT = 2, 8 | 16, 32 | 64
# A position or an attitude that is exactly the one before, with these rates of its own, is frozen.
_MOVING_MPS, _TURNING_RADPS = 1.0, 0.3
# A position this far from the one predicted by the previous position and the mean velocity is a reset; PX4's
# estimate in its own simulation deviated by 0.03 m at most. Over a gap, accelerations of up to 10 m/s2 that
# neither velocity shows are allowed for; over more than a second no reset can be measured.
_JUMP_M = 0.5
_JUMP_MPS2 = 2.5
_LONGEST_GAP_S = 1.0
# Of a reset reported by the counter: smaller jumps are the estimate's own drift.
_MIN_RESET_M = 0.2
_LANDED = {
    1: LandedState.ON_GROUND,
    2: LandedState.IN_AIR,
    3: LandedState.TAKING_OFF,
    4: LandedState.LANDING,
}
_VTOL_STATES = {state.value: state for state in VtolState}


def apply_message(state: VehicleState, name: str, fields: Fields, now_ns: int) -> VehicleState:
    """Return the snapshot after a message.

    Args:
        name: the message's name, as in MAVLink common.
        fields: its fields by name; NaN may be None (as in JSON).
        now_ns: CLOCK_MONOTONIC of the measurement or arrival.

    Returns:
        A new snapshot, or the same object when the message changes nothing.
    """
    step = _STEPS.get(name)
    return state if step is None else step(state, fields, now_ns)


def _heartbeat(state: VehicleState, fields: Fields, now_ns: int) -> VehicleState:
    return with_fields(
        state,
        heartbeat_ns=now_ns,
        armed=bool(fields["base_mode"] & _SAFETY_ARMED),
        mode=_mode(fields),
        custom_mode=fields["custom_mode"],
        failsafe=fields["system_status"] in (_STATE_CRITICAL, _STATE_EMERGENCY),
        mav_type=fields["type"],
        mav_autopilot=fields["autopilot"],
    )


def _current_mode(state: VehicleState, fields: Fields, _now_ns: int) -> VehicleState:
    mode = _mode(fields)
    if mode is FlightMode.UNKNOWN and not fields.get("custom_mode"):
        return state  # not filled in yet. A number without a name here is another mode than the one before
    intended, beside = state.intended_mode, state.intended_beside
    if "intended_custom_mode" in fields:
        intended, beside = mode_of_custom_mode(fields["intended_custom_mode"]), mode
    number = fields.get("custom_mode", state.custom_mode)
    new = (mode, number, intended, beside)
    if new == (state.mode, state.custom_mode, state.intended_mode, state.intended_beside):
        return state
    return with_fields(state, mode=mode, custom_mode=number, intended_mode=intended, intended_beside=beside)


def _extended_sys_state(state: VehicleState, fields: Fields, now_ns: int) -> VehicleState:
    landed = _LANDED.get(fields["landed_state"], LandedState.UNKNOWN)
    vtol_state = _VTOL_STATES.get(fields["vtol_state"])
    return with_fields(state, landed=landed, vtol_state=vtol_state)


def _attitude_quaternion(state: VehicleState, fields: Fields, now_ns: int) -> VehicleState:
    w, x, y, z = (_number(fields[key]) for key in ("q1", "q2", "q3", "q4"))
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    rates = _vector(fields, "rollspeed", "pitchspeed", "yawspeed")
    if not 0.5 < norm < 2.0 or rates is None:  # NaN also fails the comparison
        return state
    attitude = (w / norm, x / norm, y / norm, z / norm)
    if attitude == state.attitude and math.hypot(*rates) > _TURNING_RADPS:
        return state  # frozen: it ages
    return with_fields(state, attitude_ns=now_ns, attitude=attitude, angular_velocity_frd_radps=rates)


def _local_position_ned(state: VehicleState, fields: Fields, now_ns: int) -> VehicleState:
    position, velocity = _vector(fields, "x", "y", "z"), _vector(fields, "vx", "vy", "vz")
    if position is None or velocity is None:
        return state
    boot_ms = fields["time_boot_ms"]
    dt_s = (boot_ms - state.position_boot_ms) * 1e-3
    position_ned_m = _subtract(position, state.reset_offset_ned_m)
    if position_ned_m == state.position_ned_m and math.hypot(*velocity) > _MOVING_MPS:
        return state  # frozen: it ages
    if state.position_ned_m is not None and state.velocity_ned_mps is not None:
        jump = _jump(state.position_ned_m, state.velocity_ned_mps, position_ned_m, velocity, dt_s)
        if jump is not None and math.hypot(*jump) > _JUMP_M + _JUMP_MPS2 * dt_s * dt_s:
            state, position_ned_m = _reset_by(state, jump), _subtract(position_ned_m, jump)
    return with_fields(
        state,
        position_ns=now_ns,
        position_boot_ms=boot_ms,
        position_ned_m=position_ned_m,
        velocity_ned_mps=velocity,
    )


def _odometry(state: VehicleState, fields: Fields, _now_ns: int) -> VehicleState:
    """Detect, by the reset counter, a reset that LOCAL_POSITION_NED has not shown.

    If LOCAL_POSITION_NED has shown it before, it is in the offset already, and no jump is left.
    """
    position, velocity = _vector(fields, "x", "y", "z"), state.velocity_ned_mps
    if position is None or velocity is None or fields["frame_id"] != _LOCAL_NED:
        return state
    position_ned_m = _subtract(position, state.reset_offset_ned_m)
    seen = Odometry(fields["time_usec"], fields["reset_counter"], position_ned_m, velocity)
    last, state = state.odometry, with_fields(state, odometry=seen)
    if last is None or last.reset_counter == seen.reset_counter:
        return state
    dt_s = (seen.time_us - last.time_us) * 1e-6
    jump = _jump(last.position_ned_m, last.velocity_ned_mps, position_ned_m, velocity, dt_s)
    if jump is None or math.hypot(*jump) < _MIN_RESET_M:
        return state
    return _reset_by(
        with_fields(state, odometry=replace(seen, position_ned_m=_subtract(position_ned_m, jump))), jump
    )


def _jump(
    before: Vector3, velocity: Vector3, after: Vector3, velocity_after: Vector3, dt_s: float
) -> Vector3 | None:
    """Return the displacement that the velocities do not explain; None after too long a gap."""
    if abs(dt_s) > _LONGEST_GAP_S:
        return None
    north, east, down = (
        b - a - (u + v) / 2.0 * dt_s
        for a, u, b, v in zip(before, velocity, after, velocity_after, strict=True)
    )
    return (north, east, down)


def _reset_by(state: VehicleState, jump: Vector3) -> VehicleState:
    """Add a reset to the offset; home keeps its autopilot coordinates, so it moves here."""
    north, east, down = (o + j for o, j in zip(state.reset_offset_ned_m, jump, strict=True))
    home = state.home_position_ned_m
    return with_fields(
        state,
        reset_count=state.reset_count + 1,
        reset_offset_ned_m=(north, east, down),
        home_position_ned_m=None if home is None else _subtract(home, jump),
    )


def _subtract(position: Vector3, offset: Vector3) -> Vector3:
    return (position[0] - offset[0], position[1] - offset[1], position[2] - offset[2])


def _estimator_status(state: VehicleState, fields: Fields, _now_ns: int) -> VehicleState:
    """Apply flags and accuracies; they hold until the next message, since a missing stream is requested."""
    flags = fields["flags"]
    valid = all(flags & group for group in (_VELOCITY_HORIZ, _POS_HORIZ, _POS_VERT))
    horizontal, vertical = (
        _positive(fields.get(f"pos_{axis}_accuracy")) for axis in ("horiz", "vert")
    )  # EKF_STATUS_REPORT has none
    new = (valid, horizontal, vertical)
    if new == (state.position_valid, state.horizontal_sigma_m, state.vertical_sigma_m):
        return state
    return with_fields(state, position_valid=valid, horizontal_sigma_m=horizontal, vertical_sigma_m=vertical)


def _distance_sensor(state: VehicleState, fields: Fields, now_ns: int) -> VehicleState:
    slant_m, position, attitude = range_below_m(fields), state.position_ned_m, state.attitude
    if slant_m is None or position is None or attitude is None or not state.position_fresh(now_ns):
        return state
    _, x, y, _ = attitude
    cosine = 1.0 - 2.0 * (x * x + y * y)  # of the angle between body down and down
    if not may_measure(cosine):
        return state
    home_down = state.home_position_ned_m[2] if state.home_position_ned_m else 0.0
    ground = state.ground or GroundLevel()
    return with_fields(state, ground=ground.measure(now_ns, slant_m, position, cosine, home_down))


def _global_position_int(state: VehicleState, fields: Fields, now_ns: int) -> VehicleState:
    return with_fields(
        state,
        global_ns=now_ns,
        latitude_deg=fields["lat"] * 1e-7,
        longitude_deg=fields["lon"] * 1e-7,
        altitude_amsl_m=fields["alt"] * 1e-3,
    )


def _home_position(state: VehicleState, fields: Fields, _now_ns: int) -> VehicleState:
    home = with_fields(state, home_altitude_amsl_m=fields["altitude"] * 1e-3)
    local = _vector(fields, "x", "y", "z")
    if local is not None:
        home = with_fields(home, home_position_ned_m=_subtract(local, state.reset_offset_ned_m))
    return state if home == state else home


def _sys_status(state: VehicleState, fields: Fields, now_ns: int) -> VehicleState:
    health = fields["onboard_control_sensors_health"]
    ready = bool(health & _PREARM_CHECK)
    sticks = bool(health & fields["onboard_control_sensors_present"] & _RC_RECEIVER)
    alters = state.autopilot == "ArduPilot" and bool(fields["onboard_control_sensors_enabled"] & _AVOIDANCE)
    known = with_fields(state, ready_to_arm=ready, sticks_present=sticks, alters_velocities=alters)
    return _battery_status(known, fields, now_ns)


def _battery_status(state: VehicleState, fields: Fields, now_ns: int) -> VehicleState:
    # Of several batteries only the first is used, as in SYS_STATUS.
    if fields.get("id", 0) != 0 or fields["battery_remaining"] < 0:
        return state
    fraction = min(fields["battery_remaining"] / 100.0, 1.0)
    return with_fields(state, battery_ns=now_ns, battery_fraction=fraction)


def _mode(fields: Fields) -> FlightMode:
    """Return the mode set by the profile (`flight_mode`), else decode PX4's custom_mode."""
    named: FlightMode | None = fields.get("flight_mode")
    return mode_of_custom_mode(fields["custom_mode"]) if named is None else named


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)


def _positive(value: float | None) -> float | None:
    """Return a finite number above zero, else None."""
    return float(value) if value is not None and 0.0 < value < math.inf else None


def _vector(fields: Fields, *names: str) -> tuple[float, float, float] | None:
    """Return three fields as a vector; None if any is not finite."""
    x, y, z = (_number(fields[name]) for name in names)
    return (x, y, z) if math.isfinite(x) and math.isfinite(y) and math.isfinite(z) else None


_STEPS: dict[str, Callable[[VehicleState, Fields, int], VehicleState]] = {
    "HEARTBEAT": _heartbeat,
    "CURRENT_MODE": _current_mode,
    "EXTENDED_SYS_STATE": _extended_sys_state,
    "ATTITUDE_QUATERNION": _attitude_quaternion,
    "LOCAL_POSITION_NED": _local_position_ned,
    "ODOMETRY": _odometry,
    "ESTIMATOR_STATUS": _estimator_status,
    "DISTANCE_SENSOR": _distance_sensor,
    "GLOBAL_POSITION_INT": _global_position_int,
    "HOME_POSITION": _home_position,
    "SYS_STATUS": _sys_status,
    "BATTERY_STATUS": _battery_status,
    **GIMBAL_STEPS,
}

TELEMETRY_MESSAGES = frozenset(_STEPS)
