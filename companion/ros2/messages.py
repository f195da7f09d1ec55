"""The bus as messages of ROS 2: which topic is made of which message, and how.

ROS's axes (REP 103) differ from ours: a map is ENU instead of NED, a body FLU instead of FRD. A camera's
optical axes are the same. Frames (REP 105): `map` (origin of local NED), `base_link`, `gimbal`,
`camera_optical` and `cameras/NAME_optical`, each after the prefix of the vehicle.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np

from companion.bus.topics import (
    CAMERA_INFO,
    CLOUD,
    DETECTIONS,
    IMAGE,
    LABELS,
    LARGE_TOPICS,
    STATUS,
    TRANSFORMS,
    VEHICLE,
    Topic,
)
from companion.host.peer_data import parse_object
from companion.ros2.cdr import encode
from vision.attitude import Quaternion, quaternion_product
from vision.image_file import decode_image, stated_size

_Body = dict[str, Any]
_NAN = math.nan
_PNG = b"\x89PNG"
# `camera_info` is that of the images if the newest one is younger; poses on `/tf` come with camera frames if
# those are. An age has rounding of a millisecond.
_IMAGED_NS, _POSE_AFTER_NS, _SAME_AGE_NS = 2_000_000_000, 1_000_000_000, 2_000_000
# sensor_msgs: PointField.FLOAT32, and NavSatStatus.STATUS_UNKNOWN, .STATUS_FIX and .STATUS_NO_FIX.
_FLOAT32 = 7
_FIX_STATUS = {None: -2, True: 0, False: -1}
_SERVICE_UNKNOWN = 0
_UNKNOWN_VARIANCE = 1e6  # of a position in m², of a rotation in rad²; 0 would be exact
_POINT_BYTES = 16
_POINT_FIELDS = [
    {"name": name, "offset": 4 * index, "datatype": _FLOAT32, "count": 1}
    for index, name in enumerate(("x", "y", "z", "rgb"))
]
_BATTERY_UNKNOWN = ("voltage", "temperature", "current", "charge", "capacity", "design_capacity")
# diagnostic_msgs/DiagnosticStatus; a part in another state than these has a warning.
_OK, _WARN, _ERROR = 0, 1, 2
_LEVELS = {"ready": _OK, "finished": _OK, "failed": _ERROR}


@dataclass(frozen=True, slots=True)
class RosTopic:
    """One topic of ROS.

    Attributes:
        name: relative to the namespace, of a further camera after `cameras/NAME/`; or absolute, as `/tf`.
        type_name: as `sensor_msgs/msg/Image`.
        source: the topic of the bus that it is made of.
        also: another one. A large one only while something else needs that.
        latched: the newest message is kept for late subscribers (transient local, depth 1).
        reliable: else best effort.
    """

    name: str
    type_name: str
    source: Topic
    also: Topic | None = None
    latched: bool = False
    reliable: bool = True

    def sources(self, camera: str | None) -> tuple[Topic, ...]:
        """Return what it is made of, of the first camera and the vehicle (None), or of a further camera."""
        made_of = (self.source,) if self.also is None else (self.source, self.also)
        return tuple(topic for topic in made_of if camera is None or topic.of_camera)


OUTPUT_TOPICS: Final = (
    RosTopic("detections", "vision_msgs/msg/Detection2DArray", DETECTIONS),
    RosTopic("detections_3d", "vision_msgs/msg/Detection3DArray", DETECTIONS),
    RosTopic("labels", "std_msgs/msg/String", LABELS),
    RosTopic("image/compressed", "sensor_msgs/msg/CompressedImage", IMAGE),
    RosTopic("image", "sensor_msgs/msg/Image", IMAGE),
    RosTopic("camera_info", "sensor_msgs/msg/CameraInfo", CAMERA_INFO, IMAGE, latched=True),
    RosTopic("points", "sensor_msgs/msg/PointCloud2", CLOUD),
    RosTopic("/tf", "tf2_msgs/msg/TFMessage", TRANSFORMS, VEHICLE),
    RosTopic("fix", "sensor_msgs/msg/NavSatFix", VEHICLE),
    RosTopic("pose", "geometry_msgs/msg/PoseStamped", VEHICLE),
    RosTopic("battery", "sensor_msgs/msg/BatteryState", VEHICLE),
    RosTopic("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", STATUS),
)


def ros_name(name: str) -> str:
    """Return a name of the bus as one of ROS: letters, digits and single `_`, no digit first.

    >>> ros_name("drone-1"), ros_name("4x4")
    ('drone_1', 'n4x4')
    """
    word = re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_") or "n"
    return f"n{word}" if word[0].isdigit() else word


def topic_name(topic: RosTopic, camera: str | None) -> str:
    """Return a topic's name below the namespace, or its absolute one. `camera`: None for the first."""
    if camera is None or topic.name.startswith("/"):
        return topic.name
    return f"cameras/{ros_name(camera)}/{topic.name}"


