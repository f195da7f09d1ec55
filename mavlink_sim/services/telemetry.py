"""What each telemetry message says of the vehicle: one builder a message."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from mavlink_sim.flight.orbit import orbit_execution_status
from mavlink_sim.physics.airframe import MAX_THRUST_MPS2
from mavlink_sim.physics.geography import HOME_ALTITUDE_M, geographic
from mavlink_sim.services import gimbal_protocol, pilot_link
from mavlink_sim.services.mission_messages import mission_current
from mavlink_sim.services.vehicle_files import metadata_message
from mavlink_sim.wire import packing
from mavlink_sim.wire.messages import current_event_sequence, dialect, time_estimate_to_target

if TYPE_CHECKING:
    from mavlink_sim.vehicle import Vehicle

PREARM_CHECK = 0x10000000  # MAV_SYS_STATUS_PREARM_CHECK
# (present, enabled, health) of SYS_STATUS as recorded from a PX4, before and after its estimator started
SENSORS_STARTING = (0x402F, 0x1402F, 0x320883F)
SENSORS_READY = (0x402F, 0x1402F, 0x320C83F)

_U16_UNKNOWN = 65535
_NAN = math.nan


def _heartbeat(vehicle: Vehicle) -> Any:
    autopilot = vehicle.autopilot
    return dialect.MAVLink_heartbeat_message(
        2, 12, autopilot.base_mode, autopilot.mode.custom_mode, int(autopilot.system_status), 3
    )


def _attitude(vehicle: Vehicle) -> Any:
    frame = vehicle.estimate
    return packing.attitude(vehicle.boot_ms, frame.roll_rad, frame.pitch_rad, frame.yaw_rad, *frame.rates)


def _attitude_quaternion(vehicle: Vehicle) -> Any:
    return packing.attitude_quaternion(
        vehicle.boot_ms, *vehicle.estimate.quaternion, *vehicle.estimate.rates, repr_offset_q=[0.0] * 4
    )


def _global_position_int(vehicle: Vehicle) -> Any:
    frame = vehicle.estimate
    latitude, longitude, altitude = geographic(frame.position)
    vx, vy, vz = frame.velocity
    return packing.global_position_int(
        vehicle.boot_ms,
        round(latitude * 1e7),
        round(longitude * 1e7),
        round(altitude * 1000),
        round((vehicle.autopilot.home[2] - frame.position[2]) * 1000),
        round(vx * 100),
        round(vy * 100),
        round(vz * 100),
        round(math.degrees(frame.yaw_rad) % 360.0 * 100) % 36000,
    )


def _pressure_hpa(altitude_m: float) -> float:
    return float(1013.25 * (1.0 - 2.25577e-5 * altitude_m) ** 5.25588)


def _highres_imu(vehicle: Vehicle) -> Any:
    frame = vehicle.estimate
    altitude = HOME_ALTITUDE_M + frame.pressure_height_m
    cosine, sine = math.cos(frame.yaw_rad), math.sin(frame.yaw_rad)
    return packing.highres_imu(
        vehicle.boot_us,
        *frame.specific_force,
        *frame.rates,
        0.21 * cosine,
        -0.21 * sine,
        0.43,
        _pressure_hpa(altitude),
        0.0,
        altitude,
        15.0,
        63,
    )


def _local_position_ned(vehicle: Vehicle) -> Any:
    frame = vehicle.estimate
    return packing.local_position_ned(vehicle.boot_ms, *frame.position, *frame.velocity)


_POSE_COVARIANCE = [0.041, 0, 0, 0, 0, 0, 0.041, 0, 0, 0, 0, 0.044, 0, 0, 0, 2.3e-5, 0, 0, 2.6e-5, 0, 7.3e-4]
_VELOCITY_COVARIANCE = [0.011, 0, 0, 0, 0, 0, 0.012, 0, 0, 0, 0, 0.005, *([0] * 9)]


def _odometry(vehicle: Vehicle) -> Any:
    frame = vehicle.estimate
    return packing.odometry(
        vehicle.boot_us,
        1,
        1,
        *frame.position,
        list(frame.quaternion),
        *frame.velocity,
        *frame.rates,
        _POSE_COVARIANCE,
        _VELOCITY_COVARIANCE,
        0,
        8,
        0,
    )


def _timesync(vehicle: Vehicle) -> Any:
    return dialect.MAVLink_timesync_message(0, vehicle.clock_ns())


def _altitude(vehicle: Vehicle) -> Any:
    height = -vehicle.estimate.position[2]
    relative = height + vehicle.autopilot.home[2]
    return packing.altitude(
        vehicle.boot_us, HOME_ALTITUDE_M + height, HOME_ALTITUDE_M + height, height, relative, 0.0, height
    )


def _distance_sensor(vehicle: Vehicle) -> Any:
    frame = vehicle.estimate
    slant = -vehicle.airframe.position[2] / max(math.cos(frame.roll_rad) * math.cos(frame.pitch_rad), 0.1)
    return packing.distance_sensor(
        vehicle.boot_ms, 0, 10000, min(round(max(slant, 0.0) * 100), 65534), 0, 0, 25, 0
    )


def _attitude_target(vehicle: Vehicle) -> Any:
    autopilot = vehicle.autopilot
    target = autopilot.attitude.target(vehicle.estimate, autopilot.controller, autopilot.demand)
    return packing.attitude_target(vehicle.boot_ms, 0, list(target.quaternion), *target.rates, target.thrust)


def _type_mask(*groups: tuple[float, float, float]) -> int:
    mask = 0
    for index, value in enumerate(value for group in groups for value in group):
        if math.isnan(value):
            mask |= 1 << index
    return mask


def _position_target_local_ned(vehicle: Vehicle) -> Any:
    inner = vehicle.autopilot.controller
    if vehicle.autopilot.attitude.active:
        return None  # PX4's position controller rests meanwhile
    return packing.position_target_local_ned(
        vehicle.boot_ms,
        1,
        _type_mask(inner.position, inner.velocity, inner.acceleration),
        *inner.position,
        *inner.velocity,
        *inner.acceleration,
        inner.yaw_rad,
        inner.yaw_rate_radps,
    )


def _position_target_global_int(vehicle: Vehicle) -> Any:
    task = vehicle.autopilot.task
    if task is None or task.goal is None:
        return None
    latitude, longitude, altitude = geographic(task.goal)
    inner = vehicle.autopilot.controller
    return dialect.MAVLink_position_target_global_int_message(
        vehicle.boot_ms,
        5,
        0,
        round(latitude * 1e7),
        round(longitude * 1e7),
        altitude,
        *inner.velocity,
        *inner.acceleration,
        inner.yaw_rad,
        0.0,
    )


def _servo_output_raw(vehicle: Vehicle) -> Any:
    widths = [900] * 4
    if vehicle.autopilot.armed:
        widths = [1000 + round(1000 * command) for command in vehicle.airframe.rotor_commands]
    rest = {f"servo{number}_raw": 900 for number in range(9, 17)}
    return packing.servo_output_raw(vehicle.boot_us & 0xFFFFFFFF, 0, *widths, 900, 900, 900, 900, **rest)


def _vfr_hud(vehicle: Vehicle) -> Any:
    frame = vehicle.estimate
    vx, vy, vz = frame.velocity
    throttle = round(100 * frame.thrust_mps2 / MAX_THRUST_MPS2) if vehicle.autopilot.armed else 0
    heading = round(math.degrees(frame.yaw_rad) % 360.0) % 360
    return packing.vfr_hud(
        _NAN, math.hypot(vx, vy), heading, throttle, HOME_ALTITUDE_M - frame.position[2], -vz
    )


def _gps_raw_int(vehicle: Vehicle) -> Any:
    latitude, longitude, altitude = geographic(vehicle.estimate.gps_position)
    vx, vy, _ = vehicle.estimate.velocity
    course = round(math.degrees(math.atan2(vy, vx)) % 360.0 * 100) % 36000
    height_mm = round(altitude * 1000)
    return packing.gps_raw_int(
        0,
        3,
        round(latitude * 1e7),
        round(longitude * 1e7),
        height_mm,
        70,
        110,
        round(math.hypot(vx, vy) * 100),
        course,
        10,
        height_mm,
        900,
        1780,
        400,
        0,
        0,
    )


def _extended_sys_state(vehicle: Vehicle) -> Any:
    return dialect.MAVLink_extended_sys_state_message(0, int(vehicle.autopilot.landed_state))


def _sys_status(vehicle: Vehicle) -> Any:
    autopilot = vehicle.autopilot
    present, enabled, health = SENSORS_READY if autopilot.sensors_ready else SENSORS_STARTING
    if autopilot.can_arm:
        health |= PREARM_CHECK
    receiver = pilot_link.receiver_bits(vehicle)
    battery = autopilot.supervision.battery
    return dialect.MAVLink_sys_status_message(
        present | receiver,
        enabled,
        health | receiver,
        120,
        *battery.system_status,
        *([0] * 6),
        0,
        0,
        1,
    )


def _estimator_status(vehicle: Vehicle) -> Any:
    flags = 895 if vehicle.autopilot.sensors_ready else 164
    return dialect.MAVLink_estimator_status_message(
        vehicle.boot_us, flags, 0.05, 0.05, 0.002, 0.08, 0.001, _NAN, 0.28, 0.19
    )


def _open_drone_id_location(vehicle: Vehicle) -> Any:
    frame = vehicle.estimate
    latitude, longitude, altitude = geographic(frame.position)
    vx, vy, vz = frame.velocity
    course = round(math.degrees(math.atan2(vy, vx)) % 360.0 * 100) % 36000
    return dialect.MAVLink_open_drone_id_location_message(
        0,
        0,
        [0] * 20,
        1 if vehicle.autopilot.landed else 2,
        course,
        round(math.hypot(vx, vy) * 100),
        max(-6200, min(6200, round(-vz * 100))),
        round(latitude * 1e7),
        round(longitude * 1e7),
        altitude,
        altitude,
        0,
        -frame.position[2],
        12,
        5,
        0,
        3,
        65535.0,
        0,
    )


def _open_drone_id_system(vehicle: Vehicle) -> Any:
    latitude, longitude, altitude = geographic(vehicle.autopilot.home)
    since_2019 = max(vehicle.utc_ns() // 10**9 - 1546300800, 0)  # the standard counts from 2019-01-01
    return dialect.MAVLink_open_drone_id_system_message(
        0,
        0,
        [0] * 20,
        0,
        0,
        round(latitude * 1e7),
        round(longitude * 1e7),
        1,
        0,
        -1000.0,
        -1000.0,
        0,
        0,
        altitude,
        since_2019 & 0xFFFFFFFF,
    )


def _ping(vehicle: Vehicle) -> Any:
    return dialect.MAVLink_ping_message(vehicle.boot_us, vehicle.next_ping(), 0, 0)


def _scaled_pressure(vehicle: Vehicle) -> Any:
    altitude = HOME_ALTITUDE_M + vehicle.estimate.pressure_height_m
    return dialect.MAVLink_scaled_pressure_message(vehicle.boot_ms, _pressure_hpa(altitude), 0.0, 1182)


def _system_time(vehicle: Vehicle) -> Any:
    return dialect.MAVLink_system_time_message(vehicle.utc_ns() // 1000, vehicle.boot_ms)


def _mission_current(vehicle: Vehicle) -> Any:
    return mission_current(vehicle)


def _battery_status(vehicle: Vehicle) -> Any:
    battery = vehicle.autopilot.supervision.battery
    if not battery.connected:
        return None
    return dialect.MAVLink_battery_status_message(
        0,
        1,
        1,
        32767,
        [round(battery.volts * 1000)] + [_U16_UNKNOWN] * 9,
        round(battery.current_a * 100),
        int(battery.discharged_mah),
        -1,
        round(battery.remaining * 100),
        battery.time_remaining_s,
        battery.charge_state,
    )


def _current_mode(vehicle: Vehicle) -> Any:
    autopilot = vehicle.autopilot
    return dialect.MAVLink_current_mode_message(
        autopilot.mode.standard_mode, autopilot.mode.custom_mode, autopilot.intended_mode.custom_mode
    )


def _home_position(vehicle: Vehicle) -> Any:
    if not vehicle.autopilot.sensors_ready:
        return None  # there is no home before there is a position
    home = vehicle.autopilot.home
    latitude, longitude, altitude = geographic(home)
    return dialect.MAVLink_home_position_message(
        round(latitude * 1e7),
        round(longitude * 1e7),
        round(altitude * 1000),
        *home,
        [1.0, 0.0, 0.0, 0.0],
        0.0,
        0.0,
        0.0,
        vehicle.boot_us,
    )


def _vibration(vehicle: Vehicle) -> Any:
    return dialect.MAVLink_vibration_message(vehicle.boot_us, 0.0, 0.011, 0.11, 0, 0, 0)


def _time_estimate(vehicle: Vehicle) -> Any:
    if vehicle.autopilot.landed:
        return time_estimate_to_target(-1, -1)
    home = vehicle.autopilot.home
    position = vehicle.estimate.position
    away = math.hypot(position[0] - home[0], position[1] - home[1])
    positive = vehicle.parameters.positive
    seconds = away / positive("MPC_XY_CRUISE") + (home[2] - position[2]) / positive("MPC_LAND_SPEED")
    seconds *= vehicle.parameters.number("RTL_TIME_FACTOR")
    return time_estimate_to_target(round(min(max(seconds, 0.0), 86400.0)), -1)


def _current_event_sequence(vehicle: Vehicle) -> Any:
    return current_event_sequence(vehicle.events.sequence)


def _gps_global_origin(vehicle: Vehicle) -> Any:
    latitude, longitude, altitude = geographic((0.0, 0.0, 0.0))
    return dialect.MAVLink_gps_global_origin_message(
        round(latitude * 1e7),
        round(longitude * 1e7),
        round(altitude * 1000),
        vehicle.boot_us,
    )


def _autopilot_version(vehicle: Vehicle) -> Any:
    return dialect.MAVLink_autopilot_version_message(
        capabilities=59647,
        flight_sw_version=vehicle.release.software_version,
        middleware_sw_version=vehicle.release.software_version,
        os_sw_version=0,
        board_version=1,
        flight_custom_version=[0, 0, 0, 253, 175, 214, 222, 89],
        middleware_custom_version=[0, 0, 0, 253, 175, 214, 222, 89],
        os_custom_version=[0] * 8,
        vendor_id=0,
        product_id=0,
        uid=5283920058631409231,
    )


Builder = Callable[["Vehicle"], Any]

# LINK_NODE_STATUS is built by the link itself, from its own counters.
BUILDERS: dict[str, Builder] = {
    "HEARTBEAT": _heartbeat,
    "ATTITUDE": _attitude,
    "ATTITUDE_QUATERNION": _attitude_quaternion,
    "GLOBAL_POSITION_INT": _global_position_int,
    "HIGHRES_IMU": _highres_imu,
    "LOCAL_POSITION_NED": _local_position_ned,
    "ODOMETRY": _odometry,
    "TIMESYNC": _timesync,
    "ALTITUDE": _altitude,
    "DISTANCE_SENSOR": _distance_sensor,
    "ATTITUDE_TARGET": _attitude_target,
    "POSITION_TARGET_LOCAL_NED": _position_target_local_ned,
    "POSITION_TARGET_GLOBAL_INT": _position_target_global_int,
    "ORBIT_EXECUTION_STATUS": orbit_execution_status,
    "SERVO_OUTPUT_RAW": _servo_output_raw,
    "VFR_HUD": _vfr_hud,
    "GPS_RAW_INT": _gps_raw_int,
    "RC_CHANNELS": pilot_link.rc_channels,
    "GIMBAL_DEVICE_ATTITUDE_STATUS": gimbal_protocol.device_attitude_status,
    "GIMBAL_MANAGER_STATUS": gimbal_protocol.manager_status,
    "MOUNT_ORIENTATION": gimbal_protocol.mount_orientation,
    "EXTENDED_SYS_STATE": _extended_sys_state,
    "SYS_STATUS": _sys_status,
    "ESTIMATOR_STATUS": _estimator_status,
    "OPEN_DRONE_ID_LOCATION": _open_drone_id_location,
    "OPEN_DRONE_ID_SYSTEM": _open_drone_id_system,
    "PING": _ping,
    "SCALED_PRESSURE": _scaled_pressure,
    "SYSTEM_TIME": _system_time,
    "MISSION_CURRENT": _mission_current,
    "BATTERY_STATUS": _battery_status,
    "CURRENT_MODE": _current_mode,
    "HOME_POSITION": _home_position,
    "VIBRATION": _vibration,
    "TIME_ESTIMATE_TO_TARGET": _time_estimate,
    "CURRENT_EVENT_SEQUENCE": _current_event_sequence,
    "GPS_GLOBAL_ORIGIN": _gps_global_origin,
}
# Built on request alone.
REQUESTED: dict[str, Builder] = {
    "AUTOPILOT_VERSION": _autopilot_version,
    "COMPONENT_METADATA": metadata_message,
    "GIMBAL_MANAGER_INFORMATION": gimbal_protocol.manager_information,
    "GIMBAL_DEVICE_INFORMATION": gimbal_protocol.device_information,
}

MESSAGE_IDS: dict[int, str] = {
    identifier: message.msgname
    for identifier, message in dialect.mavlink_map.items()
    if message.msgname in BUILDERS or message.msgname in REQUESTED
} | {
    8: "LINK_NODE_STATUS",
    380: "TIME_ESTIMATE_TO_TARGET",
    397: "COMPONENT_METADATA",
    411: "CURRENT_EVENT_SEQUENCE",
}
