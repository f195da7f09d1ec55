"""Builds the bodies of the messages about the vehicle: state, setpoints, pose for other vehicles."""

from __future__ import annotations

import math

from companion.bus.bodies.vehicle import (
    FormationBody,
    GimbalBody,
    PoseBody,
    SetpointBody,
    SetpointsBody,
    StructureBody,
    VehicleBody,
)
from companion.geometry.geodesy import GeodeticOrigin
from companion.guidance.core import Guidance
from companion.guidance.formation.pose import FormationNote, Pose, Structure
from companion.vehicle.gimbal import GimbalState
from companion.vehicle.global_position import Anchor
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import VehicleState
from companion.vehicle.streamer import Streamer


def vehicle_message(state: VehicleState, now_ns: int) -> VehicleBody:
    """Create the vehicle's message. Metres, metres a second, radians; NED; `attitude_wxyz`: FRD to NED."""
    ground_height_m = state.ground_height_m
    return {
        "stamp_ns": now_ns,
        "connected": state.connected(now_ns),
        "heartbeat_age_s": _age_s(state.heartbeat_ns, now_ns),
        "position_age_s": _age_s(state.position_ns, now_ns),
        "global_age_s": _age_s(state.global_ns, now_ns),
        "boot_offset_ns": None if state.clock is None else state.clock.offset_ns,
        "boot_error_ns": None if state.clock is None else state.clock.error_ns,
        "armed": state.armed,
        "mode": state.mode.value,
        "landed": state.landed.value,
        "failsafe": state.failsafe,
        "position_ned_m": _rounded(state.position_ned_m),
        "position_valid": state.position_valid,
        "reset_count": state.reset_count,
        "reset_offset_ned_m": _rounded(state.reset_offset_ned_m),
        "velocity_ned_mps": _rounded(state.velocity_ned_mps),
        "attitude_wxyz": _rounded(state.attitude, 5),
        "yaw_rad": None if state.yaw_rad is None else round(state.yaw_rad, 4),
        "home_ned_m": _rounded(state.home_position_ned_m),
        "altitude_m": None if state.altitude_m is None else round(state.altitude_m, 3),
        "ground_height_m": None if ground_height_m is None else round(ground_height_m, 3),
        "height_source": None if state.height_source is None else state.height_source.value,
        "latitude_deg": _finite(state.latitude_deg),
        "longitude_deg": _finite(state.longitude_deg),
        "altitude_amsl_m": _finite(state.altitude_amsl_m),
        "battery_fraction": state.battery_fraction,
        "gimbal": None if state.gimbal is None else _gimbal(state.gimbal, now_ns),
    }


def _gimbal(gimbal: GimbalState, now_ns: int) -> GimbalBody:
    return {
        "attitude_age_s": _age_s(gimbal.attitude_ns, now_ns),
        "attitude_wxyz": _rounded(gimbal.attitude, 5),
        "yaw_from": gimbal.yaw_frame.value,
        "pitch_rad": None if gimbal.pitch_rad is None else round(gimbal.pitch_rad, 4),
        "primary_control": gimbal.primary_control,
    }


def setpoints_message(guidance: Guidance, streamer: Streamer, now_ns: int) -> SetpointsBody:
    """Create the message of the requested setpoint and the one sent."""
    return {
        "stamp_ns": now_ns,
        "asked": setpoint_message(guidance.setpoints.asked),
        "sent": setpoint_message(streamer.last_sent),
        "sent_ns": streamer.last_sent_ns,
        "stream": streamer.state.value,
        "limited_by": list(guidance.setpoints.limited_by),
        "path_ned_m": [[round(north, 2), round(east, 2)] for north, east in guidance.setpoints.path],
    }


def setpoint_message(setpoint: Setpoint | None) -> SetpointBody | None:
    """Create the fields of a setpoint; None for None."""
    if setpoint is None:
        return None
    return {
        "position_ned_m": _rounded(setpoint.position_ned_m),
        "velocity_ned_mps": _rounded(setpoint.velocity_ned_mps),
        "acceleration_ned_mps2": _rounded(setpoint.acceleration_ned_mps2),
        "yaw_rad": _finite(setpoint.yaw_rad),
        "yaw_rate_radps": _finite(setpoint.yaw_rate_radps),
        "deadline_ns": setpoint.deadline_ns,
    }


def geodetic_origin(state: VehicleState, now_ns: int) -> GeodeticOrigin | None:
    """Return latitude, longitude and height of the origin of local NED; None while they are unknown."""
    anchor = Anchor.of(state, now_ns)
    return None if anchor is None else GeodeticOrigin(*anchor.globally((0.0, 0.0, 0.0)))


def pose_message(pose: Pose) -> PoseBody:
    """Create the message of a pose. `guidance.formation.pose.pose_from_message` reads it."""
    return {
        "vehicle": pose.vehicle,
        "source": pose.source,
        "published_ns": pose.published_ns,
        "age_s": round(pose.age_s, 4),
        "latitude_deg": round(pose.latitude_deg, 8),
        "longitude_deg": round(pose.longitude_deg, 8),
        "altitude_amsl_m": round(pose.altitude_amsl_m, 3),
        "velocity_ned_mps": [round(value, 3) for value in pose.velocity_ned_mps],
        "heading_rad": round(pose.heading_rad, 4),
        "turn_rate_radps": round(pose.turn_rate_radps, 4),
        "role": pose.role,
        "airborne": pose.airborne,
        "formation": None if pose.formation is None else _formation(pose.formation),
        "in_command": pose.in_command,
        "mode": pose.mode,
    }


def _formation(note: FormationNote) -> FormationBody:
    return {
        "leader": note.leader,
        "plan": {
            "version": note.plan.version,
            "author": note.plan.author,
            "shape": note.plan.shape,
            "spacing_m": note.plan.spacing_m,
        },
        "wish": note.wish,
        "error_m": round(note.error_m, 2),
        "slots": dict(note.slots),
        "count": note.count,
        "heading_rad": round(note.heading_rad, 4),
        "turn_rate_radps": round(note.turn_rate_radps, 4),
        "structure": None if note.structure is None else _structure(note.structure),
    }


def _structure(structure: Structure) -> StructureBody:
    latitude, longitude, altitude = structure.place
    return {
        "place": [round(latitude, 8), round(longitude, 8), round(altitude, 3)],
        "velocity_ned_mps": [round(value, 3) for value in structure.velocity_ned_mps],
        "heading_rad": round(structure.heading_rad, 4),
        "origin": list(structure.origin),
        "along_m": round(structure.along_m, 2),
        "over": structure.over,
    }


def _age_s(stamp_ns: int, now_ns: int) -> float | None:
    return round((now_ns - stamp_ns) / 1e9, 3) if stamp_ns else None


def _rounded(values: tuple[float, ...] | None, digits: int = 3) -> list[float] | None:
    return None if values is None else [round(value, digits) for value in values]


def _finite(value: float | None) -> float | None:
    """Replace NaN and infinity, which JSON lacks, by None."""
    return value if value is not None and math.isfinite(value) else None
