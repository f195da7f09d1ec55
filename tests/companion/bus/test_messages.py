"""The published messages are a contract; JSON has neither NaN nor infinity."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np

from companion.bus.messages import (
    detections_message,
    labels_message,
    tracks_message,
)
from companion.bus.topics import NO_OBJECTS
from companion.bus.vehicle_messages import setpoint_message, vehicle_message
from companion.vehicle.clock_sync import ClockOffset
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import FlightMode, VehicleState
from vision.detections import NO_TRACK, Detections
from vision.pipeline import PerceptionResult
from vision.tracking import Track, TrackEvent, TrackEventKind, TrackState

NAMES = ("person", "car")


def result(detections: Detections) -> PerceptionResult:
    return PerceptionResult(7, 1_000, 2_000, 640, 480, detections, {"inference": 20.123}, 3)


def strictly(value: object) -> Any:
    """Convert through strict JSON."""
    return json.loads(json.dumps(value, allow_nan=False))


def one_car(depth_m: float) -> Detections:
    return Detections(
        np.array([[10, 20, 30, 60]], np.float32),
        np.array([0.9], np.float32),
        np.array([1], np.int64),
        NAMES,
        np.array([[0.5, -0.25 + 0.0 * depth_m, depth_m]], np.float32),
    )


def test_detection_message() -> None:
    message = strictly(detections_message(result(one_car(11.5)), "alpha", 3_000))
    assert message == {
        "camera": None,
        "vehicle": "alpha",
        "sequence": 7,
        "captured_ns": 1_000,
        "inferred_ns": 2_000,
        "published_ns": 3_000,
        "captured_boot_ns": None,
        "captured_boot_error_ns": None,
        "model": None,
        "model_sha256": None,
        "localization_error": None,
        "width": 640,
        "height": 480,
        "timing_ms": {"inference": 20.12},
        "dropped": 3,
        "detections": [
            {
                "class_id": 1,
                "class_name": "car",
                "confidence": 0.9,
                "xyxy": [10.0, 20.0, 30.0, 60.0],
                "center": [20.0, 40.0],
                "depth_m": 11.5,
                "nearest_camera_m": [0.5, -0.25, 11.5],
                "track_id": None,
                "track_score": None,
                "track_state": None,
                "object_id": None,
                "track_age_s": None,
                "bearing_rad": None,
                "elevation_rad": None,
                "ground_range_m": None,
                "distance_m": None,
                "range_source": None,
                "range_sigma_m": None,
                "depth_sigma_m": None,
                "distance_sigma_m": None,
                "position_ned_m": None,
                "latitude_deg": None,
                "longitude_deg": None,
                "altitude_amsl_m": None,
                "error_ellipse": None,
            }
        ],
        "objects": [],
    }


def test_tracked_detection_has_id_score_and_state() -> None:
    cars = Detections(
        np.zeros((3, 4), np.float32),
        np.full(3, 0.9, np.float32),
        np.ones(3, np.int64),
        NAMES,
        track_id=np.array([7, 8, NO_TRACK]),
        track_score=np.array([0.81, 0.4, np.nan], np.float32),
        track_confirmed=np.array([True, False, False]),
    )
    message = strictly(detections_message(result(cars), "alpha", 3_000))
    tracks = [
        (record["track_id"], record["track_score"], record["track_state"]) for record in message["detections"]
    ]
    assert tracks == [(7, 0.81, "confirmed"), (8, 0.4, "tentative"), (None, None, "none")]


def test_capture_is_given_in_the_autopilots_clock() -> None:
    clock = ClockOffset(offset_ns=-400, error_ns=25)
    message = strictly(detections_message(result(one_car(11.5)), "alpha", 3_000, clock=clock))
    assert (message["captured_boot_ns"], message["captured_boot_error_ns"]) == (600, 25)
    vehicle = strictly(vehicle_message(VehicleState(clock=clock), 5_000))
    assert (vehicle["boot_offset_ns"], vehicle["boot_error_ns"]) == (-400, 25)


def test_tracks_message() -> None:
    track = Track(7, 1, "car", TrackState.CONFIRMED, (10.0, 20.0, 30.123, 60.0), 0.9, 0.81234, 5, 100, 900)
    events = (TrackEvent(TrackEventKind.LOST, 1_000, track),)
    message = strictly(tracks_message(replace(result(one_car(1.0)), track_events=events), "alpha", 3_000))
    assert message == {
        "camera": None,
        "vehicle": "alpha",
        "sequence": 7,
        "captured_ns": 1_000,
        "published_ns": 3_000,
        "width": 640,
        "height": 480,
        "events": [
            {
                "event": "lost",
                "stamp_ns": 1_000,
                "track_id": 7,
                "class_id": 1,
                "class_name": "car",
                "xyxy": [10.0, 20.0, 30.12, 60.0],
                "confidence": 0.9,
                "track_score": 0.8123,
                "track_state": "confirmed",
                "seen": 5,
                "first_ns": 100,
                "last_ns": 900,
                "position_ned_m": None,
                "latitude_deg": None,
                "longitude_deg": None,
                "altitude_amsl_m": None,
                "error_ellipse": None,
                "moving": None,
                "object_id": None,
            }
        ],
        "objects": [],
    }


def test_unknown_range_is_null() -> None:
    message = strictly(detections_message(result(one_car(math.nan)), "alpha", 3_000))
    (car,) = message["detections"]
    assert car["depth_m"] is None
    assert car["nearest_camera_m"] is None


def test_labels_message() -> None:
    assert labels_message(result(one_car(1.0))) == "car"
    assert labels_message(result(Detections.empty(NAMES))) == NO_OBJECTS


def test_initial_vehicle_message_is_valid_json() -> None:
    message = strictly(vehicle_message(VehicleState(), 5_000_000_000))
    assert message["connected"] is False
    assert message["position_ned_m"] is None
    assert message["heartbeat_age_s"] is None


def test_vehicle_message_in_flight() -> None:
    now_ns = 10_000_000_000
    state = VehicleState(
        heartbeat_ns=now_ns - 500_000_000,
        position_ns=now_ns - 20_000_000,
        global_ns=now_ns - 300_000_000,
        armed=True,
        mode=FlightMode.OFFBOARD,
        position_ned_m=(1.0, 2.0, -4.0),
        home_position_ned_m=(0.0, 0.0, 1.0),
        attitude=(1.0, 0.0, 0.0, 0.0),
    )
    message = vehicle_message(state, now_ns)
    assert message["connected"]
    assert message["altitude_m"] == 5.0
    assert (message["position_age_s"], message["global_age_s"]) == (0.02, 0.3)
    assert message["mode"] == "offboard"


def test_setpoint_message_has_null_for_unset_fields() -> None:
    message = strictly(setpoint_message(Setpoint.velocity((1.0, 0.0, 0.0), 0)))
    assert message["position_ned_m"] is None
    assert message["velocity_ned_mps"] == [1.0, 0.0, 0.0]
    assert setpoint_message(None) is None