def frame_prefix(namespace: str) -> str:
    """Return what begins the names of a vehicle's frames. `namespace`: without an outer `/`, or empty."""
    return f"{namespace}/" if namespace else ""


class _Axes(NamedTuple):
    """A frame of ROS, and how our axes of it become ROS's: its x, y, z are ours by index, with signs."""

    frame: str
    wxyz: Quaternion
    order: tuple[int, int, int] = (0, 1, 2)
    signs: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def vector(self, ours: Sequence[float]) -> dict[str, float]:
        values = (sign * ours[index] for index, sign in zip(self.order, self.signs, strict=True))
        return dict(zip("xyz", values, strict=True))

    def rotation(self, ours: Sequence[float], child: _Axes) -> dict[str, float]:
        """Of a rotation of a child's axes into these; each `wxyz` is its own inverse."""
        w, x, y, z = ours
        rotated = quaternion_product(quaternion_product(self.wxyz, (w, x, y, z)), child.wxyz)
        return dict(zip("wxyz", rotated, strict=True))


_MAP = _Axes("map", (0.0, math.sqrt(0.5), math.sqrt(0.5), 0.0), (1, 0, 2), (1.0, 1.0, -1.0))
_BASE = _Axes("base_link", (0.0, 1.0, 0.0, 0.0), signs=(1.0, -1.0, -1.0))
_FRAMES = {"ned": _MAP, "body": _BASE, "gimbal": _BASE._replace(frame="gimbal")}


def _axes_of(frame_id: str) -> _Axes:
    """Of a frame `<vehicle>/…` of ours; the others are optical frames of cameras."""
    name = frame_id.partition("/")[2]
    return _FRAMES.get(name) or _Axes(_optical_frame(name), (1.0, 0.0, 0.0, 0.0))


def _optical_frame(name: str) -> str:
    """Of a camera's frame of ours, with the suffix of REP 103."""
    return f"{name}_optical"


