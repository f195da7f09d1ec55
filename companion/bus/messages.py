"""Builds the bodies of the messages about frames and cameras (`bodies/frames.py`)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from companion.bus.bodies.frames import (
    BoardBody,
    CameraInfoBody,
    CloudBody,
    DepthBody,
    DepthImageBody,
    DetectionBody,
    DetectionsBody,
    ErrorEllipseBody,
    FrameBody,
    ImageBody,
    MarkerBody,
    MarkersBody,
    ObjectBody,
    PositionBody,
    TrackEventBody,
    TracksBody,
    TransformBody,
    TransformsBody,
)
from companion.bus.bodies.vehicle import ObstaclesBody
from companion.bus.topics import NO_OBJECTS
from companion.geometry.geodesy import GeodeticOrigin
from companion.guidance.objects.from_detections import StateHistory, mount_at
from companion.guidance.objects.from_markers import BoardTarget, BodyPose, LocalizedMarkers, MarkerTarget
from companion.guidance.objects.target import Target
from companion.guidance.objects.tracked_object import TrackedObject
from companion.vehicle.clock_sync import ClockOffset
from companion.vehicle.state import Vector3
from vision.camera_model import CameraModel, CameraMount
from vision.detections import DetectionRecord
from vision.geolocation import ErrorEllipse
from vision.markers import Marker
from vision.obstacle_sectors import SECTOR_RAD, ObstacleSectors
from vision.pipeline import PerceptionResult
from vision.rotation import quaternion_from_matrix
from vision.tracking import TrackEvent


@dataclass(frozen=True, slots=True)
class Localization:
    """Positions of one frame's detections.

    Attributes:
        targets: one per detection, in their order; empty if `error` gives the reason.
        error: why the detections have no direction; empty if they have.
        origin: of local NED; None while latitude and longitude are unknown.
        objects: the camera's, as guidance gets them.
    """

    targets: tuple[Target, ...] = ()
    error: str = ""
    origin: GeodeticOrigin | None = None
    objects: tuple[TrackedObject, ...] = ()


@dataclass(frozen=True, slots=True)
class ModelIdentity:
    """A loaded model: its name, and the SHA-256 of its file (None: it has no file)."""

    name: str
    sha256: str | None


def detections_message(
    result: PerceptionResult,
    vehicle: str,
    published_ns: int,
    view: str | None = None,
    clock: ClockOffset | None = None,
    *,
    model: ModelIdentity | None = None,
    localization: Localization | None = None,
) -> DetectionsBody:
    """Create the message of one frame's detections, with the stamps captured, inferred and published.

    Args:
        clock: the autopilot's; the capture is then also given in it, with its error.
        localization: of the steering camera; None for others.
    """
    detections, localized = result.detections, localization or Localization()
    records = detections.records()
    # A box where the lens has no rays has no target.
    targets: dict[tuple[str, tuple[float, ...]], Target] = {
        (target.class_name, target.box_xyxy): target for target in localized.targets
    }
    ages_s: list[float | None] = [None] * len(records)
    if detections.track_first_ns is not None:
        first_ns = detections.track_first_ns.tolist()
        ages_s = [round((result.captured_ns - first) / 1e9, 3) if first else None for first in first_ns]
    origin = localized.origin
    object_ids: dict[tuple[str, tuple[float, ...]], int] = {
        (each.detection.class_name, each.detection.box_xyxy): each.object_id
        for each in localized.objects
        if not each.occluded
    }
    return {
        **_of_frame(result, vehicle, published_ns, view),
        "captured_boot_ns": None if clock is None else result.captured_ns + clock.offset_ns,
        "captured_boot_error_ns": None if clock is None else clock.error_ns,
        "inferred_ns": result.inferred_ns,
        "model": None if model is None else model.name,
        "model_sha256": None if model is None else model.sha256,
        "localization_error": None if localization is None else localization.error,
        "timing_ms": {stage: round(value, 2) for stage, value in result.timing_ms.items()},
        "dropped": result.dropped,
        "detections": [
            _detection(record, age_s, targets.get(box), origin, object_ids.get(box))
            for record, age_s in zip(records, ages_s, strict=True)
            for box in [(record["class_name"], tuple(record["xyxy"]))]
        ],
        "objects": [_object(each, origin) for each in localized.objects],
    }


def _detection(
    record: DetectionRecord,
    age_s: float | None,
    target: Target | None,
    origin: GeodeticOrigin | None,
    object_id: int | None,
) -> DetectionBody:
    position = None if target is None else target.position_ned_m
    covariance = None if target is None else target.position_covariance
    ellipse = None
    if target is not None and covariance is not None:
        ellipse = ErrorEllipse.of(covariance + np.eye(2) * target.vehicle_sigma_m**2)
    return {
        "class_id": record["class_id"],
        "class_name": record["class_name"],
        "confidence": record["confidence"],
        "xyxy": record["xyxy"],
        "center": record["center"],
        "depth_m": record["depth_m"],
        "nearest_camera_m": record["nearest_camera_m"],
        "track_id": record.get("track_id"),
        "track_score": record.get("track_score"),
        "track_state": record.get("track_state"),
        "object_id": object_id,
        "track_age_s": age_s,
        "bearing_rad": None if target is None else round(target.bearing_rad, 4),
        "elevation_rad": None if target is None else round(target.elevation_rad, 4),
        "ground_range_m": None if target is None else _number(target.ground_range_m),
        "distance_m": None if target is None else _number(target.distance_m),
        "range_source": None if target is None else target.range_source.value,
        "range_sigma_m": None if target is None else _number(target.range_sigma_m),
        "depth_sigma_m": None if target is None else _number(target.depth_sigma_m),
        "distance_sigma_m": None if target is None else _number(target.distance_sigma_m),
        **_position_fields(position, origin, ellipse),
    }


def _position_fields(
    position: Vector3 | None, origin: GeodeticOrigin | None, ellipse: ErrorEllipse | None
) -> PositionBody:
    latitude_deg, longitude_deg, altitude_amsl_m = _place(position, origin)
    return {
        "position_ned_m": None if position is None else [round(value, 3) for value in position],
        "latitude_deg": latitude_deg,
        "longitude_deg": longitude_deg,
        "altitude_amsl_m": altitude_amsl_m,
        "error_ellipse": None if ellipse is None else _ellipse(ellipse),
    }


def _place(
    position: Vector3 | None, origin: GeodeticOrigin | None
) -> tuple[float, float, float] | tuple[None, None, None]:
    if position is None or origin is None:
        return None, None, None
    latitude_deg, longitude_deg, altitude_amsl_m = origin.place(position)
    return round(latitude_deg, 8), round(longitude_deg, 8), round(altitude_amsl_m, 3)


def _object(each: TrackedObject, origin: GeodeticOrigin | None) -> ObjectBody:
    latitude_deg, longitude_deg, altitude_amsl_m = _place(each.position_ned_m, origin)
    return {
        "object_id": each.object_id,
        "track_ids": list(each.track_ids),
        "class_name": each.class_name,
        "position_ned_m": None if each.position_ned_m is None else list(each.position_ned_m),
        "latitude_deg": latitude_deg,
        "longitude_deg": longitude_deg,
        "altitude_amsl_m": altitude_amsl_m,
        "velocity_ned_mps": list(each.velocity_ned_mps),
        "covariance": [value for row in each.covariance for value in row],
        "moving": each.moving,
        "located_ns": each.located_ns,
        "first_ns": each.first_ns,
        "last_ns": each.last_ns,
        "confirmed": each.confirmed,
        "ambiguous": each.ambiguous,
        "doubt": each.doubt,
        "occluded": each.occluded,
        "frames": each.frames,
    }


def _ellipse(ellipse: ErrorEllipse) -> ErrorEllipseBody:
    return {
        "semi_major_m": round(ellipse.semi_major_m, 3),
        "semi_minor_m": round(ellipse.semi_minor_m, 3),
        "orientation_rad": round(ellipse.orientation_rad, 4),
    }


def tracks_message(
    result: PerceptionResult,
    vehicle: str,
    published_ns: int,
    view: str | None = None,
    localization: Localization | None = None,
) -> TracksBody:
    """Create the message of one frame's track events; every track in it is or was confirmed."""
    localized = localization or Localization()
    of_track = {track_id: each for each in localized.objects for track_id in each.track_ids}
    seen = [of_track.get(event.track.track_id) for event in result.track_events]
    named = {each.object_id: each for each in seen if each is not None}
    return {
        **_of_frame(result, vehicle, published_ns, view),
        "events": [
            _track_event(event, each, localized.origin)
            for event, each in zip(result.track_events, seen, strict=True)
        ],
        "objects": [_object(each, localized.origin) for each in named.values()],
    }


