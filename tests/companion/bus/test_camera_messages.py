"""Lens, mount, transforms and positions as published, against the geometry that guidance uses."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from companion.bus.bodies.frames import TransformsBody
from companion.bus.messages import (
    Localization,
    ModelIdentity,
    camera_info_message,
    depth_message,
    detections_message,
    tracks_message,
    transforms_message,
)
from companion.bus.vehicle_messages import geodetic_origin
from companion.geometry.geodesy import GeodeticOrigin, north_east
from companion.guidance.objects.from_detections import StateHistory, targets_from_detections
from companion.guidance.objects.table import ObjectTable
from companion.guidance.objects.target import RangeSource, Target
from companion.vehicle.gimbal import GimbalState
from companion.vehicle.state import VehicleState
from tests.companion.bus.message_check import check_message
from vision.attitude import quaternion_from_euler
from vision.camera_model import CameraModel, CameraMount, DistortionModel
from vision.depth import DepthSummary
from vision.detections import NO_TRACK, Detections
from vision.pipeline import PerceptionResult
from vision.rotation import matrix_from_quaternion
from vision.tracking import Track, TrackEvent, TrackEventKind, TrackState

NOW_NS = 5_000_000_000
CAMERA = CameraModel(640, 480, 400.0, 410.0, 320.0, 239.0, (0.1, -0.02, 0.001, 0.002))
STATE = VehicleState(
    heartbeat_ns=NOW_NS,
    attitude_ns=NOW_NS,
    position_ns=NOW_NS - 100_000_000,
    global_ns=NOW_NS,
    position_ned_m=(30.0, -20.0, -5.0),
    velocity_ned_mps=(2.0, 0.0, -1.0),
    attitude=quaternion_from_euler(0.1, -0.2, 0.7),
    latitude_deg=47.4,
    longitude_deg=8.5,
    altitude_amsl_m=500.0,
)
GIMBAL = GimbalState(attitude_ns=NOW_NS, attitude=quaternion_from_euler(0.0, -0.5, 1.1))


def history_of(state: VehicleState) -> StateHistory:
    history = StateHistory()
    history.add(replace(state, position_ns=NOW_NS))
    return history


def in_ned(message: TransformsBody, point: NDArray[np.float64]) -> NDArray[np.float64]:
    """A point in the camera's frame through all transforms, the last one first."""
    for transform in reversed(message["transforms"]):
        w, x, y, z = transform["rotation_wxyz"]
        point = matrix_from_quaternion((w, x, y, z)) @ point + transform["translation_m"]
    return point


@pytest.mark.parametrize(
    ("mount", "frames"),
    [
        (CameraMount(0.1, 0.02, 0.05, 0.1, -0.4, 0.2), ["v/ned", "v/body", "v/camera"]),
        (CameraMount(0.1, pitch_rad=-1.0, stabilized=True), ["v/ned", "v/body", "v/camera"]),
        (CameraMount(0.1, yaw_rad=0.1, on_gimbal=True), ["v/ned", "v/body", "v/gimbal", "v/camera"]),
    ],
    ids=["fixed", "stabilized", "gimbal"],
)
def test_transforms_lead_from_camera_to_ned(mount: CameraMount, frames: list[str]) -> None:
    message = transforms_message(7, NOW_NS, mount, history_of(replace(STATE, gimbal=GIMBAL)), "v")
    check_message("transforms", message)
    parents = [transform["parent_frame_id"] for transform in message["transforms"]]
    children = [transform["child_frame_id"] for transform in message["transforms"]]
    assert [parents[0], *children] == frames
    assert parents[1:] == children[:-1]
    ned_from_body = matrix_from_quaternion(quaternion_from_euler(0.1, -0.2, 0.7))
    held = mount.held(matrix_from_quaternion(quaternion_from_euler(0.0, -0.5, 1.1)))
    point = np.array([1.0, -2.0, 10.0])
    ned_from_optical = (held if mount.on_gimbal else mount).ned_from_optical(ned_from_body)
    expected = np.array([30.0, -20.0, -5.0]) + ned_from_body @ mount.position_frd_m + ned_from_optical @ point
    np.testing.assert_allclose(in_ned(message, point), expected, atol=1e-3)


