"""The ROS 2 messages that are written and read, by their fields, with their type hashes (REP 2016).

Comments and constants of ROS's own files are left out: neither changes a byte of a message or its hash.
An array of fixed length holds numbers.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from types import MappingProxyType
from typing import Any

# By package: message → fields.
_FIELDS = {
    "builtin_interfaces": {"Time": "int32 sec; uint32 nanosec"},
    "diagnostic_msgs": {
        "DiagnosticArray": "std_msgs/Header header; DiagnosticStatus[] status",
        "DiagnosticStatus": "byte level; string name; string message; string hardware_id; KeyValue[] values",
        "KeyValue": "string key; string value",
    },
    "geometry_msgs": {
        "Point": "float64 x; float64 y; float64 z",
        "Pose": "Point position; Quaternion orientation",
        "PoseStamped": "std_msgs/Header header; Pose pose",
        "PoseWithCovariance": "Pose pose; float64[36] covariance",
        "Quaternion": "float64 x 0; float64 y 0; float64 z 0; float64 w 1",
        "Transform": "Vector3 translation; Quaternion rotation",
        "TransformStamped": "std_msgs/Header header; string child_frame_id; Transform transform",
        "Twist": "Vector3 linear; Vector3 angular",
        "TwistStamped": "std_msgs/Header header; Twist twist",
        "Vector3": "float64 x; float64 y; float64 z",
    },
    "sensor_msgs": {
        "BatteryState": "std_msgs/Header header; float32 voltage; float32 temperature; float32 current; "
        "float32 charge; float32 capacity; float32 design_capacity; float32 percentage; "
        "uint8 power_supply_status; uint8 power_supply_health; uint8 power_supply_technology; bool present; "
        "float32[] cell_voltage; float32[] cell_temperature; string location; string serial_number",
        "CameraInfo": "std_msgs/Header header; uint32 height; uint32 width; string distortion_model; "
        "float64[] d; float64[9] k; float64[9] r; float64[12] p; uint32 binning_x; uint32 binning_y; "
        "RegionOfInterest roi",
        "CompressedImage": "std_msgs/Header header; string format; uint8[] data",
        "Image": "std_msgs/Header header; uint32 height; uint32 width; string encoding; uint8 is_bigendian; "
        "uint32 step; uint8[] data",
        "NavSatFix": "std_msgs/Header header; NavSatStatus status; float64 latitude; float64 longitude; "
        "float64 altitude; float64[9] position_covariance; uint8 position_covariance_type",
        "NavSatStatus": "int8 status -2; uint16 service",
        "PointCloud2": "std_msgs/Header header; uint32 height; uint32 width; PointField[] fields; "
        "bool is_bigendian; uint32 point_step; uint32 row_step; uint8[] data; bool is_dense",
        "PointField": "string name; uint32 offset; uint8 datatype; uint32 count",
        "RegionOfInterest": "uint32 x_offset; uint32 y_offset; uint32 height; uint32 width; bool do_rectify",
    },
    "std_msgs": {"Header": "builtin_interfaces/Time stamp; string frame_id", "String": "string data"},
    "tf2_msgs": {"TFMessage": "geometry_msgs/TransformStamped[] transforms"},
    "vision_msgs": {
        "BoundingBox2D": "Pose2D center; float64 size_x; float64 size_y",
        "BoundingBox3D": "geometry_msgs/Pose center; geometry_msgs/Vector3 size",
        "Detection2D": "std_msgs/Header header; ObjectHypothesisWithPose[] results; BoundingBox2D bbox; "
        "string id",
        "Detection2DArray": "std_msgs/Header header; Detection2D[] detections",
        "Detection3D": "std_msgs/Header header; ObjectHypothesisWithPose[] results; BoundingBox3D bbox; "
        "string id",
        "Detection3DArray": "std_msgs/Header header; Detection3D[] detections",
        "ObjectHypothesis": "string class_id; float64 score",
        "ObjectHypothesisWithPose": "ObjectHypothesis hypothesis; geometry_msgs/PoseWithCovariance pose",
        "Point2D": "float64 x; float64 y",
        "Pose2D": "Point2D position; float64 theta",
    },
}
DEFINITIONS: Mapping[str, str] = MappingProxyType(
    {
        f"{package}/msg/{name}": fields.replace("; ", "\n") + "\n"
        for package, messages in _FIELDS.items()
        for name, fields in messages.items()
    }
)
"""Name of a type, as `std_msgs/msg/Header`: the text of its .msg file."""

# FIELD_TYPE_… of type_description_interfaces/msg/FieldType; an array has 48 more, a sequence 144 more.
_NESTED, _ARRAY, _SEQUENCE = 1, 48, 144
_NUMBERS = ("int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64", "float32", "float64")
# Type: its number, and its code of `struct`; empty: a text.
_PRIMITIVES = {"bool": (15, "?"), "byte": (16, "B"), "string": (17, "")}
_PRIMITIVES |= dict(zip(_NUMBERS, zip(range(2, 12), "bBhHiIqQfd", strict=True), strict=True))
_FIELD = re.compile(r"(?P<type>[\w/]+)(?P<array>\[(?P<length>\d*)\])? (?P<name>\w+)(?: (?P<default>\S+))?")


@dataclass(frozen=True, slots=True)
class RosField:
    """One field of a message.

    Attributes:
        type_name: a primitive, as `float64`, or the name of a message's type.
        length: None: one value; 0: a sequence of any length; else the length of an array.
        default: of a number that is not given.
        code: of a number in Python's `struct`; empty: it is a text or a message.
        nested: it is a message.
    """

    name: str
    type_name: str
    length: int | None
    default: int
    code: str
    nested: bool


@cache
def fields_of(type_name: str) -> tuple[RosField, ...]:
    """Return the fields of a type, in their order.

    Raises:
        ValueError: there is no definition of it.
    """
    text = DEFINITIONS.get(type_name)
    if text is None:
        raise ValueError(f"{type_name!r} is no message with a definition: {', '.join(DEFINITIONS)}")
    package = type_name.partition("/")[0]
    fields = []
    for parts in map(_FIELD.fullmatch, text.splitlines()):
        assert parts is not None
        kind = parts["type"]
        _, code = _PRIMITIVES.get(kind, (_NESTED, ""))
        if nested := kind not in _PRIMITIVES:
            kind = (kind if "/" in kind else f"{package}/{kind}").replace("/", "/msg/")
        length = int(parts["length"] or 0) if parts["array"] else None
        fields.append(RosField(parts["name"], kind, length, int(parts["default"] or 0), code, nested))
    return tuple(fields)


@cache
def _dependencies(type_name: str) -> tuple[str, ...]:
    """The types inside a type, at any depth, sorted."""
    direct = {field.type_name for field in fields_of(type_name) if field.nested}
    return tuple(sorted(direct.union(*map(_dependencies, direct))))


@cache
def type_hash(type_name: str) -> str:
    """Return the hash of a type, `RIHS01_` and 64 hexadecimal digits (REP 2016).

    Raises:
        ValueError: there is no definition of it.
    """
    others = [*map(_description, _dependencies(type_name))]
    described = {"type_description": _description(type_name), "referenced_type_descriptions": others}
    return f"RIHS01_{hashlib.sha256(json.dumps(described).encode()).hexdigest()}"


def _description(type_name: str) -> dict[str, Any]:
    fields = []
    for field in fields_of(type_name):
        number = _NESTED if field.nested else _PRIMITIVES[field.type_name][0]
        number += 0 if field.length is None else _ARRAY if field.length else _SEQUENCE
        kind = {"type_id": number, "capacity": field.length or 0, "string_capacity": 0}
        kind_of = {**kind, "nested_type_name": field.type_name if field.nested else ""}
        fields.append({"name": field.name, "type": kind_of})
    return {"type_name": type_name, "fields": fields}


def full_definition(type_name: str) -> str:
    """Return the text of a type and of those inside it, as MCAP's schema encoding `ros2msg` has it.

    Raises:
        ValueError: there is no definition of it.
    """
    fields_of(type_name)
    others = (
        f"{'=' * 80}\nMSG: {name.replace('/msg/', '/')}\n{DEFINITIONS[name]}"
        for name in _dependencies(type_name)
    )
    return DEFINITIONS[type_name] + "".join(others)