def _of_frame(result: PerceptionResult, vehicle: str, published_ns: int, view: str | None) -> FrameBody:
    return {
        "vehicle": vehicle,
        "camera": view,
        "sequence": result.sequence,
        "captured_ns": result.captured_ns,
        "published_ns": published_ns,
        "width": result.width,
        "height": result.height,
    }


def _track_event(
    event: TrackEvent, seen: TrackedObject | None, origin: GeodeticOrigin | None
) -> TrackEventBody:
    track = event.track
    at_ns = event.track.last_ns
    located = seen is not None and seen.confirmed and seen.located(at_ns)
    position = seen.position_at(at_ns) if seen is not None and located else None
    ellipse = seen.ellipse_at(at_ns) if seen is not None and located else None
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
        **_position_fields(position, origin, ellipse),
        "moving": seen.moving if seen is not None and located else None,
        "object_id": None if seen is None else seen.object_id,
    }


def labels_message(result: PerceptionResult) -> str:
    """Join the class names of one frame, comma separated, in the detections' order."""
    return ", ".join(result.detections.names) or NO_OBJECTS


def image_attachment(sequence: int, captured_ns: int, view: str | None, *, annotated: bool) -> ImageBody:
    """Create the attachment of one image."""
    return {"camera": view, "sequence": sequence, "captured_ns": captured_ns, "annotated": annotated}


