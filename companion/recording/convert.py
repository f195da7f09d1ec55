"""Messages of the bus as messages of a recording: as they are, and as Foxglove's types.

Our topics keep their names (`detections`, `cameras/down/detections`); Foxglove's begin with a slash. Log
times are Unix time: the stamp of the message plus the offset of the service's clock at its start.
"""

from __future__ import annotations

import base64
import json
import math
import time
import zlib
from collections.abc import Iterator
from functools import cache
from typing import Any

from typing_extensions import TypedDict

from companion.bus.schema import read_body, schema_of
from companion.bus.topics import (
    CAMERA_INFO,
    CLOUD,
    DEPTH_IMAGE,
    DETECTIONS,
    EVENTS,
    GUIDANCE_INPUT,
    GUIDANCE_OUTPUT,
    IMAGE,
    LABELS,
    LARGEST_BINARY_BYTES,
    MAVLINK,
    RUN,
    SETPOINT,
    TOPICS,
    VEHICLE,
    Topic,
)
from companion.host.clock import unix_offset_ns
from companion.host.peer_data import parse_object
from companion.recording.files import Channel, Recorded
from companion.recording.foxglove_schemas import SCHEMAS
from companion.recording.link_bytes import unpack_link_bytes

# Names of topics and channels.
RUN_CHANNEL, INPUT_CHANNEL, OUTPUT_CHANNEL = "run", "guidance_input", "guidance_output"
RECEIVED_CHANNEL, SENT_CHANNEL, RECORDER_CHANNEL = "mavlink_received", "mavlink_sent", "recorder"
LOG_CHANNEL = "/log"
ANY_OBJECT = b'{"type":"object"}'
_BODIES = {topic.name: topic.body for topic in TOPICS}
_OF_RECORDER = {
    RUN.name: RUN_CHANNEL,
    GUIDANCE_INPUT.name: INPUT_CHANNEL,
    GUIDANCE_OUTPUT.name: OUTPUT_CHANNEL,
}
_STAMPS = ("published_ns", "stamp_ns", "now_ns")
# Foxglove's names of distortion models; the others are as in ROS.
_FOXGLOVE_MODELS = {"equidistant": "kannala_brandt"}
_LEVELS = {"info": 2, "warning": 3, "error": 4}  # foxglove.LogLevel
# Of `PointCloud.packed`: name, offset, and foxglove.PackedElementField's type (1: uint8, 7: float32).
_POINT_BYTES = 16
_POINT_FIELDS = (
    *((name, 4 * index, 7) for index, name in enumerate(("x", "y", "z"))),
    *((name, 12 + index, 1) for index, name in enumerate(("red", "green", "blue", "alpha"))),
)
_NO_POSE = {
    "position": {"x": 0.0, "y": 0.0, "z": 0.0},
    "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
}
_PNG = b"\x89PNG"
DEPTH_ENCODING = "16UC1"
"""Of a foxglove.RawImage with depth: little-endian uint16, millimetres, 0 where unknown."""
_LARGE_TYPES = {
    IMAGE.name: "foxglove.CompressedImage",
    DEPTH_IMAGE.name: "foxglove.RawImage",
    CLOUD.name: "foxglove.PointCloud",
}
_LINE_LOOP = 2  # foxglove.PointsAnnotationType
_COLORS = {"confirmed": (0.2, 1.0, 0.3), "tentative": (1.0, 0.8, 0.1)}
_OTHER_COLOR = (0.4, 0.7, 1.0)


class LabelsBody(TypedDict):
    """`labels`, which is plain text on the bus."""

    labels: str


@cache
def stored_schema(body: Any) -> bytes:
    """Return the JSON Schema of a body's type as it is stored in a file.

    The fields are inside `allOf`: Lichtblick, and Foxglove before it, refuse a topic with a nullable field in
    `properties`, and read one without `properties` as it comes.
    """
    schema = schema_of(body)
    outer = {key: schema.pop(key) for key in ("$schema", "$defs") if key in schema}
    return json.dumps({**outer, "type": "object", "allOf": [schema]}).encode()


