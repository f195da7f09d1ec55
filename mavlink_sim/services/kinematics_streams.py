"""Telemetry of motion: estimated attitude, position and velocity, and the targets of control."""

from __future__ import annotations

import math
from typing import Any

from mavlink_sim.flight import collision_prevention
from mavlink_sim.flight.orbit import Orbit
from mavlink_sim.physics.airframe import MAX_THRUST_MPS2
from mavlink_sim.physics.geography import HOME_ALTITUDE_M
from mavlink_sim.services.context import ServiceContext
from mavlink_sim.wire import packing
from mavlink_sim.wire.messages import dialect

_NAN = math.nan
# Collision prevention runs at the rate of the position control.
OBSTACLE_MAP_AGE_S = 0.05


def attitude(vehicle: ServiceContext) -> Any:
    frame = vehicle.estimate
    return packing.attitude(vehicle.boot_ms, frame.roll_rad, frame.pitch_rad, frame.yaw_rad, *frame.rates)


def attitude_quaternion(vehicle: ServiceContext) -> Any:
    return packing.attitude_quaternion(
        vehicle.boot_ms, *vehicle.estimate.quaternion, *vehicle.estimate.rates, repr_offset_q=[0.0] * 4
    )


def global_position_int(vehicle: ServiceContext) -> Any:
    frame = vehicle.estimate
    latitude, longitude, altitude = vehicle.local_frame.geographic(frame.position)
    vx, vy, vz = frame.velocity
    return packing.global_position_int(
        vehicle.boot_ms,
        round(latitude * 1e7),
        round(longitude * 1e7),
        round(altitude * 1000),
        round((vehicle.autopilot.home.position[2] - frame.position[2]) * 1000),
        round(vx * 100),
        round(vy * 100),
        round(vz * 100),
        round(math.degrees(frame.yaw_rad) % 360.0 * 100) % 36000,
    )


def _pressure_hpa(altitude_m: float) -> float:
    return float(1013.25 * (1.0 - 2.25577e-5 * altitude_m) ** 5.25588)


def highres_imu(vehicle: ServiceContext) -> Any:
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


def local_position_ned(vehicle: ServiceContext) -> Any:
    frame = vehicle.estimate
    return packing.local_position_ned(vehicle.boot_ms, *frame.position, *frame.velocity)


_POSE_COVARIANCE = [0.041, 0, 0, 0, 0, 0, 0.041, 0, 0, 0, 0, 0.044, 0, 0, 0, 2.3e-5, 0, 0, 2.6e-5, 0, 7.3e-4]

_VELOCITY_COVARIANCE = [0.011, 0, 0, 0, 0, 0, 0.012, 0, 0, 0, 0, 0.005, *([0] * 9)]


def odometry(vehicle: ServiceContext) -> Any:
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


def altitude(vehicle: ServiceContext) -> Any:
    height = -vehicle.estimate.position[2]
    relative = height + vehicle.autopilot.home.position[2]
    return packing.altitude(
        vehicle.boot_us, HOME_ALTITUDE_M + height, HOME_ALTITUDE_M + height, height, relative, 0.0, height
    )


def distance_sensor(vehicle: ServiceContext) -> Any:
    frame = vehicle.estimate
    slant = -vehicle.airframe.position[2] / max(math.cos(frame.roll_rad) * math.cos(frame.pitch_rad), 0.1)
    slant = min(slant, vehicle.obstacle_below_m())
    return packing.distance_sensor(
        vehicle.boot_ms, 0, 10000, min(round(max(slant, 0.0) * 100), 65534), 0, 0, 25, 0
    )


def obstacle_distance(vehicle: ServiceContext) -> Any:
    """The map of collision prevention, of all sensors; only while that is active, as in PX4."""
    found = vehicle.autopilot.navigator.obstacles
    if vehicle.autopilot.now_s - found.used_s > OBSTACLE_MAP_AGE_S:
        return None
    stamp_us = round(found.stamp_s * 1e6) if math.isfinite(found.stamp_s) else 0
    return dialect.MAVLink_obstacle_distance_message(
        stamp_us,
        0,  # MAV_DISTANCE_SENSOR_LASER, for all sensors
        found.distances_cm.copy(),
        0,  # the increment is in increment_f
        found.min_distance_cm,
        found.max_distance_cm,
        collision_prevention.SECTOR_DEG,
        0.0,
        collision_prevention.FRAME_BODY_FRD,
    )


def attitude_target(vehicle: ServiceContext) -> Any:
    autopilot = vehicle.autopilot
    target = autopilot.attitude.target(vehicle.estimate, autopilot.controller, autopilot.demand)
    return packing.attitude_target(vehicle.boot_ms, 0, list(target.quaternion), *target.rates, target.thrust)


def _type_mask(*groups: tuple[float, float, float]) -> int:
    mask = 0
    for index, value in enumerate(value for group in groups for value in group):
        if math.isnan(value):
            mask |= 1 << index
    return mask


def position_target_local_ned(vehicle: ServiceContext) -> Any:
    inner = vehicle.autopilot.controller
    if vehicle.autopilot.attitude.active:
        return None  # PX4's position controller is inactive then
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


def position_target_global_int(vehicle: ServiceContext) -> Any:
    task = vehicle.autopilot.task
    if task is None or task.goal is None:
        return None
    latitude, longitude, altitude = vehicle.local_frame.geographic(task.goal)
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


def orbit_execution_status(vehicle: ServiceContext) -> Any:
    """ORBIT_EXECUTION_STATUS (360) while an orbit is active, else None. Radius positive: clockwise."""
    task = vehicle.autopilot.task
    if not isinstance(task, Orbit) or task.refused:
        return None
    north, east, _ = task.centre
    latitude, longitude, altitude = vehicle.local_frame.geographic((north, east, task.down_m))
    return dialect.MAVLink_orbit_execution_status_message(
        vehicle.boot_us,
        math.copysign(task.radius_m, task.speed_mps),
        0,
        round(latitude * 1e7),
        round(longitude * 1e7),
        altitude,
    )


_UNUSED_OUTPUTS = (900,) * 12


def servo_output_raw(vehicle: ServiceContext) -> Any:
    widths = [900] * 4
    if vehicle.autopilot.armed:
        widths = [1000 + round(1000 * command) for command in vehicle.airframe.rotor_commands]
    return packing.servo_output_raw(vehicle.boot_us & 0xFFFFFFFF, 0, *widths, *_UNUSED_OUTPUTS)


def vfr_hud(vehicle: ServiceContext) -> Any:
    frame = vehicle.estimate
    vx, vy, vz = frame.velocity
    throttle = round(100 * frame.thrust_mps2 / MAX_THRUST_MPS2) if vehicle.autopilot.armed else 0
    heading = round(math.degrees(frame.yaw_rad) % 360.0) % 360
    return packing.vfr_hud(
        _NAN, math.hypot(vx, vy), heading, throttle, HOME_ALTITUDE_M - frame.position[2], -vz
    )


def gps_raw_int(vehicle: ServiceContext) -> Any:
    latitude, longitude, altitude = vehicle.local_frame.geographic(vehicle.estimate.gps_position)
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


def open_drone_id_location(vehicle: ServiceContext) -> Any:
    frame = vehicle.estimate
    latitude, longitude, altitude = vehicle.local_frame.geographic(frame.position)
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


def scaled_pressure(vehicle: ServiceContext) -> Any:
    altitude = HOME_ALTITUDE_M + vehicle.estimate.pressure_height_m
    return dialect.MAVLink_scaled_pressure_message(vehicle.boot_ms, _pressure_hpa(altitude), 0.0, 1182)