class Messages:
    """Messages of one vehicle's bus as messages of ROS, converted one after the other.

    Args:
        frame_prefix: before the name of each frame, such as `drone1/`.
        ros_time_ns: ROS time at a stamp of the service (CLOCK_MONOTONIC), nanoseconds.
    """

    def __init__(self, frame_prefix: str, ros_time_ns: Callable[[int], int]) -> None:
        self._prefix = frame_prefix
        self._ros_time_ns = ros_time_ns
        self._lenses: dict[str, _Body] = {}  # newest `camera_info` of a frame
        self._imaged_ns: dict[str, int] = {}  # newest image of a frame
        self._pose_due_ns = 0  # stamp from which a pose of the vehicle is sent on `/tf`
        self._make: dict[tuple[str, str], Callable[[str, _Body, bytes], Mapping[str, Any] | None]] = {
            ("detections", DETECTIONS.name): self._detections,
            ("detections_3d", DETECTIONS.name): self._detections_3d,
            ("labels", LABELS.name): lambda _frame, _body, payload: {"data": payload.decode()},
            ("image/compressed", IMAGE.name): self._compressed_image,
            ("image", IMAGE.name): self._image,
            ("camera_info", CAMERA_INFO.name): self._camera_info,
            ("camera_info", IMAGE.name): self._camera_info_of_image,
            ("points", CLOUD.name): self._points,
            ("/tf", TRANSFORMS.name): self._transforms,
            ("/tf", VEHICLE.name): self._transform_of_vehicle,
            ("fix", VEHICLE.name): self._fix,
            ("pose", VEHICLE.name): self._pose,
            ("battery", VEHICLE.name): self._battery,
            ("/diagnostics", STATUS.name): self._diagnostics,
        }

    def convert(
        self,
        topic: RosTopic,
        camera: str | None,
        payload: bytes,
        attachment: bytes | None = None,
        source: Topic | None = None,
    ) -> bytes | None:
        """Return a message of the bus as CDR of `topic`; None: what it is about is not known, or was sent.

        Args:
            source: which of `topic.sources` it is of; None: `topic.source`.
            camera: the further camera that it is of; None: the first, or none.
            attachment: of one of `LARGE_TOPICS`.

        Raises:
            ValueError: the message is not what its topic says.
        """
        source, body = source or topic.source, {}
        frame = _optical_frame("camera" if camera is None else f"cameras/{camera}")
        try:
            if source != LABELS:
                body = parse_object((attachment or b"") if source in LARGE_TOPICS else payload)
            value = self._make[topic.name, source.name](frame, body, payload)
            return None if value is None else encode(topic.type_name, value)
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
            raise ValueError(
                f"{source.name} as {topic.type_name}: {type(error).__name__}: {error}"
            ) from error

    def _header(self, stamp_ns: int, frame: str) -> _Body:
        seconds, rest_ns = divmod(self._ros_time_ns(stamp_ns), 1_000_000_000)
        return {"stamp": {"sec": seconds, "nanosec": rest_ns}, "frame_id": self._prefix + frame}

    def _detections(self, frame: str, body: _Body, _payload: bytes) -> _Body:
        """With depth, a pose is that of the nearest visible point, in the camera's axes, with the variance of
        z. All others are 1e6: unknown.
        """
        header = self._header(body["captured_ns"], frame)
        detections = []
        for found in body["detections"]:
            left, top, right, bottom = found["xyxy"]
            point = found["nearest_camera_m"]
            sigma_m = None if point is None else found.get("depth_sigma_m")
            pose: _Body = {"covariance": _covariance(z_m2=None if sigma_m is None else sigma_m**2)}
            if point is not None:
                pose["pose"] = {"position": dict(zip("xyz", point, strict=True))}
            center = {"position": dict(zip("xy", found["center"], strict=True))}
            bbox = {"center": center, "size_x": right - left, "size_y": bottom - top}
            track = "" if found["track_id"] is None else str(found["track_id"])
            detections.append(_detection(header, track, found["class_name"], found["confidence"], pose, bbox))
        return {"header": header, "detections": detections}

    def _detections_3d(self, _frame: str, body: _Body, _payload: bytes) -> _Body:
        """The objects in this frame that have a position. Their size is 0: unknown; the variances of height
        and rotation are 1e6: unknown.
        """
        header = self._header(body["captured_ns"], _MAP.frame)
        scores = {each["object_id"]: each["confidence"] for each in body["detections"]}
        detections = []
        for found in body["objects"]:
            if found["position_ned_m"] is None or found["occluded"]:
                continue
            north_north, north_east, _, _, _, east_east, *_ = found["covariance"]
            covariance = _covariance(east_east, north_north)
            covariance[1] = covariance[6] = north_east
            center = {"position": _MAP.vector(found["position_ned_m"])}
            pose, number = {"pose": center, "covariance": covariance}, found["object_id"]
            score = scores.get(number, 0.0)
            detections.append(
                _detection(header, str(number), found["class_name"], score, pose, {"center": center})
            )
        return {"header": header, "detections": detections}

    def _compressed_image(self, frame: str, about: _Body, payload: bytes) -> _Body:
        kind = "png" if payload.startswith(_PNG) else "jpeg"
        return {"header": self._header(about["captured_ns"], frame), "format": kind, "data": payload}

    def _image(self, frame: str, about: _Body, payload: bytes) -> _Body:
        pixels = decode_image(payload)
        if pixels is None:
            raise ValueError(f"{len(payload)} bytes are no image")
        height, width, channels = pixels.shape
        size = {"height": height, "width": width, "encoding": "bgr8", "step": width * channels}
        return {"header": self._header(about["captured_ns"], frame), **size, "data": pixels.tobytes()}

    def _camera_info(self, frame: str, body: _Body, _payload: bytes) -> _Body | None:
        """Of unscaled frames, while there are no images."""
        self._lenses[frame] = body
        imaged_ns = self._imaged_ns.get(frame)
        if imaged_ns is not None and body["stamp_ns"] - imaged_ns < _IMAGED_NS:
            return None
        same = ("height", "width", "distortion_model", "d", "k", "r", "p")
        return {"header": self._header(body["stamp_ns"], frame), **{key: body[key] for key in same}}

    def _camera_info_of_image(self, frame: str, about: _Body, payload: bytes) -> _Body | None:
        """With stamp and size of the image: its pixels are scaled as `CameraModel.scaled`."""
        lens, size = self._lenses.get(frame), stated_size(payload)
        if lens is None or size is None:
            return None
        self._imaged_ns[frame] = about["captured_ns"]
        x, y = size[0] / lens["width"], size[1] / lens["height"]
        scaling = np.array([[x, 0.0, (x - 1.0) / 2.0], [0.0, y, (y - 1.0) / 2.0], [0.0, 0.0, 1.0]])
        k, p = (list(map(float, (scaling @ np.reshape(lens[key], (3, -1))).flat)) for key in "kp")
        same = ("distortion_model", "d", "r")
        return {
            "header": self._header(about["captured_ns"], frame),
            "width": size[0],
            "height": size[1],
            "k": k,
            "p": p,
            **{key: lens[key] for key in same},
        }

    def _points(self, frame: str, about: _Body, payload: bytes) -> _Body:
        if len(payload) != about["points"] * _POINT_BYTES:
            raise ValueError(f"a cloud of {about['points']} points has {len(payload)} bytes")
        ours = np.frombuffer(payload, np.uint8).reshape(-1, _POINT_BYTES)
        points = ours.copy()
        # PCL's `rgb`: a float32 of the bytes blue, green, red, 0; with 255 it would be NaN.
        points[:, 12:15], points[:, 15] = ours[:, 14:11:-1], 0
        return {
            "header": self._header(about["captured_ns"], frame),
            "height": 1,
            "width": len(points),
            "fields": _POINT_FIELDS,
            "point_step": _POINT_BYTES,
            "row_step": len(payload),
            "data": points.tobytes(),
            "is_dense": True,
        }

    def _transforms(self, _frame: str, body: _Body, _payload: bytes) -> _Body:
        self._pose_due_ns = max(self._pose_due_ns, body["captured_ns"] + _POSE_AFTER_NS)
        transforms = []
        for each in body["transforms"]:
            parent, child = _axes_of(each["parent_frame_id"]), _axes_of(each["child_frame_id"])
            translation = parent.vector(each["translation_m"])
            transform = {
                "header": self._header(body["captured_ns"], parent.frame),
                "child_frame_id": self._prefix + child.frame,
                "transform": {
                    "translation": translation,
                    "rotation": parent.rotation(each["rotation_wxyz"], child),
                },
            }
            transforms.append(transform)
        return {"transforms": transforms}

    def _transform_of_vehicle(self, frame: str, body: _Body, payload: bytes) -> _Body | None:
        """The newest pose, each once, where no frame of a camera has brought one for a second."""
        pose, received_ns = self._pose(frame, body, payload), _received_ns(body, body["position_age_s"])
        if pose is None or received_ns < self._pose_due_ns:
            return None
        self._pose_due_ns = received_ns + _SAME_AGE_NS
        place = {"translation": pose["pose"]["position"], "rotation": pose["pose"]["orientation"]}
        child = {"child_frame_id": self._prefix + _BASE.frame, "transform": place}
        return {"transforms": [{"header": pose["header"], **child}]}

    def _fix(self, _frame: str, body: _Body, _payload: bytes) -> _Body | None:
        """The altitude is above mean sea level: the autopilot sends no other."""
        # Recordings of before `global_age_s` have the age of the local position alone.
        age_s = body.get("global_age_s", body["position_age_s"])
        if body["latitude_deg"] is None or body["longitude_deg"] is None or age_s is None:
            return None
        status = _FIX_STATUS[body["position_valid"]]
        altitude_m = body["altitude_amsl_m"]
        return {
            "header": self._header(_received_ns(body, age_s), _BASE.frame),
            "status": {"status": status, "service": _SERVICE_UNKNOWN},
            "latitude": body["latitude_deg"],
            "longitude": body["longitude_deg"],
            "altitude": _NAN if altitude_m is None else altitude_m,
        }

    def _pose(self, _frame: str, body: _Body, _payload: bytes) -> _Body | None:
        position, attitude = body["position_ned_m"], body["attitude_wxyz"]
        if position is None or attitude is None or body["position_valid"] is False:
            return None
        pose = {"position": _MAP.vector(position), "orientation": _MAP.rotation(attitude, _BASE)}
        received_ns = _received_ns(body, body["position_age_s"])
        return {"header": self._header(received_ns, _MAP.frame), "pose": pose}

    def _battery(self, _frame: str, body: _Body, _payload: bytes) -> _Body | None:
        if body["battery_fraction"] is None:
            return None
        known = {"percentage": body["battery_fraction"], "present": True}
        header = self._header(body["stamp_ns"], _BASE.frame)
        return {"header": header, **dict.fromkeys(_BATTERY_UNKNOWN, _NAN), **known}

    def _diagnostics(self, _frame: str, body: _Body, _payload: bytes) -> _Body:
        """The service, guidance and each part, with the numbers and words of each."""
        details = {"autopilot": body["vehicle"], "camera": body["perception"], "zenoh": body["bus"]}
        details |= {f"camera {name}": camera for name, camera in body["cameras"].items()}
        rows = [("service", _OK if body["healthy"] else _ERROR, "; ".join(body["unhealthy"]), body)]
        rows.append(("guidance", _OK, body["pilot"]["behaviour"], body["pilot"]))
        for part in body["parts"]:
            level = _LEVELS.get(part["state"], _WARN)
            about = {**details.get(part["name"], {}), "state": part["state"]}
            rows.append((part["name"], level, part["reason"], about))
        status = [
            {
                "level": level,
                "name": f"{self._prefix}companion: {name}",
                "message": message,
                "hardware_id": body["vehicle"]["name"],
                "values": [
                    {"key": key, "value": str(value)}
                    for key, value in about.items()
                    if isinstance(value, str | int | float)
                ],
            }
            for name, level, message, about in rows
        ]
        return {"header": {**self._header(body["stamp_ns"], ""), "frame_id": ""}, "status": status}


def _received_ns(body: _Body, age_s: float | None) -> int:
    """When what has this age was received; without an age, the stamp of the message."""
    stamp_ns: int = body["stamp_ns"]
    return stamp_ns if age_s is None else stamp_ns - round(age_s * 1e9)


def _covariance(
    x_m2: float | None = None, y_m2: float | None = None, z_m2: float | None = None
) -> list[float]:
    """Return the 6×6 covariance of a pose with these variances; None, and the rotation's: unknown."""
    known = (x_m2, y_m2, z_m2, None, None, None)
    covariance = np.diag([_UNKNOWN_VARIANCE if each is None else each for each in known])
    return [float(each) for each in covariance.flat]


def _detection(
    header: _Body, identifier: str, class_name: str, score: float, pose: _Body, bbox: _Body
) -> _Body:
    result = {"hypothesis": {"class_id": class_name, "score": score}, "pose": pose}
    return {"header": header, "results": [result], "bbox": bbox, "id": identifier}
