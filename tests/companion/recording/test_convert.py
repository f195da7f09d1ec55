"""Messages of the bus become messages of a recording, with Foxglove's types and one time."""

from __future__ import annotations

import base64
import json
import os
import zlib
from collections.abc import Iterator, Mapping
from typing import Any

import cv2
import jsonschema
import numpy as np
import pytest

from companion.bench.lockstep_flight import plain_settings
from companion.bus.messages import (
    camera_info_message,
    cloud_attachment,
    depth_image_attachment,
    detections_message,
)
from companion.bus.topics import RECORDER_TOPICS, TOPICS
from companion.bus.vehicle_messages import vehicle_message
from companion.guidance.core import GuidanceOptions
from companion.host.peer_data import PeerDataError
from companion.recording.convert import Converter
from companion.recording.encoding import dumps
from companion.recording.files import Recorded
from companion.recording.foxglove_schemas import SCHEMAS
from companion.recording.link_bytes import LinkBytes, pack_link_bytes, unpack_link_bytes
from companion.recording.recorder import RecorderOptions, topics_of
from companion.recording.tap import run_record
from companion.settings import ZenohSection
from companion.settings.reading import load_settings
from companion.vehicle.state import VehicleState
from vision.camera_model import CameraModel, CameraMount
from vision.detections import Detections
from vision.pipeline import PerceptionResult
from vision.point_cloud import PointCloud

CAPTURED_NS, PUBLISHED_NS = 91_000_000_123, 91_050_000_000
STATE = VehicleState(
    position_ned_m=(1.0, 2.0, -3.0),
    attitude=(1.0, 0.0, 0.0, 0.0),
    latitude_deg=47.0,
    longitude_deg=8.0,
    altitude_amsl_m=500.0,
)
CAMERA_INFO = dict(
    camera_info_message(
        CameraModel.from_horizontal_fov(1920, 1080, 1.2),
        CameraMount(),
        calibrated=True,
        vehicle="vehicle1",
        view=None,
        now_ns=PUBLISHED_NS,
    )
)
TRANSFORMS = {
    "captured_ns": CAPTURED_NS,
    "transforms": [
        {
            "parent_frame_id": "vehicle1/body",
            "child_frame_id": "vehicle1/camera",
            "translation_m": [0.1, 0.0, 0.0],
            "rotation_wxyz": [0.5, 0.5, 0.5, 0.5],
        }
    ],
}


@pytest.fixture
def converter() -> Converter:
    """Of a service whose preview is half as wide as the frames."""
    converter = Converter("vehicle1")
    settings = plain_settings({"preview.width": "960"})
    run = run_record(settings, GuidanceOptions(), "service1")
    assert [message.channel.topic for message in converter.convert("@record/run", dumps(run))] == ["run"]
    return converter


def detections() -> bytes:
    found = Detections.empty(("car",))
    result = PerceptionResult(7, CAPTURED_NS, CAPTURED_NS, 1920, 1080, found, {"total": 1.0}, dropped=0)
    message = detections_message(result, "vehicle1", PUBLISHED_NS)
    detection = {
        "class_name": "car",
        "confidence": 0.9,
        "xyxy": [100.0, 200.0, 300.0, 400.0],
        "track_id": 4,
        "track_state": "confirmed",
    }
    return dumps({**message, "detections": [detection]})


def foxglove(messages: Iterator[Recorded]) -> dict[str, Any]:
    """Topic → body of Foxglove's messages, each valid by its schema."""
    found = {}
    for message in messages:
        if message.channel.schema_name.startswith("foxglove."):
            body = json.loads(message.data)
            jsonschema.validate(body, json.loads(message.channel.schema))
            found[message.channel.topic] = body
    return found


def test_every_schema_is_valid() -> None:
    for name, text in SCHEMAS.items():
        jsonschema.Draft202012Validator.check_schema(json.loads(text))
        assert json.loads(text)["title"] == name