class Converter:
    """Converts the messages of one vehicle's service.

    Args:
        vehicle: its name; begins the names of frames.

    Attributes:
        lost_steps, lost_pieces: steps of guidance, and pieces of the link's bytes, dropped on the way.
        first_step: the first step of guidance received; None before.
    """

    def __init__(self, vehicle: str) -> None:
        self._vehicle = vehicle
        # Of this host, until the service's own is received; both are equal on one host.
        self._offset_ns = unix_offset_ns()
        self._preview_width = 0
        self._has_path = False
        self._down_m = 0.0  # of the vehicle: a path around obstacles is level
        self._service: str | None = None
        self.lost_steps = self.lost_pieces = 0
        self.first_step: int | None = None
        self._next_step = self._next_piece = -1

    def convert(self, path: str, payload: bytes, attachment: bytes | None = None) -> Iterator[Recorded]:
        """Return the messages that a message of the bus becomes.

        Args:
            path: the key after the vehicle's name.
            attachment: of one of `LARGE_TOPICS`.

        Raises:
            ValueError, KeyError, TypeError: the message is not what its topic says.
        """
        camera, _, name = path.rpartition("/")
        if path == MAVLINK.name:
            yield from self._link_bytes(payload)
            return
        if name == IMAGE.name:
            yield self._image(camera, payload, parse_object(attachment or b"{}"))
            return
        if name == DEPTH_IMAGE.name:
            yield self._depth_image(camera, payload, parse_object(attachment or b"{}"))
            return
        if name == CLOUD.name:
            yield self._cloud(camera, payload, parse_object(attachment or b"{}"))
            return
        if name == LABELS.name:
            text = json.dumps({"labels": payload.decode()}).encode()
            yield Recorded(Channel(path, "companion.labels", stored_schema(LabelsBody)), time.time_ns(), text)
            return
        # A calibration has lists of a fixed length, which a viewer does not check.
        message = read_body(CAMERA_INFO, payload) if name == CAMERA_INFO.name else parse_object(payload)
        if path == RUN.name:
            self._on_run(message)
        elif path == GUIDANCE_INPUT.name:
            self._on_step(message["step"])
        topic = _OF_RECORDER.get(path, path)
        stamp_ns = next((message[key] for key in _STAMPS if key in message), None)
        log_time_ns = time.time_ns() if stamp_ns is None else stamp_ns + self._offset_ns
        if type(log_time_ns) is not int or not 0 <= log_time_ns < 2**64:
            raise ValueError(f"{path}: stamp {stamp_ns!r}, expected nanoseconds as a whole number")
        kind = _OF_RECORDER.get(path, name)
        schema = stored_schema(_BODIES[kind]) if kind in _BODIES else ANY_OBJECT
        yield Recorded(Channel(topic, f"companion.{kind}", schema), log_time_ns, payload)
        make = {
            DETECTIONS.name: self._annotations,
            VEHICLE.name: self._vehicle_state,
            SETPOINT.name: self._path,
            EVENTS.name: self._log,
            "transforms": self._transforms,
            CAMERA_INFO.name: self._calibration,
        }.get(name)
        if make is not None and topic == path:
            for converted_topic, kind, body in make(camera, message):
                yield foxglove_message(converted_topic, kind, log_time_ns, body)

    def _on_run(self, run: dict[str, Any]) -> None:
        if run["service"] != self._service:
            self._service = run["service"]
            self._next_step = self._next_piece = -1
        self._offset_ns = int(run["unix_offset_ns"])
        self._preview_width = int(run["settings"]["preview"]["width"])

    def _on_step(self, step: int) -> None:
        if self.first_step is None:
            self.first_step = step
        if self._next_step >= 0:
            self.lost_steps += max(0, step - self._next_step)
        self._next_step = step + 1

    def _link_bytes(self, payload: bytes) -> Iterator[Recorded]:
        for number, piece in unpack_link_bytes(payload):
            if self._next_piece >= 0:
                self.lost_pieces += max(0, number - self._next_piece)
            self._next_piece = number + 1
            channel = Channel(SENT_CHANNEL if piece.sent else RECEIVED_CHANNEL, encoding="mavlink")
            yield Recorded(channel, piece.stamp_ns + self._offset_ns, piece.data)

    def _image(self, camera: str, encoded: bytes, stamps: dict[str, Any]) -> Recorded:
        captured_ns = stamps["captured_ns"]
        body = {
            "timestamp": self._time(captured_ns),
            "frame_id": self._camera_frame(camera),
            "format": "png" if encoded.startswith(_PNG) else "jpeg",
        }
        channel = large_channel(IMAGE, camera)
        return Recorded(channel, captured_ns + self._offset_ns, _with_data(body, encoded))

    def _depth_image(self, camera: str, packed: bytes, about: dict[str, Any]) -> Recorded:
        captured_ns, width, height = about["captured_ns"], about["width"], about["height"]
        size = 2 * width * height
        if not (width > 0 < height and size <= LARGEST_BINARY_BYTES):
            raise ValueError(f"a depth image of {width}x{height}: at most {LARGEST_BINARY_BYTES} bytes")
        try:
            data = zlib.decompressobj().decompress(packed, size + 1)
        except zlib.error as error:
            raise ValueError(f"a depth image cannot be read: {error}") from error
        if len(data) != size:
            raise ValueError(f"a depth image of {width}x{height} has {len(data)} bytes")
        body = {
            "timestamp": self._time(captured_ns),
            "frame_id": self._camera_frame(camera),
            "width": width,
            "height": height,
            "encoding": DEPTH_ENCODING,
            "step": 2 * width,
        }
        channel = large_channel(DEPTH_IMAGE, camera)
        return Recorded(channel, captured_ns + self._offset_ns, _with_data(body, data))

    def _cloud(self, camera: str, packed: bytes, about: dict[str, Any]) -> Recorded:
        captured_ns = about["captured_ns"]
        if len(packed) != about["points"] * _POINT_BYTES:
            raise ValueError(f"a cloud of {about['points']} points has {len(packed)} bytes")
        body = {
            "timestamp": self._time(captured_ns),
            "frame_id": about["frame_id"],
            "pose": _NO_POSE,
            "point_stride": _POINT_BYTES,
            "fields": [
                {"name": name, "offset": offset, "type": kind} for name, offset, kind in _POINT_FIELDS
            ],
        }
        channel = large_channel(CLOUD, camera)
        return Recorded(channel, captured_ns + self._offset_ns, _with_data(body, packed))

    def _annotations(self, camera: str, message: dict[str, Any]) -> Iterator[tuple[str, str, Any]]:
        # The image is scaled down where it is wider than `preview.width`.
        width = message["width"]
        scale = min(1.0, self._preview_width / width) if self._preview_width else 1.0
        stamp = self._time(message["captured_ns"])
        points, texts = [], []
        for found in message["detections"]:
            left, top, right, bottom = (value * scale for value in found["xyxy"])
            red, green, blue = _COLORS.get(found["track_state"], _OTHER_COLOR)
            color = {"r": red, "g": green, "b": blue, "a": 1.0}
            track = "" if found["track_id"] is None else f" {found['track_id']}"
            points.append(
                {
                    "timestamp": stamp,
                    "type": _LINE_LOOP,
                    "points": [
                        {"x": x, "y": y}
                        for x, y in ((left, top), (right, top), (right, bottom), (left, bottom))
                    ],
                    "outline_color": color,
                    "outline_colors": [],
                    "fill_color": {**color, "a": 0.0},
                    "thickness": 2,
                    "metadata": [],
                }
            )
            texts.append(
                {
                    "timestamp": stamp,
                    "position": {"x": left, "y": top},
                    "text": f"{found['class_name']}{track} {found['confidence']:.2f}",
                    "font_size": 12,
                    "text_color": {"r": 0.0, "g": 0.0, "b": 0.0, "a": 1.0},
                    "background_color": color,
                    "metadata": [],
                }
            )
        body = {"timestamp": stamp, "circles": [], "points": points, "texts": texts, "metadata": []}
        yield _joined("", camera, "annotations"), "ImageAnnotations", body

    def _vehicle_state(self, _camera: str, message: dict[str, Any]) -> Iterator[tuple[str, str, Any]]:
        stamp = self._time(message["stamp_ns"])
        position, attitude = message["position_ned_m"], message["attitude_wxyz"]
        if position is not None and attitude is not None:
            self._down_m = position[2]
            # A root with z up, so that a viewer shows down as down: x is east, y north.
            half = math.sqrt(0.5)
            yield _transforms_body(
                _transform(
                    stamp, "local_enu", f"{self._vehicle}/ned", (0.0, 0.0, 0.0), (0.0, half, half, 0.0)
                ),
                _transform(stamp, f"{self._vehicle}/ned", f"{self._vehicle}/body", position, attitude),
            )
        fix = [message[key] for key in ("latitude_deg", "longitude_deg", "altitude_amsl_m")]
        if None not in fix:
            body = {
                "timestamp": stamp,
                "frame_id": f"{self._vehicle}/body",
                **dict(zip(("latitude", "longitude", "altitude"), fix, strict=True)),
                "position_covariance": [0.0] * 9,
                "position_covariance_type": 0,  # UNKNOWN
            }
            yield "/location", "LocationFix", body

    def _path(self, _camera: str, message: dict[str, Any]) -> Iterator[tuple[str, str, Any]]:
        shown, self._has_path = self._has_path, bool(message["path_ned_m"])
        if not (shown or self._has_path):
            return
        body = {
            "timestamp": self._time(message["stamp_ns"]),
            "frame_id": f"{self._vehicle}/ned",
            "poses": [
                {**_NO_POSE, "position": {"x": north, "y": east, "z": self._down_m}}
                for north, east in message["path_ned_m"]
            ],
        }
        yield "/path", "PosesInFrame", body

    def _transforms(self, _camera: str, message: dict[str, Any]) -> Iterator[tuple[str, str, Any]]:
        stamp = self._time(message["captured_ns"])
        yield _transforms_body(
            *(
                _transform(
                    stamp,
                    each["parent_frame_id"],
                    each["child_frame_id"],
                    each["translation_m"],
                    each["rotation_wxyz"],
                )
                for each in message["transforms"]
            )
        )

    def _calibration(self, camera: str, message: dict[str, Any]) -> Iterator[tuple[str, str, Any]]:
        body = {
            "timestamp": self._time(message["stamp_ns"]),
            **{key: message[key] for key in ("frame_id", "width", "height")},
            "distortion_model": _FOXGLOVE_MODELS.get(
                message["distortion_model"], message["distortion_model"]
            ),
            **{key.upper(): message[key] for key in ("d", "k", "r", "p")},
        }
        yield _joined("", camera, "camera_info"), "CameraCalibration", body

    def _log(self, _camera: str, message: dict[str, Any]) -> Iterator[tuple[str, str, Any]]:
        unix_ns, level = message["stamp_ns"] + self._offset_ns, _LEVELS.get(message["level"], 0)
        yield (
            LOG_CHANNEL,
            "Log",
            {
                "timestamp": _unix_time(unix_ns),
                "level": level,
                "message": message["text"],
                "name": self._vehicle,
                "file": "",
                "line": 0,
            },
        )

    def _time(self, stamp_ns: int) -> dict[str, int]:
        return _unix_time(stamp_ns + self._offset_ns)

    def _camera_frame(self, camera: str) -> str:
        return f"{self._vehicle}/{camera or 'camera'}"