def test_camera_info_has_the_lens_and_the_mount() -> None:
    mount = CameraMount(0.1, pitch_rad=-0.4)
    message = camera_info_message(CAMERA, mount, calibrated=True, vehicle="v", view="down", now_ns=9)
    check_message("camera_info", message)
    assert (message["frame_id"], message["mount"]["parent_frame_id"]) == ("v/cameras/down", "v/body")
    assert message["d"] == [0.1, -0.02, 0.001, 0.002, 0.0]
    np.testing.assert_array_equal(np.reshape(message["k"], (3, 3)), CAMERA.matrix)
    np.testing.assert_array_equal(np.reshape(message["p"], (3, 4))[:, :3], CAMERA.matrix)
    w, x, y, z = message["mount"]["rotation_wxyz"]
    np.testing.assert_allclose(matrix_from_quaternion((w, x, y, z)), mount.body_from_optical, atol=1e-5)


@pytest.mark.parametrize(
    ("model", "distortion"),
    [
        ("rational_polynomial", (0.6, 0.08, 4e-4, -3e-4, 0.002, 0.9, 0.2, 0.01)),
        ("equidistant", (-0.02, 0.004, -0.002, 0.0003)),
    ],
)
def test_camera_info_names_the_distortion_model(
    model: DistortionModel, distortion: tuple[float, ...]
) -> None:
    lens = replace(CAMERA, distortion=distortion, distortion_model=model)
    message = camera_info_message(lens, CameraMount(), calibrated=True, vehicle="v", view=None, now_ns=9)
    check_message("camera_info", message)
    assert (message["distortion_model"], message["d"]) == (model, list(distortion))


def test_origin_is_where_the_global_position_says() -> None:
    origin = geodetic_origin(STATE, NOW_NS)
    assert origin is not None
    # By then the vehicle was 0.2 m further north and 0.1 m higher.
    north, east = north_east(origin[:2], (47.4, 8.5))
    assert (north, east) == pytest.approx((30.2, -20.0), abs=1e-3)
    assert origin.altitude_amsl_m == pytest.approx(494.9)
    latitude, longitude, altitude = origin.place((30.2, -20.0, -5.1))
    assert (latitude, longitude) == pytest.approx((47.4, 8.5), abs=1e-8)
    assert altitude == pytest.approx(500.0)


@pytest.mark.parametrize("change", [{"latitude_deg": math.nan}, {"global_ns": 1}, {"position_ned_m": None}])
def test_origin_is_unknown_without_a_recent_position(change: dict[str, float]) -> None:
    assert geodetic_origin(replace(STATE, **change), NOW_NS) is None  # type: ignore[arg-type]


def two_cars() -> PerceptionResult:
    cars = Detections(
        np.array([[300, 250, 340, 300], [10, 20, 30, 60]], np.float32),
        np.full(2, 0.9, np.float32),
        np.zeros(2, np.int64),
        ("car",),
        track_id=np.array([7, NO_TRACK]),
        track_score=np.array([0.81, np.nan], np.float32),
        track_confirmed=np.array([True, False]),
        track_first_ns=np.array([NOW_NS - 1_500_000_000, 0]),
    )
    return PerceptionResult(7, NOW_NS, NOW_NS, 640, 480, cars, {}, 0)


def test_detection_without_a_target_has_no_direction() -> None:
    result = two_cars()
    history = history_of(replace(STATE, attitude=(1.0, 0.0, 0.0, 0.0)))
    targets = targets_from_detections(
        result.detections.records()[1:], NOW_NS, CAMERA, CameraMount(pitch_rad=-0.4), history
    )
    message = detections_message(result, "v", NOW_NS, localization=Localization(targets))
    without, has = message["detections"]
    assert without["bearing_rad"] is None
    assert without["range_source"] is None
    assert has["bearing_rad"] == pytest.approx(targets[0].bearing_rad, abs=1e-3)


