"""Reads CDR with ROS's own code: run by the Python of a ROS 2, it answers each line of JSON with one."""

from __future__ import annotations

import base64
import importlib
import json
import sys
from typing import Any

from rclpy.serialization import deserialize_message, serialize_message


def plain(value: Any) -> Any:
    """Values as JSON has them; a `byte` is a number."""
    if hasattr(value, "get_fields_and_field_types"):
        return {name: plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if isinstance(value, bytes):
        return value[0] if len(value) == 1 else list(value)
    if hasattr(value, "tolist"):
        value = value.tolist()
    return [plain(each) for each in value] if isinstance(value, list | tuple) else value


def answer(request: dict[str, str]) -> dict[str, Any]:
    package, _, name = request["type"].split("/")
    kind = getattr(importlib.import_module(f"{package}.msg"), name)
    message = deserialize_message(base64.b64decode(request["cdr"]), kind)
    return {"value": plain(message), "cdr": base64.b64encode(serialize_message(message)).decode()}


for line in sys.stdin:
    print(json.dumps(answer(json.loads(line))), flush=True)
