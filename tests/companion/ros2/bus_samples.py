"""Messages of the bus, complete by their schemas."""

from __future__ import annotations

import json
import zlib
from functools import cache
from typing import Any

import cv2
import numpy as np

from companion.bus.schema import schema_of
from companion.bus.topics import CLOUD, DEPTH_IMAGE, DETECTIONS, IMAGE, LABELS, STATUS, TOPICS, VEHICLE, Topic
from companion.ros2.messages import RosTopic
from tests.companion.bus.message_check import check_message
from vision.point_cloud import PointCloud

CAPTURED_NS = 91_000_000_123
PIXELS = np.zeros((48, 64, 3), np.uint8)
PIXELS[:, :32] = (0, 0, 255)
JPEG = cv2.imencode(".jpg", PIXELS)[1].tobytes()
POINTS = PointCloud(
    np.array([[1.0, 2.0, 3.0], [-4.0, 5.5, 6.0]], np.float32), np.array([[9, 8, 7], [1, 2, 3]], np.uint8)
)


def body_of(topic: Topic, **changes: Any) -> dict[str, Any]:
    """A body with every field of the topic's, of some valid value; with changes, which are valid too."""
    body: dict[str, Any] = {**json.loads(_body_of(topic.name)), **changes}
    check_message(topic.name, body)
    return body


@cache
def _body_of(name: str) -> str:
    schema = schema_of(next(topic.body for topic in TOPICS if topic.name == name))
    return json.dumps(_filled(schema, schema.get("$defs", {})))


def detection(**changes: Any) -> dict[str, Any]:
    return {**body_of(DETECTIONS)["detections"][0], **changes}


def object_in_frame(**changes: Any) -> dict[str, Any]:
    return {**body_of(DETECTIONS)["objects"][0], "occluded": False, **changes}


def payload_of(topic: Topic, **changes: Any) -> tuple[bytes, bytes | None]:
    """Payload and attachment of a message. `changes`: of the body, or of the attachment."""
    if topic == LABELS:
        return b"car, person", None
    if topic == IMAGE:
        return JPEG, json.dumps(body_of(topic, captured_ns=CAPTURED_NS, **changes)).encode()
    if topic == CLOUD:
        about = {"captured_ns": CAPTURED_NS, "points": len(POINTS), **changes}
        return POINTS.packed(), json.dumps(body_of(topic, **about)).encode()
    if topic == DEPTH_IMAGE:
        about = body_of(topic, captured_ns=CAPTURED_NS, **changes)
        return zlib.compress(bytes(2 * about["width"] * about["height"])), json.dumps(about).encode()
    if topic == VEHICLE:
        changes = {"position_valid": True, **changes}
    if topic == STATUS:
        parts = body_of(topic)["parts"]
        changes = {"parts": [{**parts[0], "name": "camera", "state": "ready"}], **changes}
    return json.dumps(body_of(topic, **changes)).encode(), None


def payload_for(topic: RosTopic) -> tuple[bytes, bytes | None]:
    return payload_of(topic.source)


def _filled(schema: dict[str, Any], definitions: dict[str, Any]) -> Any:
    """A value that a schema allows: lists with one element, or as many as they need; nothing is null."""
    if "$ref" in schema:
        return _filled(definitions[schema["$ref"].rpartition("/")[2]], definitions)
    if "anyOf" in schema:
        return _filled(next(each for each in schema["anyOf"] if each.get("type") != "null"), definitions)
    if "enum" in schema:
        return schema["enum"][0]
    if "pattern" in schema:
        return "0" * 64
    kind = schema["type"]
    if kind == "object":
        return {name: _filled(each, definitions) for name, each in schema.get("properties", {}).items()}
    if kind == "array" and "prefixItems" in schema:
        return [_filled(each, definitions) for each in schema["prefixItems"]]
    if kind == "array":
        return [_filled(schema["items"], definitions)] * max(1, schema.get("minItems", 1))
    values = {"string": "word", "integer": 7, "number": 0.5, "boolean": False, "null": None}
    return values[kind]