def test_image_and_annotations_have_the_capture_as_time(converter: Converter) -> None:
    stamps = dumps({"camera": None, "sequence": 7, "captured_ns": CAPTURED_NS})
    image = foxglove(converter.convert("image", b"\xff\xd8", stamps))["/image"]
    annotations = foxglove(converter.convert("detections", detections()))["/annotations"]
    assert image["timestamp"] == annotations["timestamp"]
    assert image["timestamp"]["nsec"] == annotations["points"][0]["timestamp"]["nsec"]
    assert base64.b64decode(image["data"]) == b"\xff\xd8"


def test_cloud_becomes_foxgloves_points(converter: Converter) -> None:
    cloud = PointCloud(
        np.array([[1.0, 2.0, 3.0], [-4.0, 5.5, 6.0]], np.float32), np.array([[9, 8, 7], [1, 2, 3]], np.uint8)
    )
    about = dumps(cloud_attachment(7, CAPTURED_NS, "vehicle1", "down", len(cloud)))
    (message,) = converter.convert("cameras/down/cloud", cloud.packed(), about)
    body = foxglove(iter([message]))["/cameras/down/cloud"]
    assert body["frame_id"] == "vehicle1/cameras/down"
    stamp_ns = body["timestamp"]["sec"] * 10**9 + body["timestamp"]["nsec"]
    assert stamp_ns == message.log_time_ns
    # foxglove.PackedElementField: 1 is uint8, 7 float32.
    kinds = {1: "u1", 7: "<f4"}
    fields = {field["name"]: (kinds[field["type"]], field["offset"]) for field in body["fields"]}
    layout = np.dtype(
        {
            "names": list(fields),
            "formats": [kind for kind, _ in fields.values()],
            "offsets": [offset for _, offset in fields.values()],
            "itemsize": body["point_stride"],
        }
    )
    points = np.frombuffer(base64.b64decode(body["data"]), layout)
    np.testing.assert_array_equal(np.column_stack([points[name] for name in "xyz"]), cloud.points)
    colours = np.column_stack([points[name] for name in ("red", "green", "blue")])
    np.testing.assert_array_equal(colours, cloud.colours)
    assert points["alpha"].tolist() == [255, 255]


def test_cloud_of_another_length_is_refused(converter: Converter) -> None:
    about = dumps(cloud_attachment(7, CAPTURED_NS, "vehicle1", None, 2))
    with pytest.raises(ValueError, match="31 bytes"):
        list(converter.convert("cloud", bytes(31), about))


DEPTH = np.arange(12, dtype="<u2").reshape(3, 4)


def test_depth_image_becomes_foxgloves_raw_image(converter: Converter) -> None:
    about = dumps(depth_image_attachment(7, CAPTURED_NS, "down", 4, 3))
    (message,) = converter.convert("cameras/down/depth_image", zlib.compress(DEPTH.tobytes()), about)
    body = foxglove(iter([message]))["/cameras/down/depth_image"]
    info = foxglove(converter.convert("cameras/down/camera_info", dumps(CAMERA_INFO)))
    stamps = dumps({"camera": "down", "sequence": 7, "captured_ns": CAPTURED_NS})
    image = foxglove(converter.convert("cameras/down/image", b"\xff\xd8", stamps))["/cameras/down/image"]
    assert (body["encoding"], body["width"], body["height"], body["step"]) == ("16UC1", 4, 3, 8)
    assert base64.b64decode(body["data"]) == DEPTH.tobytes()
    assert (body["timestamp"], body["frame_id"]) == (image["timestamp"], image["frame_id"])
    assert "/cameras/down/camera_info" in info


@pytest.mark.parametrize(
    "packed", [DEPTH.tobytes(), zlib.compress(DEPTH.tobytes()[:-1]), zlib.compress(bytes(10**6)), b""]
)
def test_depth_image_of_another_size_is_refused(converter: Converter, packed: bytes) -> None:
    about = dumps(depth_image_attachment(7, CAPTURED_NS, None, 4, 3))
    with pytest.raises(ValueError, match="depth image"):
        list(converter.convert("depth_image", packed, about))