def depth_image_attachment(
    sequence: int, captured_ns: int, view: str | None, width: int, height: int
) -> DepthImageBody:
    """Create the attachment of one depth image."""
    return {
        "camera": view,
        "sequence": sequence,
        "captured_ns": captured_ns,
        "width": width,
        "height": height,
    }


def cloud_attachment(
    sequence: int, captured_ns: int, vehicle: str, view: str | None, points: int
) -> CloudBody:
    """Create the attachment of one point cloud."""
    return {
        "camera": view,
        "sequence": sequence,
        "captured_ns": captured_ns,
        "frame_id": camera_frame_id(vehicle, view),
        "points": points,
    }


def markers_message(
    result: PerceptionResult,
    vehicle: str,
    published_ns: int,
    view: str | None,
    localized: LocalizedMarkers,
    origin: GeodeticOrigin | None = None,
) -> MarkersBody:
    """Create the message of one frame's markers. `origin`: of local NED; None while it is unknown."""
    markers = result.markers or ()
    targets = localized.targets or (None,) * len(markers)
    return {
        **_of_frame(result, vehicle, published_ns, view),
        "localization_error": localized.error,
        "markers": [marker_body(marker, target) for marker, target in zip(markers, targets, strict=True)],
        "boards": [board_body(board) for board in localized.boards],
        "objects": [_object(each, origin) for each in localized.objects],
    }


def marker_body(marker: Marker, target: MarkerTarget | None) -> MarkerBody:
    """Create the part of one marker; `target` is None where the vehicle's pose is unknown."""
    return {
        "id": marker.identifier,
        "size_m": marker.size_m,
        "corners_px": [[round(float(value), 2) for value in corner] for corner in marker.corners_px],
        "position_camera_m": [round(float(value), 4) for value in marker.position_camera_m],
        "reprojection_px": round(marker.reprojection_px, 3),
        "ambiguity": round(marker.ambiguity, 3),
        "pad": None if target is None else target.pad,
        "bearing_rad": None if target is None else round(target.bearing_rad, 4),
        "elevation_rad": None if target is None else round(target.elevation_rad, 4),
        "distance_m": None if target is None else round(target.distance_m, 4),
        "ground_range_m": None if target is None else round(target.ground_range_m, 4),
        "heading_rad": None if target is None else round(target.heading_rad, 4),
        "position_ned_m": None if target is None else [round(value, 3) for value in target.position_ned_m],
        "pad_ned_m": None if target is None else [round(value, 3) for value in target.pad_ned_m],
        "resolved": None if target is None else target.resolved,
        "position_body_m": None if target is None else [round(value, 4) for value in target.body.position_m],
        "rotation_body_wxyz": None if target is None else [round(value, 5) for value in target.body.rotation],
        "covariance_body": None if target is None else _covariance(target.body),
        "range_sigma_m": None if target is None else _rounded(target.body.range_sigma_m),
        "angle_sigma_rad": None if target is None else _rounded(target.body.angle_sigma_rad),
    }


def board_body(board: BoardTarget) -> BoardBody:
    """Create the part of one board."""
    return {
        "name": board.name,
        "ids": list(board.identifiers),
        "reprojection_px": round(board.reprojection_px, 3),
        "ambiguous": board.ambiguous,
        "position_ned_m": [round(value, 3) for value in board.position_ned_m],
        "position_body_m": [round(value, 4) for value in board.body.position_m],
        "rotation_body_wxyz": [round(value, 5) for value in board.body.rotation],
        "covariance_body": _covariance(board.body),
        "range_sigma_m": _rounded(board.body.range_sigma_m),
        "angle_sigma_rad": _rounded(board.body.angle_sigma_rad),
    }