def test_detections_of_the_steering_camera_have_their_targets() -> None:
    result = two_cars()
    history = history_of(replace(STATE, attitude=(1.0, 0.0, 0.0, 0.0)))
    targets = targets_from_detections(
        result.detections.records(), NOW_NS, CAMERA, CameraMount(pitch_rad=-0.4), history
    )
    origin = GeodeticOrigin(47.4, 8.5, 500.0)
    message = detections_message(
        result,
        "v",
        NOW_NS,
        model=ModelIdentity("default", "ab" * 32),
        localization=Localization(targets, "", origin),
    )
    check_message("detections", message)
    near, far = message["detections"]
    assert (message["model"], message["model_sha256"]) == ("default", "ab" * 32)
    assert message["localization_error"] == ""
    assert (near["track_age_s"], far["track_age_s"]) == (1.5, None)
    assert near["range_source"] == "ground_plane"
    assert near["bearing_rad"] == pytest.approx(targets[0].bearing_rad, abs=1e-4)
    assert near["ground_range_m"] == pytest.approx(targets[0].ground_range_m, abs=1e-3)
    assert near["range_sigma_m"] == pytest.approx(targets[0].range_sigma_m, abs=1e-3)
    assert near["distance_sigma_m"] == pytest.approx(targets[0].distance_sigma_m, abs=1e-3)
    assert (near["depth_sigma_m"], far["distance_sigma_m"]) == (None, None)
    assert near["latitude_deg"] is not None
    assert near["longitude_deg"] is not None
    position = near["position_ned_m"]
    assert position is not None
    there = north_east(origin[:2], (near["latitude_deg"], near["longitude_deg"]))
    assert there == pytest.approx(position[:2], abs=0.01)
    assert near["altitude_amsl_m"] == pytest.approx(500.0 - position[2], abs=1e-3)
    ellipse, sigma_m = near["error_ellipse"], targets[0].vehicle_sigma_m
    assert ellipse is not None
    along, across = (math.hypot(sigma_m, s) for s in (targets[0].range_sigma_m, targets[0].across_sigma_m))
    assert (ellipse["semi_major_m"], ellipse["semi_minor_m"]) == pytest.approx(
        (max(along, across), min(along, across)), abs=1e-3
    )
    # Above the horizon: a direction, no range.
    assert (far["range_source"], far["ground_range_m"], far["position_ned_m"]) == ("none", None, None)
    assert far["elevation_rad"] is not None
    assert (far["latitude_deg"], far["error_ellipse"]) == (None, None)


def test_track_events_have_the_fused_position() -> None:
    target = Target(
        "car", 0.9, NOW_NS, 0.0, -0.3, 20.0, RangeSource.GROUND_PLANE, (20.0, 0.0, 0.0),
        track_id=7, range_sigma_m=2.0, across_sigma_m=0.4, vehicle_sigma_m=0.3,
    )  # fmt: skip
    objects, origin = ObjectTable(), GeodeticOrigin(47.4, 8.5, 500.0)
    objects.update([target], (0.0, 0.0, -5.0), NOW_NS)
    box = (1.0, 2.0, 3.0, 4.0)
    events = tuple(
        TrackEvent(
            TrackEventKind.UPDATE,
            NOW_NS,
            Track(track_id, 0, "car", TrackState.CONFIRMED, box, 0.9, 0.8, 5, 1, NOW_NS),
        )
        for track_id in (7, 8)
    )
    message = tracks_message(
        replace(two_cars(), track_events=events),
        "v",
        NOW_NS,
        localization=Localization((target,), "", origin, objects.objects),
    )
    check_message("tracks", message)
    ours, other = message["events"]
    assert ours["position_ned_m"] == [20.0, 0.0, 0.0]
    assert ours["latitude_deg"] == pytest.approx(47.4 + 20.0 / 111_180, abs=1e-6)
    assert (ours["longitude_deg"], ours["altitude_amsl_m"], ours["moving"]) == (8.5, 500.0, False)
    ellipse = {"semi_major_m": 2.022, "semi_minor_m": 0.5, "orientation_rad": 0.0}
    assert ours["error_ellipse"] == ellipse
    assert (other["position_ned_m"], other["error_ellipse"], other["moving"]) == (None, None, None)


def test_detections_without_a_pose_say_why() -> None:
    message = detections_message(two_cars(), "v", NOW_NS, localization=Localization((), "no attitude"))
    check_message("detections", message)
    assert message["localization_error"] == "no attitude"
    assert [car["bearing_rad"] for car in message["detections"]] == [None, None]


def test_depth_has_the_centre_and_each_detection() -> None:
    cars = two_cars()
    nearest = np.array([[0.5, 0.1, 13.4124], [np.nan] * 3], np.float32)
    depth = DepthSummary(math.nan, 0.87654321)
    result = replace(cars, depth=depth, detections=replace(cars.detections, nearest_camera_m=nearest))
    message = depth_message(result, "v", 9, "down")
    check_message("depth", message)
    assert (message["vehicle"], message["camera"], message["sequence"]) == ("v", "down", 7)
    assert message["centre_m"] is None
    assert message["valid_share"] == 0.8765
    assert [(box["class_name"], box["track_id"], box["depth_m"]) for box in message["boxes"]] == [
        ("car", 7, 13.412),
        ("car", None, None),
    ]
    assert depth_message(replace(result, depth=DepthSummary(3.4249, 1.0)), "v", 9)["centre_m"] == 3.425
