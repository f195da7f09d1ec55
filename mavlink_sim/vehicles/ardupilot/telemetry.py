"""Copter's telemetry where it differs from PX4's; the other messages are shared."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega

from mavlink_sim.services import system_streams, telemetry
from mavlink_sim.vehicles.ardupilot.context import CopterContext
from mavlink_sim.wire.messages import dialect

QUADROTOR, ARDUPILOTMEGA = 2, 3  # MAV_TYPE, MAV_AUTOPILOT
VERSION = 0x040500FF  # 4.5.0, an official release
# MAV_PROTOCOL_CAPABILITY: PARAM_FLOAT, COMMAND_INT, SET_ATTITUDE_TARGET, the two
# SET_POSITION_TARGETs, FLIGHT_TERMINATION, MAVLINK2, PARAM_ENCODE_C_CAST.
CAPABILITIES = 2 | 8 | 64 | 128 | 256 | 2048 | 8192 | 131072
# gyros, accelerometers, compass, barometer, GPS, attitude, yaw, height and position control, motors, AHRS
SENSORS = 0x20FC2F
PREARM_CHECK = system_streams.PREARM_CHECK
BATTERY = 0x2000000
# EKF_STATUS_REPORT.flags: attitude to predicted absolute position; while starting: attitude alone
EKF_READY, EKF_STARTING, EKF_BLIND = 831, 1, 167
IGNORE_POSITION, IGNORE_VELOCITY, IGNORE_ACCELERATION, IGNORE_YAWS = 7, 56, 448, 3072
MILLI_G = 1000.0 / 9.80665
NOTHING = (0.0, 0.0, 0.0)


def _heartbeat(vehicle: CopterContext) -> Any:
    copter = vehicle.copter
    return dialect.MAVLink_heartbeat_message(
        QUADROTOR, ARDUPILOTMEGA, copter.base_mode, copter.mode.custom_mode, int(copter.system_status), 3
    )


def _sys_status(vehicle: CopterContext) -> Any:
    copter = vehicle.copter
    health = SENSORS | BATTERY if copter.sensors_ready and copter.position_valid else BATTERY
    if copter.armed or copter.can_arm:
        health |= PREARM_CHECK
    present = SENSORS | BATTERY | PREARM_CHECK
    return dialect.MAVLink_sys_status_message(
        present, present, health, 120, *copter.supervision.battery.system_status, *([0] * 6)
    )


def _home_position(vehicle: CopterContext) -> Any:
    """HOME_POSITION; its local position is relative to the EKF's origin, its attitude is unknown."""
    if not vehicle.copter.sensors_ready:
        return None
    latitude, longitude, altitude = vehicle.local_frame.geographic(vehicle.copter.home.position)
    return dialect.MAVLink_home_position_message(
        round(latitude * 1e7),
        round(longitude * 1e7),
        round(altitude * 1000),
        *vehicle.copter.home.position,
        [math.nan] * 4,
        *NOTHING,
        vehicle.boot_us,
    )


def _position_target_local_ned(vehicle: CopterContext) -> Any:
    """The target of GUIDED; None in other modes."""
    guided = vehicle.copter.guided
    if guided is None:
        return None
    target = guided.target
    mask = IGNORE_YAWS
    mask |= IGNORE_POSITION if target.position is None else 0
    mask |= IGNORE_VELOCITY if target.velocity is None else 0
    mask |= IGNORE_ACCELERATION if target.position is not None and target.velocity is None else 0
    return dialect.MAVLink_position_target_local_ned_message(
        vehicle.boot_ms,
        1,
        mask,
        *(target.position or NOTHING),
        *(target.velocity or NOTHING),
        *(target.acceleration or NOTHING),
        0.0,
        0.0,
    )


def _raw_imu(vehicle: CopterContext) -> Any:
    frame = vehicle.estimate
    cosine, sine = math.cos(frame.yaw_rad), math.sin(frame.yaw_rad)
    return dialect.MAVLink_raw_imu_message(
        vehicle.boot_us,
        *(_int16(value * MILLI_G) for value in frame.specific_force),
        *(_int16(value * 1000.0) for value in frame.rates),
        round(210 * cosine),
        round(-210 * sine),
        430,
    )


def _int16(value: float) -> int:
    return min(max(round(value), -32768), 32767)


def _ekf_status_report(vehicle: CopterContext) -> Any:
    copter = vehicle.copter
    flags = EKF_STARTING
    if copter.sensors_ready:
        flags = EKF_READY if copter.position_valid else EKF_BLIND
    return ardupilotmega.MAVLink_ekf_status_report_message(flags, 0.05, 0.02, 0.03, 0.02, 0.0)


def _gps_global_origin(vehicle: CopterContext) -> Any:
    if not vehicle.copter.sensors_ready:
        return None
    return telemetry.BUILDERS["GPS_GLOBAL_ORIGIN"](vehicle)


def _autopilot_version(vehicle: CopterContext) -> Any:
    return dialect.MAVLink_autopilot_version_message(
        capabilities=CAPABILITIES,
        flight_sw_version=VERSION,
        middleware_sw_version=0,
        os_sw_version=0,
        board_version=0,
        flight_custom_version=list(b"2a3dc4b7"),
        middleware_custom_version=[0] * 8,
        os_custom_version=[0] * 8,
        vendor_id=0,
        product_id=0,
        uid=0,
    )


def _mission_current(vehicle: CopterContext) -> Any:
    return dialect.MAVLink_mission_current_message(0)


Builder = Callable[[CopterContext], Any]

_SHARED = (
    "ATTITUDE",
    "ATTITUDE_QUATERNION",
    "ATTITUDE_TARGET",
    "BATTERY_STATUS",
    "DISTANCE_SENSOR",
    "EXTENDED_SYS_STATE",
    "GLOBAL_POSITION_INT",
    "GPS_RAW_INT",
    "LOCAL_POSITION_NED",
    "POSITION_TARGET_GLOBAL_INT",
    "RC_CHANNELS",
    "SCALED_PRESSURE",
    "SERVO_OUTPUT_RAW",
    "SYSTEM_TIME",
    "TIMESYNC",
    "VFR_HUD",
    "VIBRATION",
)
BUILDERS: dict[str, Builder] = {name: telemetry.BUILDERS[name] for name in _SHARED} | {
    "HEARTBEAT": _heartbeat,
    "SYS_STATUS": _sys_status,
    "HOME_POSITION": _home_position,
    "POSITION_TARGET_LOCAL_NED": _position_target_local_ned,
    "RAW_IMU": _raw_imu,
    "EKF_STATUS_REPORT": _ekf_status_report,
    "GPS_GLOBAL_ORIGIN": _gps_global_origin,
    "MISSION_CURRENT": _mission_current,
    "AUTOPILOT_VERSION": _autopilot_version,
}
MESSAGE_IDS: dict[int, str] = {
    identifier: message.msgname
    for identifier, message in ardupilotmega.mavlink_map.items()
    if message.msgname in BUILDERS
}