def _unix_time(unix_ns: int) -> dict[str, int]:
    seconds, rest = divmod(unix_ns, 1_000_000_000)
    return {"sec": seconds, "nsec": rest}


def large_channel(topic: Topic, camera: str = "") -> Channel:
    """Return the channel of one of `LARGE_TOPICS`. `camera`: empty, or `cameras/NAME`."""
    kind = _LARGE_TYPES[topic.name]
    return Channel(_joined("", camera, topic.name), kind, SCHEMAS[kind])


def _with_data(body: dict[str, Any], data: bytes) -> bytes:
    """Return a body with `data` as JSON. `json.dumps` would take three times as long, to escape base64."""
    text = json.dumps(body, separators=(",", ":")).encode()
    return text[:-1] + b',"data":"' + base64.b64encode(data) + b'"}'


def _joined(*parts: str) -> str:
    return "/".join(part for index, part in enumerate(parts) if part or index == 0)


def foxglove_message(topic: str, kind: str, log_time_ns: int, body: Any) -> Recorded:
    """Return a message of one of Foxglove's types. `kind`: its name without `foxglove.`."""
    name = f"foxglove.{kind}"
    text = json.dumps(body, separators=(",", ":")).encode()
    return Recorded(Channel(topic, name, SCHEMAS[name]), log_time_ns, text)


def _transforms_body(*transforms: dict[str, Any]) -> tuple[str, str, Any]:
    return "/tf", "FrameTransforms", {"transforms": list(transforms)}


def _transform(stamp: Any, parent: str, child: str, translation: Any, wxyz: Any) -> dict[str, Any]:
    return {
        "timestamp": stamp,
        "parent_frame_id": parent,
        "child_frame_id": child,
        "translation": dict(zip("xyz", translation, strict=True)),
        "rotation": dict(zip("wxyz", wxyz, strict=True)),
    }