def test_annotations_are_scaled_to_the_preview(converter: Converter) -> None:
    annotations = foxglove(converter.convert("cameras/down/detections", detections()))
    (box,) = annotations["/cameras/down/annotations"]["points"]
    assert [(point["x"], point["y"]) for point in box["points"]] == [
        (50.0, 100.0),
        (150.0, 100.0),
        (150.0, 200.0),
        (50.0, 200.0),
    ]
    (label,) = annotations["/cameras/down/annotations"]["texts"]
    assert label["text"] == "car 4 0.90"


def test_vehicle_becomes_transforms_and_a_location(converter: Converter) -> None:
    found = foxglove(converter.convert("vehicle", dumps(vehicle_message(STATE, PUBLISHED_NS))))
    root, body = found["/tf"]["transforms"]
    assert (root["parent_frame_id"], root["child_frame_id"]) == ("local_enu", "vehicle1/ned")
    assert body["translation"] == {"x": 1.0, "y": 2.0, "z": -3.0}
    assert found["/location"]["altitude"] == 500.0
    unknown = foxglove(converter.convert("vehicle", dumps(vehicle_message(VehicleState(), PUBLISHED_NS))))
    assert unknown == {}


def test_way_around_obstacles_becomes_level_poses(converter: Converter) -> None:
    list(converter.convert("vehicle", dumps(vehicle_message(STATE, PUBLISHED_NS))))
    positions = []
    for path in ([], [[1.0, 2.0], [5.0, 3.5]], [], []):
        body = {"stamp_ns": PUBLISHED_NS, "path_ned_m": path}
        found = foxglove(converter.convert("setpoint", dumps(body)))
        positions.append([pose["position"] for pose in found["/path"]["poses"]] if found else None)
    flown = [{"x": 1.0, "y": 2.0, "z": -3.0}, {"x": 5.0, "y": 3.5, "z": -3.0}]
    assert positions == [None, flown, [], None]


@pytest.mark.parametrize(
    ("path", "message", "topic"),
    [
        ("camera_info", CAMERA_INFO, "/camera_info"),
        ("transforms", TRANSFORMS, "/tf"),
        ("events", {"stamp_ns": 1, "level": "warning", "text": "late"}, "/log"),
    ],
)
def test_message_is_kept_and_converted(
    converter: Converter, path: str, message: dict[str, Any], topic: str
) -> None:
    kept, *others = converter.convert(path, dumps(message))
    assert (kept.channel.topic, json.loads(kept.data)) == (path, message)
    assert list(foxglove(iter(others))) == [topic]


@pytest.mark.parametrize(
    "change", [{"width": "wide"}, {"k": [1.0] * 8}, {"d": [0.0] * 10_000}, {"d": None}, {"mount": {}}]
)
def test_calibration_that_is_not_of_its_schema_is_refused(
    converter: Converter, change: dict[str, Any]
) -> None:
    with pytest.raises(PeerDataError, match=next(iter(change))):
        list(converter.convert("camera_info", dumps({**CAMERA_INFO, **change})))


@pytest.mark.parametrize("size", [(2**20, 2**20), (-4, -3), (0, 0)])
def test_depth_image_of_an_impossible_size_is_not_unpacked(
    converter: Converter, size: tuple[int, int]
) -> None:
    about = dumps(depth_image_attachment(7, CAPTURED_NS, None, *size))
    with pytest.raises(ValueError, match="at most"):
        list(converter.convert("depth_image", zlib.compress(DEPTH.tobytes()), about))


def test_fisheye_has_foxgloves_name(converter: Converter) -> None:
    message = {**CAMERA_INFO, "distortion_model": "equidistant", "d": [0.0] * 4}
    found = foxglove(converter.convert("camera_info", dumps(message)))
    assert found["/camera_info"]["distortion_model"] == "kannala_brandt"


def test_log_time_is_the_stamp_in_unix_time(converter: Converter) -> None:
    (first, *_), (second, *_) = (
        list(converter.convert("pose", dumps({"published_ns": stamp_ns}))) for stamp_ns in (1_000, 3_500)
    )
    assert second.log_time_ns - first.log_time_ns == 2_500


