"""The published messages as plain JSON-able values. Stamps are CLOCK_MONOTONIC nanoseconds of this host.

They are the public contract with subscribers (`docs/messages.md`): fields are added, never changed.
"""

from __future__ import annotations

import math
from typing import Any

from companion.bus.topics import NO_OBJECTS
from companion.vehicle.clock_sync import ClockOffset
from companion.vehicle.gimbal import GimbalState
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import VehicleState
from vision.pipeline import PerceptionResult
from vision.tracking import TrackEvent


def detections_message(
    result: PerceptionResult,
    vehicle: str,
    published_ns: int,
    view: str | None = None,
    clock: ClockOffset | None = None,
) -> dict[str, Any]:
    """Create the message of one frame's detections, with the stamps captured, inferred and published.

    If the autopilot's clock is known, the capture is also given in that clock, with its error.
    """
    return {
        **_of_frame(result, vehicle, published_ns, view),
        "captured_boot_ns": None if clock is None else result.captured_ns + clock.offset_ns,
        "captured_boot_error_ns": None if clock is None else clock.error_ns,
        "inferred_ns": result.inferred_ns,
        "timing_ms": {stage: round(value, 2) for stage, value in result.timing_ms.items()},
        "dropped": result.dropped,
        "detections": result.detections.records(),
    }


def tracks_message(
    result: PerceptionResult, vehicle: str, published_ns: int, view: str | None = None
) -> dict[str, Any]:
    """Create the message of one frame's track events; every track in it is or was confirmed."""
    return {
        **_of_frame(result, vehicle, published_ns, view),
        "events": [_track_event(event) for event in result.track_events],
    }


def _of_frame(result: PerceptionResult, vehicle: str, published_ns: int, view: str | None) -> dict[str, Any]:
    """Return the common fields of messages about one frame."""
    return {
        "vehicle": vehicle,
        "camera": view,
        "sequence": result.sequence,
        "captured_ns": result.captured_ns,
        "published_ns": published_ns,
        "width": result.width,
        "height": result.height,
    }


def _track_event(event: TrackEvent) -> dict[str, Any]:
    track = event.track
    return {
        "event": event.kind.value,
        "stamp_ns": event.stamp_ns,
        "track_id": track.track_id,
        "class_id": track.class_id,
        "class_name": track.class_name,
        "xyxy": [round(value, 2) for value in track.xyxy],
        "confidence": round(track.confidence, 4),
        "track_score": round(track.score, 4),
        "track_state": track.state.value,
        "seen": track.seen,
        "first_ns": track.first_ns,
        "last_ns": track.last_ns,
    }


def labels_message(result: PerceptionResult) -> str:
    """Join the class names of one frame, comma separated, in the detections' order."""
    return ", ".join(result.detections.names) or NO_OBJECTS


def vehicle_message(state: VehicleState, now_ns: int) -> dict[str, Any]:
    """Create the vehicle's message. Metres, metres a second, radians; NED; `attitude_wxyz`: FRD to NED."""
    return {
        "stamp_ns": now_ns,
        "connected": state.connected(now_ns),
        "heartbeat_age_s": _age_s(state.heartbeat_ns, now_ns),
        "position_age_s": _age_s(state.position_ns, now_ns),
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
        "altitude_m": None if state.altitude_m is None else round(state.altitude_m, 3),
        "latitude_deg": _finite(state.latitude_deg),
        "longitude_deg": _finite(state.longitude_deg),
        "altitude_amsl_m": _finite(state.altitude_amsl_m),
        "battery_fraction": state.battery_fraction,
        "gimbal": None if state.gimbal is None else _gimbal(state.gimbal, now_ns),
    }


def _gimbal(gimbal: GimbalState, now_ns: int) -> dict[str, Any]:
    """Return the gimbal's fields: radians; `attitude_wxyz`: FRD to NED, or to NED rotated by the heading."""
    return {
        "attitude_age_s": _age_s(gimbal.attitude_ns, now_ns),
        "attitude_wxyz": _rounded(gimbal.attitude, 5),
        "yaw_from": gimbal.yaw_frame.value,
        "pitch_rad": None if gimbal.pitch_rad is None else round(gimbal.pitch_rad, 4),
        "primary_control": gimbal.primary_control,
    }


def setpoint_message(setpoint: Setpoint | None) -> dict[str, Any] | None:
    """Create the message of a setpoint; None for None."""
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


def _age_s(stamp_ns: int, now_ns: int) -> float | None:
    return round((now_ns - stamp_ns) / 1e9, 3) if stamp_ns else None


def _rounded(values: tuple[float, ...] | None, digits: int = 3) -> list[float] | None:
    return None if values is None else [round(value, digits) for value in values]


def _finite(value: float | None) -> float | None:
    """Replace NaN and infinity, which JSON lacks, by None."""
    return value if value is not None and math.isfinite(value) else None