def _covariance(pose: BodyPose) -> list[float]:
    return [_rounded(value) for value in pose.covariance]


def _rounded(value: float) -> float:
    """Return three digits."""
    return float(f"{value:.2e}")


def depth_message(
    result: PerceptionResult, vehicle: str, published_ns: int, view: str | None = None
) -> DepthBody:
    """Create the message of one frame's depth image, which it must have."""
    assert result.depth is not None
    return {
        **_of_frame(result, vehicle, published_ns, view),
        "centre_m": _number(result.depth.centre_m),
        "valid_share": round(result.depth.valid_share, 4),
        "boxes": [
            {
                "class_name": record["class_name"],
                "track_id": record["track_id"],
                "xyxy": record["xyxy"],
                "depth_m": record["depth_m"],
            }
            for record in result.detections.records()
        ],
    }


def obstacles_message(seen: ObstacleSectors, vehicle: str) -> ObstaclesBody:
    """Create the message of 72 sector distances, clockwise from north; None: no obstacle, or unknown."""
    return {
        "vehicle": vehicle,
        "captured_ns": seen.captured_ns,
        "frame": "north",
        "increment_deg": math.degrees(SECTOR_RAD),
        "distance_m": [round(value, 2) if math.isfinite(value) else None for value in seen.distance_m],
        "known": [not math.isnan(value) for value in seen.distance_m],
    }


def camera_frame_id(vehicle: str, view: str | None) -> str:
    """Return the name of a camera's optical frame; others are `<vehicle>/ned`, `/body` and `/gimbal`."""
    return f"{vehicle}/camera" if view is None else f"{vehicle}/cameras/{view}"


def camera_info_message(
    camera: CameraModel, mount: CameraMount, *, calibrated: bool, vehicle: str, view: str | None, now_ns: int
) -> CameraInfoBody:
    """Create the message of one camera's lens and mount."""
    fx, fy, cx, cy = camera.fx, camera.fy, camera.cx, camera.cy
    return {
        "vehicle": vehicle,
        "camera": view,
        "stamp_ns": now_ns,
        "frame_id": camera_frame_id(vehicle, view),
        "width": camera.width,
        "height": camera.height,
        "distortion_model": camera.distortion_model,
        "d": list(camera.coefficients),
        "k": [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
        "r": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        "p": [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
        "calibrated": calibrated,
        "mount": {
            "parent_frame_id": f"{vehicle}/{'gimbal' if mount.on_gimbal else 'body'}",
            "translation_m": [mount.forward_m, mount.right_m, mount.down_m],
            "rotation_wxyz": _quaternion(mount.parent_from_optical),
            "stabilized": mount.stabilized,
            "on_gimbal": mount.on_gimbal,
        },
    }


def transforms_message(
    sequence: int,
    captured_ns: int,
    mount: CameraMount,
    history: StateHistory,
    vehicle: str,
    view: str | None = None,
) -> TransformsBody:
    """Create the message of the transforms at a frame's capture.

    Raises:
        HistoryError: the pose of the vehicle or its gimbal at that time is unknown.
    """
    pose, mount = history.at(captured_ns), mount_at(mount, history, captured_ns)
    body, camera = f"{vehicle}/body", camera_frame_id(vehicle, view)
    on_body = [mount.forward_m, mount.right_m, mount.down_m]
    chain = [_transform(f"{vehicle}/ned", body, list(pose.position_ned_m), pose.ned_from_body)]
    if mount.ned_from_gimbal is not None:
        gimbal = f"{vehicle}/gimbal"
        chain.append(_transform(body, gimbal, on_body, pose.ned_from_body.T @ mount.ned_from_gimbal))
        chain.append(_transform(gimbal, camera, [0.0, 0.0, 0.0], mount.parent_from_optical))
    else:
        body_from_optical = pose.ned_from_body.T @ mount.ned_from_optical(pose.ned_from_body)
        chain.append(_transform(body, camera, on_body, body_from_optical))
    return {
        "vehicle": vehicle,
        "camera": view,
        "sequence": sequence,
        "captured_ns": captured_ns,
        "transforms": chain,
    }


def _transform(parent: str, child: str, translation_m: list[float], rotation: Any) -> TransformBody:
    return {
        "parent_frame_id": parent,
        "child_frame_id": child,
        "translation_m": [round(value, 4) for value in translation_m],
        "rotation_wxyz": _quaternion(rotation),
    }


def _quaternion(rotation: Any) -> list[float]:
    return [round(value, 6) for value in quaternion_from_matrix(rotation)]


def _number(value: float) -> float | None:
    return round(value, 3) if math.isfinite(value) else None
