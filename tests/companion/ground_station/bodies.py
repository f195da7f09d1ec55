"""Messages of the bus, as the service publishes them, and commands of a station."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from companion.bus.bodies.frames import DetectionBody, DetectionsBody, ObjectBody
from companion.bus.bodies.service import CommandStateBody

MS = 1_000_000
NOW_NS = 1_000_000 * MS
WIDTH, HEIGHT = 640, 480
STATION = (255, 190)


def detection(track_id: int, xyxy: Sequence[float], **changes: Any) -> DetectionBody:
    left, top, right, bottom = xyxy
    body: DetectionBody = {
        "class_id": 0,
        "class_name": "person",
        "confidence": 0.8,
        "xyxy": list(xyxy),
        "center": [(left + right) / 2, (top + bottom) / 2],
        "depth_m": None,
        "nearest_camera_m": None,
        "track_id": track_id,
        "track_score": 0.7,
        "track_state": "confirmed",
        "object_id": None,
        "track_age_s": 1.0,
        "bearing_rad": 0.5,
        "elevation_rad": -0.3,
        "ground_range_m": 8.0,
        "distance_m": 10.0,
        "range_source": "ground_plane",
        "range_sigma_m": 0.5,
        "depth_sigma_m": None,
        "distance_sigma_m": 0.5,
        "position_ned_m": None,
        "latitude_deg": None,
        "longitude_deg": None,
        "altitude_amsl_m": None,
        "error_ellipse": {"semi_major_m": 2.0, "semi_minor_m": 1.0, "orientation_rad": 0.0},
    }
    return body | changes  # type: ignore[return-value]


def tracked_object(object_id: int, track_ids: Sequence[int], **changes: Any) -> ObjectBody:
    body: ObjectBody = {
        "object_id": object_id,
        "track_ids": list(track_ids),
        "class_name": "person",
        "position_ned_m": [10.0, 2.0, 0.0],
        "latitude_deg": 47.3977419,
        "longitude_deg": 8.5455938,
        "altitude_amsl_m": 488.125,
        "velocity_ned_mps": [1.0, -1.0],
        "covariance": [4.0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 0.25, 0, 0, 0, 0, 0.04],
        "moving": True,
        "located_ns": NOW_NS,
        "first_ns": NOW_NS,
        "last_ns": NOW_NS,
        "confirmed": True,
        "ambiguous": False,
        "doubt": 0.0,
        "occluded": False,
        "frames": 10,
    }
    return body | changes  # type: ignore[return-value]


def frame(
    *detections: DetectionBody,
    now_ns: int = NOW_NS,
    sequence: int = 1,
    objects: Sequence[ObjectBody] = (),
    delay_ms: int = 25,
) -> DetectionsBody:
    return {
        "vehicle": "test",
        "camera": None,
        "sequence": sequence,
        "captured_ns": now_ns - (5 + delay_ms) * MS,
        "published_ns": now_ns - 5 * MS,
        "width": WIDTH,
        "height": HEIGHT,
        "captured_boot_ns": None,
        "captured_boot_error_ns": None,
        "inferred_ns": now_ns - 8 * MS,
        "model": "m",
        "model_sha256": None,
        "localization_error": "",
        "timing_ms": {},
        "dropped": 0,
        "detections": list(detections),
        "objects": list(objects),
    }


def command_state(
    identifier: str,
    command: str,
    state: str,
    reason: str = "",
    *,
    stamp_ns: int = NOW_NS,
    success: bool = True,
) -> CommandStateBody:
    return {
        "stamp_ns": stamp_ns,
        "id": identifier,
        "command": command,
        "state": state,
        "success": success if state == "ended" else None,
        "reason": reason,
    }


def command(number: int, *parameters: float, sender: tuple[int, int] = STATION, as_int: bool = False) -> Any:
    """A command of a station to component 100, as COMMAND_LONG or COMMAND_INT."""
    values = [*parameters, *[0.0] * (7 - len(parameters))]
    message: Any
    if as_int:
        x, y = (0 if math.isnan(value) else round(value) for value in values[4:6])
        message = mavlink.MAVLink_command_int_message(1, 100, 0, number, 0, 0, *values[:4], x, y, values[6])
    else:
        message = mavlink.MAVLink_command_long_message(1, 100, number, 0, *values)
    message._header.srcSystem, message._header.srcComponent = sender
    return message