def test_link_bytes_are_split_and_losses_counted(converter: Converter) -> None:
    pieces = [LinkBytes(10, False, b"abc"), LinkBytes(20, True, b""), LinkBytes(30, False, bytes(300))]
    packed = pack_link_bytes(5, pieces)
    assert list(unpack_link_bytes(packed)) == list(enumerate(pieces, 5))
    found = list(converter.convert("@record/mavlink", packed))
    assert [message.channel.topic for message in found] == [
        "mavlink_received",
        "mavlink_sent",
        "mavlink_received",
    ]
    assert [message.data for message in found] == [piece.data for piece in pieces]
    assert converter.lost_pieces == 0
    list(converter.convert("@record/mavlink", pack_link_bytes(10, pieces[:1])))
    assert converter.lost_pieces == 2
    with pytest.raises(ValueError, match="piece"):
        list(unpack_link_bytes(packed[:-1]))


def schema_errors(recorded: Recorded, body: Mapping[str, Any]) -> list[str]:
    validator = jsonschema.Draft202012Validator(json.loads(recorded.channel.schema))
    return [error.validator for error in validator.iter_errors(body)]


def test_stored_schema_accepts_the_message_and_refuses_others(converter: Converter) -> None:
    empty = PerceptionResult(
        7, CAPTURED_NS, CAPTURED_NS, 1920, 1080, Detections.empty(("car",)), {"total": 1.0}, dropped=0
    )
    for path, body in {
        "vehicle": vehicle_message(STATE, PUBLISHED_NS),
        "cameras/down/detections": detections_message(empty, "vehicle1", PUBLISHED_NS),
        "events": {"stamp_ns": 1, "level": "warning", "text": "late"},
    }.items():
        recorded, *_ = converter.convert(path, dumps(body))
        assert schema_errors(recorded, body) == []
        wrong = {**body, next(key for key in body if key.endswith("_ns")): "now"}
        assert "type" in schema_errors(recorded, wrong)
    (labels,) = converter.convert("labels", b"2 cars")
    assert schema_errors(labels, json.loads(labels.data)) == []


def test_lost_steps_are_counted(converter: Converter) -> None:
    for step in (3, 4, 8):
        list(converter.convert("@record/guidance_input", dumps({"step": step, "now_ns": step})))
    assert (converter.first_step, converter.lost_steps) == (3, 3)


def test_recorder_of_lossless_images_does_not_get_the_preview() -> None:
    frames = {"image": "frames"}
    options = RecorderOptions(ZenohSection(), "vehicle1", "", True, True, True, 1, 1, frames)
    names = [topic.name for topic in topics_of(options)]
    assert ("image" in names, "depth_image" in names, "cloud" in names) == (False, False, True)


@pytest.mark.parametrize(("encoding", "kind"), [(".png", "png"), (".jpg", "jpeg")])
def test_format_of_an_image_is_named(converter: Converter, encoding: str, kind: str) -> None:
    _, encoded = cv2.imencode(encoding, np.zeros((4, 6, 3), np.uint8))
    (message,) = converter.convert("image", encoded.tobytes(), b'{"captured_ns": 7}')
    assert (message.channel.topic, json.loads(message.data)["format"]) == ("/image", kind)


@pytest.mark.parametrize("chosen", [(True, False, False), (False, True, False), (False, False, True)])
def test_recorder_subscribes_to_the_chosen_large_topics(chosen: tuple[bool, bool, bool]) -> None:
    options = RecorderOptions(ZenohSection(), "vehicle1", "", *chosen, 1, 1)
    names = [topic.name for topic in topics_of(options)]
    assert ("image" in names, "depth_image" in names, "cloud" in names) == chosen
    assert names[-1] == "@record/mavlink"
    assert len(names) == len(TOPICS) - 2 + len(RECORDER_TOPICS)


@pytest.mark.parametrize(
    ("chosen", "content"), [({}, ("jpeg",)), ({"recording.content": "png, depth"}, ("png", "depth"))]
)
def test_images_are_recorded_by_default_and_depth_if_chosen(
    chosen: dict[str, str], content: tuple[str, ...]
) -> None:
    recording = load_settings(os.devnull, chosen, {}).recording
    assert (recording.content, recording.images) == (content, True)
