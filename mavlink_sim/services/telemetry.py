"""The telemetry messages and their builders."""

from __future__ import annotations

from mavlink_sim.services import gimbal_protocol, kinematics_streams, manual_control_service, system_streams
from mavlink_sim.services.context import Builder
from mavlink_sim.services.mission_messages import mission_current
from mavlink_sim.services.vehicle_files import metadata_message
from mavlink_sim.wire.messages import dialect

# LINK_NODE_STATUS is built by the link itself, from its own counters.
BUILDERS: dict[str, Builder] = {
    "HEARTBEAT": system_streams.heartbeat,
    "ATTITUDE": kinematics_streams.attitude,
    "ATTITUDE_QUATERNION": kinematics_streams.attitude_quaternion,
    "GLOBAL_POSITION_INT": kinematics_streams.global_position_int,
    "HIGHRES_IMU": kinematics_streams.highres_imu,
    "LOCAL_POSITION_NED": kinematics_streams.local_position_ned,
    "ODOMETRY": kinematics_streams.odometry,
    "TIMESYNC": system_streams.timesync,
    "ALTITUDE": kinematics_streams.altitude,
    "DISTANCE_SENSOR": kinematics_streams.distance_sensor,
    "ATTITUDE_TARGET": kinematics_streams.attitude_target,
    "POSITION_TARGET_LOCAL_NED": kinematics_streams.position_target_local_ned,
    "POSITION_TARGET_GLOBAL_INT": kinematics_streams.position_target_global_int,
    "ORBIT_EXECUTION_STATUS": kinematics_streams.orbit_execution_status,
    "SERVO_OUTPUT_RAW": kinematics_streams.servo_output_raw,
    "VFR_HUD": kinematics_streams.vfr_hud,
    "GPS_RAW_INT": kinematics_streams.gps_raw_int,
    "RC_CHANNELS": manual_control_service.rc_channels,
    "GIMBAL_DEVICE_ATTITUDE_STATUS": gimbal_protocol.device_attitude_status,
    "GIMBAL_MANAGER_STATUS": gimbal_protocol.manager_status,
    "MOUNT_ORIENTATION": gimbal_protocol.mount_orientation,
    "EXTENDED_SYS_STATE": system_streams.extended_sys_state,
    "SYS_STATUS": system_streams.sys_status,
    "ESTIMATOR_STATUS": system_streams.estimator_status,
    "OPEN_DRONE_ID_LOCATION": kinematics_streams.open_drone_id_location,
    "OPEN_DRONE_ID_SYSTEM": system_streams.open_drone_id_system,
    "PING": system_streams.ping,
    "SCALED_PRESSURE": kinematics_streams.scaled_pressure,
    "SYSTEM_TIME": system_streams.system_time,
    "MISSION_CURRENT": mission_current,
    "BATTERY_STATUS": system_streams.battery_status,
    "CURRENT_MODE": system_streams.current_mode,
    "HOME_POSITION": system_streams.home_position,
    "VIBRATION": system_streams.vibration,
    "TIME_ESTIMATE_TO_TARGET": system_streams.time_estimate,
    "CURRENT_EVENT_SEQUENCE": system_streams.current_event_sequence,
    "GPS_GLOBAL_ORIGIN": system_streams.gps_global_origin,
    "OBSTACLE_DISTANCE": kinematics_streams.obstacle_distance,
}
# Built on request only.
REQUESTED: dict[str, Builder] = {
    "AUTOPILOT_VERSION": system_streams.autopilot_version,
    "COMPONENT_METADATA": metadata_message,
    "FLIGHT_INFORMATION": system_streams.flight_information,
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
