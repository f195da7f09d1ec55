"""What telemetry says when the estimate is not the truth: PX4 tells what it believes.

Each message was built of the airframe's true motion. Here the difference between estimate and truth is added,
so whatever else is in the message (noise, say) stays. Without a valid position PX4 goes on sending
LOCAL_POSITION_NED, GLOBAL_POSITION_INT and ODOMETRY, standing still: only ESTIMATOR_STATUS, GPS_RAW_INT and
the mode tell of it.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from mavlink_sim.geography import geographic

if TYPE_CHECKING:
    from mavlink_sim.physics import Vector
    from mavlink_sim.vehicle import Vehicle

# ESTIMATOR_STATUS_FLAGS without horizontal aiding: attitude, vertical speed, height, height above ground,
# and CONST_POS_MODE
FLAGS_WITHOUT_POSITION = 1 | 4 | 32 | 64 | 128
NO_FIX = 1  # GPS_FIX_TYPE
UNKNOWN_ACCURACY_M = 100.0
_GPS_SENSOR = 0x20  # MAV_SYS_STATUS_SENSOR_GPS
_U16_UNKNOWN = 65535


def as_estimated(vehicle: Vehicle, message: Any) -> Any:
    """The message as the estimator's errors make it; messages without motion come back as they are."""
    amend = _AMENDMENTS.get(message.get_type())
    if amend is None:
        return message
    believed = copy.copy(message)
    amend(vehicle, believed)
    return believed


def _offsets(vehicle: Vehicle) -> tuple[Vector, Vector, float]:
    """Estimate minus truth: position, velocity, yaw."""
    estimate, truth = vehicle.estimate, vehicle.airframe
    px, py, pz = (a - b for a, b in zip(estimate.position, truth.position, strict=True))
    vx, vy, vz = (a - b for a, b in zip(estimate.velocity, truth.velocity, strict=True))
    return (px, py, pz), (vx, vy, vz), estimate.yaw_error_rad


def _turned(quaternion: Any, yaw_rad: float) -> tuple[float, float, float, float]:
    """The quaternion after a turn about the world's down axis."""
    w, x, y, z = quaternion
    cosine, sine = math.cos(yaw_rad / 2.0), math.sin(yaw_rad / 2.0)
    return (
        cosine * w - sine * z,
        cosine * x - sine * y,
        cosine * y + sine * x,
        cosine * z + sine * w,
    )


def _attitude(vehicle: Vehicle, message: Any) -> None:
    message.yaw = math.remainder(message.yaw + vehicle.estimate.yaw_error_rad, math.tau)


def _attitude_quaternion(vehicle: Vehicle, message: Any) -> None:
    q = (message.q1, message.q2, message.q3, message.q4)
    message.q1, message.q2, message.q3, message.q4 = _turned(q, vehicle.estimate.yaw_error_rad)


def _local_position_ned(vehicle: Vehicle, message: Any) -> None:
    (px, py, pz), (vx, vy, vz), _ = _offsets(vehicle)
    message.x, message.y, message.z = message.x + px, message.y + py, message.z + pz
    message.vx, message.vy, message.vz = message.vx + vx, message.vy + vy, message.vz + vz


def _odometry(vehicle: Vehicle, message: Any) -> None:
    _local_position_ned(vehicle, message)
    message.q = list(_turned(message.q, vehicle.estimate.yaw_error_rad))
    message.reset_counter = vehicle.estimate.reset_counter
    if not vehicle.estimate.position_valid:
        message.pose_covariance = list(message.pose_covariance)
        message.pose_covariance[0] = message.pose_covariance[6] = UNKNOWN_ACCURACY_M**2


def _place_offset(vehicle: Vehicle, offset: Vector) -> tuple[int, int, int]:
    """(latitude 1e-7 °, longitude 1e-7 °, altitude mm) that an offset in NED metres makes at this place."""
    truth = vehicle.airframe.position
    there = geographic((truth[0] + offset[0], truth[1] + offset[1], truth[2] + offset[2]))
    here = geographic(truth)
    return (
        round((there[0] - here[0]) * 1e7),
        round((there[1] - here[1]) * 1e7),
        round((there[2] - here[2]) * 1000),
    )


def _global_position_int(vehicle: Vehicle, message: Any) -> None:
    offset, (vx, vy, vz), yaw = _offsets(vehicle)
    latitude, longitude, altitude_mm = _place_offset(vehicle, offset)
    message.lat, message.lon = message.lat + latitude, message.lon + longitude
    message.alt, message.relative_alt = message.alt + altitude_mm, message.relative_alt + altitude_mm
    message.vx, message.vy = message.vx + round(vx * 100), message.vy + round(vy * 100)
    message.vz = message.vz + round(vz * 100)
    message.hdg = (message.hdg + round(math.degrees(yaw) * 100)) % 36000


def _altitude(vehicle: Vehicle, message: Any) -> None:
    higher = -_offsets(vehicle)[0][2]
    for field in ("altitude_monotonic", "altitude_amsl", "altitude_local", "altitude_relative"):
        setattr(message, field, getattr(message, field) + higher)


def _vfr_hud(vehicle: Vehicle, message: Any) -> None:
    offset, velocity, yaw = _offsets(vehicle)
    vx, vy, _ = vehicle.estimate.velocity
    message.groundspeed = math.hypot(vx, vy)
    message.heading = round(message.heading + math.degrees(yaw)) % 360
    message.alt -= offset[2]
    message.climb -= velocity[2]


def _gps_raw_int(vehicle: Vehicle, message: Any) -> None:
    estimate = vehicle.estimate
    if estimate.fix_lost:
        message.fix_type, message.satellites_visible = NO_FIX, 0
        message.eph = message.epv = message.cog = message.vel = _U16_UNKNOWN
        message.h_acc = message.v_acc = round(UNKNOWN_ACCURACY_M * 1000)
        return
    for error in estimate.gps_error_m.values():
        latitude, longitude, altitude_mm = _place_offset(vehicle, error)
        message.lat, message.lon = message.lat + latitude, message.lon + longitude
        message.alt += altitude_mm


def _estimator_status(vehicle: Vehicle, message: Any) -> None:
    if not vehicle.estimate.position_valid:
        message.flags = FLAGS_WITHOUT_POSITION
        message.pos_horiz_accuracy = UNKNOWN_ACCURACY_M


def _sys_status(vehicle: Vehicle, message: Any) -> None:
    if vehicle.estimate.fix_lost:
        message.onboard_control_sensors_health &= ~_GPS_SENSOR


def _open_drone_id_location(vehicle: Vehicle, message: Any) -> None:
    latitude, longitude, _ = _place_offset(vehicle, _offsets(vehicle)[0])
    message.latitude, message.longitude = message.latitude + latitude, message.longitude + longitude


_AMENDMENTS: dict[str, Callable[[Vehicle, Any], None]] = {
    "ATTITUDE": _attitude,
    "ATTITUDE_QUATERNION": _attitude_quaternion,
    "LOCAL_POSITION_NED": _local_position_ned,
    "ODOMETRY": _odometry,
    "GLOBAL_POSITION_INT": _global_position_int,
    "OPEN_DRONE_ID_LOCATION": _open_drone_id_location,
    "ALTITUDE": _altitude,
    "VFR_HUD": _vfr_hud,
    "GPS_RAW_INT": _gps_raw_int,
    "ESTIMATOR_STATUS": _estimator_status,
    "SYS_STATUS": _sys_status,
}
