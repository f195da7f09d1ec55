"""Foxglove's message types as JSON Schema (https://docs.foxglove.dev/docs/sdk/schemas): the fields we set."""

from __future__ import annotations

import json
from typing import Any

_NUMBER, _TEXT = {"type": "number"}, {"type": "string"}
_COUNT = {"type": "integer", "minimum": 0}


def _object(title: str, **properties: Any) -> dict[str, Any]:
    return {"title": title, "type": "object", "properties": properties, "required": list(properties)}


def _list(items: dict[str, Any], length: int | None = None) -> dict[str, Any]:
    return {"type": "array", "items": items} | (
        {} if length is None else {"minItems": length, "maxItems": length}
    )


_TIME = _object("time", sec=_COUNT, nsec={**_COUNT, "maximum": 999_999_999})
_VECTOR3 = _object("foxglove.Vector3", x=_NUMBER, y=_NUMBER, z=_NUMBER)
_QUATERNION = _object("foxglove.Quaternion", x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER)
_POINT2 = _object("foxglove.Point2", x=_NUMBER, y=_NUMBER)
_COLOR = _object("foxglove.Color", r=_NUMBER, g=_NUMBER, b=_NUMBER, a=_NUMBER)
_KEY_VALUE = _object("foxglove.KeyValuePair", key=_TEXT, value=_TEXT)
_POINTS = _object(
    "foxglove.PointsAnnotation",
    timestamp=_TIME,
    type=_COUNT,
    points=_list(_POINT2),
    outline_color=_COLOR,
    outline_colors=_list(_COLOR),
    fill_color=_COLOR,
    thickness=_NUMBER,
    metadata=_list(_KEY_VALUE),
)
_POSE = _object("foxglove.Pose", position=_VECTOR3, orientation=_QUATERNION)
_FIELD = _object("foxglove.PackedElementField", name=_TEXT, offset=_COUNT, type=_COUNT)
_LABEL = _object(
    "foxglove.TextAnnotation",
    timestamp=_TIME,
    position=_POINT2,
    text=_TEXT,
    font_size=_NUMBER,
    text_color=_COLOR,
    background_color=_COLOR,
    metadata=_list(_KEY_VALUE),
)
_TRANSFORM = _object(
    "foxglove.FrameTransform",
    timestamp=_TIME,
    parent_frame_id=_TEXT,
    child_frame_id=_TEXT,
    translation=_VECTOR3,
    rotation=_QUATERNION,
)

SCHEMAS = {
    schema["title"]: json.dumps(schema).encode()
    for schema in (
        _object(
            "foxglove.CompressedImage",
            timestamp=_TIME,
            frame_id=_TEXT,
            data={"type": "string", "contentEncoding": "base64"},
            format=_TEXT,
        ),
        _object(
            "foxglove.RawImage",
            timestamp=_TIME,
            frame_id=_TEXT,
            width=_COUNT,
            height=_COUNT,
            encoding=_TEXT,
            step=_COUNT,
            data={"type": "string", "contentEncoding": "base64"},
        ),
        _object(
            "foxglove.ImageAnnotations",
            timestamp=_TIME,
            circles=_list({"type": "object"}),
            points=_list(_POINTS),
            texts=_list(_LABEL),
            metadata=_list(_KEY_VALUE),
        ),
        _object("foxglove.FrameTransforms", transforms=_list(_TRANSFORM)),
        _object(
            "foxglove.LocationFix",
            timestamp=_TIME,
            frame_id=_TEXT,
            latitude=_NUMBER,
            longitude=_NUMBER,
            altitude=_NUMBER,
            position_covariance=_list(_NUMBER, 9),
            position_covariance_type=_COUNT,
        ),
        _object(
            "foxglove.CameraCalibration",
            timestamp=_TIME,
            frame_id=_TEXT,
            width=_COUNT,
            height=_COUNT,
            distortion_model=_TEXT,
            D=_list(_NUMBER),
            K=_list(_NUMBER, 9),
            R=_list(_NUMBER, 9),
            P=_list(_NUMBER, 12),
        ),
        _object("foxglove.PosesInFrame", timestamp=_TIME, frame_id=_TEXT, poses=_list(_POSE)),
        _object(
            "foxglove.PointCloud",
            timestamp=_TIME,
            frame_id=_TEXT,
            pose=_POSE,
            point_stride=_COUNT,
            fields=_list(_FIELD),
            data={"type": "string", "contentEncoding": "base64"},
        ),
        _object(
            "foxglove.Log",
            timestamp=_TIME,
            level=_COUNT,
            message=_TEXT,
            name=_TEXT,
            file=_TEXT,
            line=_COUNT,
        ),
    )
}
"""Name of the type → its schema."""
