"""Which telemetry messages there are, and what builds each."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from mavlink_sim.flight.orbit import orbit_execution_status
from mavlink_sim.services import gimbal_protocol, pilot_link, telemetry_of_motion, telemetry_of_system
from mavlink_sim.services.mission_messages import mission_current
from mavlink_sim.services.vehicle_files import metadata_message
from mavlink_sim.wire.messages import dialect

if TYPE_CHECKING:
    from mavlink_sim.vehicle import Vehicle

Builder = Callable[["Vehicle"], Any]

# LINK_NODE_STATUS is built by the link itself, from its own counters.
BUILDERS: dict[str, Builder] = {
    "HEARTBEAT": telemetry_of_system.heartbeat,
    "ATTITUDE": telemetry_of_motion.attitude,
    "ATTITUDE_QUATERNION": telemetry_of_motion.attitude_quaternion,
    "GLOBAL_POSITION_INT": telemetry_of_motion.global_position_int,
    "HIGHRES_IMU": telemetry_of_motion.highres_imu,
    "LOCAL_POSITION_NED": telemetry_of_motion.local_position_ned,
    "ODOMETRY": telemetry_of_motion.odometry,
    "TIMESYNC": telemetry_of_system.timesync,
    "ALTITUDE": telemetry_of_motion.altitude,
    "DISTANCE_SENSOR": telemetry_of_motion.distance_sensor,
    "ATTITUDE_TARGET": telemetry_of_motion.attitude_target,
    "POSITION_TARGET_LOCAL_NED": telemetry_of_motion.position_target_local_ned,
    "POSITION_TARGET_GLOBAL_INT": telemetry_of_motion.position_target_global_int,
    "ORBIT_EXECUTION_STATUS": orbit_execution_status,
    "SERVO_OUTPUT_RAW": telemetry_of_motion.servo_output_raw,
    "VFR_HUD": telemetry_of_motion.vfr_hud,
    "GPS_RAW_INT": telemetry_of_motion.gps_raw_int,
    "RC_CHANNELS": pilot_link.rc_channels,
    "GIMBAL_DEVICE_ATTITUDE_STATUS": gimbal_protocol.device_attitude_status,
    "GIMBAL_MANAGER_STATUS": gimbal_protocol.manager_status,
    "MOUNT_ORIENTATION": gimbal_protocol.mount_orientation,
    "EXTENDED_SYS_STATE": telemetry_of_system.extended_sys_state,
    "SYS_STATUS": telemetry_of_system.sys_status,
    "ESTIMATOR_STATUS": telemetry_of_system.estimator_status,
    "OPEN_DRONE_ID_LOCATION": telemetry_of_motion.open_drone_id_location,
    "OPEN_DRONE_ID_SYSTEM": telemetry_of_system.open_drone_id_system,
    "PING": telemetry_of_system.ping,
    "SCALED_PRESSURE": telemetry_of_motion.scaled_pressure,
    "SYSTEM_TIME": telemetry_of_system.system_time,
    "MISSION_CURRENT": mission_current,
    "BATTERY_STATUS": telemetry_of_system.battery_status,
    "CURRENT_MODE": telemetry_of_system.current_mode,
    "HOME_POSITION": telemetry_of_system.home_position,
    "VIBRATION": telemetry_of_system.vibration,
    "TIME_ESTIMATE_TO_TARGET": telemetry_of_system.time_estimate,
    "CURRENT_EVENT_SEQUENCE": telemetry_of_system.current_event_sequence,
    "GPS_GLOBAL_ORIGIN": telemetry_of_system.gps_global_origin,
    "OBSTACLE_DISTANCE": telemetry_of_motion.obstacle_distance,
}
# Built on request alone.
REQUESTED: dict[str, Builder] = {
    "AUTOPILOT_VERSION": telemetry_of_system.autopilot_version,
    "COMPONENT_METADATA": metadata_message,
    "FLIGHT_INFORMATION": telemetry_of_system.flight_information,
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
