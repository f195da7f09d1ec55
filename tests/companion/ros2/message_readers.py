"""Readers of ROS messages by others: rclpy, rosbags, Foxglove; and any values of a type."""

from __future__ import annotations

import base64
import json
import math
import os
import subprocess
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from companion.ros2.definitions import DEFINITIONS, RosField, fields_of, full_definition
from tests.programs import NODE, ROS_PYTHONS

HERE = Path(__file__).parent
# Type, CDR → {"value": …}; of rclpy also the CDR that it writes of it.
Read = Callable[[str, bytes], dict[str, Any]]
INTEGERS = {f"{sign}int{bits}": (sign, bits) for sign in ("", "u") for bits in (8, 16, 32, 64)}
TEXTS = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=12)


@contextmanager
def rclpy_reader(release: str) -> Iterator[Read]:
    # A source folder on PYTHONPATH may have a package of a name that ROS has too.
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    with _process([ROS_PYTHONS[release], HERE / "rclpy_reader.py"], environment) as ask:
        yield lambda type_name, cdr: ask({"type": type_name, "cdr": base64.b64encode(cdr).decode()})


@contextmanager
def foxglove_reader() -> Iterator[Read]:
    assert NODE is not None
    with _process([NODE, HERE / "foxglove_reader.js"], dict(os.environ)) as ask:
        yield lambda type_name, cdr: ask(
            {
                "type": type_name,
                "definition": full_definition(type_name),
                "cdr": base64.b64encode(cdr).decode(),
            }
        )


@contextmanager
def _process(
    command: list[str | Path], environment: Mapping[str, str]
) -> Iterator[Callable[[Mapping[str, str]], dict[str, Any]]]:
    """One process for many messages: a start of rclpy takes a second."""
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
    ) as process:

        def ask(request: Mapping[str, str]) -> dict[str, Any]:
            assert process.stdin is not None
            assert process.stdout is not None
            process.stdin.write(json.dumps(request) + "\n")
            process.stdin.flush()
            answer: dict[str, Any] = json.loads(process.stdout.readline())
            return answer

        yield ask


def rosbags_store() -> Any:
    """The types of Jazzy that rosbags has, and ours of vision_msgs, which it has not."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in DEFINITIONS.items():
        if name.startswith("vision_msgs/"):
            store.register(get_types_from_msg(text, name))
    return store


def rosbags_reader() -> Read:
    store = rosbags_store()
    return lambda type_name, cdr: {"value": plain(store.deserialize_cdr(cdr, type_name))}


def plain(value: Any) -> Any:
    """A message of rosbags as JSON has it."""
    if hasattr(value, "__msgtype__"):
        # Constants are fields there too.
        return {field.name: plain(getattr(value, field.name)) for field in fields_of(value.__msgtype__)}
    if hasattr(value, "tolist"):
        return value.tolist()
    return [plain(each) for each in value] if isinstance(value, list) else value


def equal(found: Any, given: Any) -> bool:
    """Whether a reader found the given values: NaN equals NaN, bytes are numbers, and no field is missing."""
    if isinstance(given, Mapping):
        return found.keys() == given.keys() and all(equal(found[key], each) for key, each in given.items())
    if isinstance(given, list | tuple | bytes | memoryview):
        return len(found) == len(given) and all(map(equal, found, given))
    if isinstance(given, float):
        return float(found) == given or (math.isnan(float(found)) and math.isnan(given))
    return bool(found == given)


def values_of(type_name: str) -> st.SearchStrategy[dict[str, Any]]:
    """Messages of a type with every field."""
    return st.fixed_dictionaries({field.name: _values(field) for field in fields_of(type_name)})


def _values(field: RosField) -> st.SearchStrategy[Any]:
    if field.length == 0 and field.type_name == "uint8":
        return st.binary(max_size=9)
    one = _one(field)
    if field.length is None:
        return one
    return st.lists(one, min_size=field.length, max_size=field.length or 3)


def _one(field: RosField) -> st.SearchStrategy[Any]:
    if field.nested:
        return values_of(field.type_name)
    if field.type_name == "string":
        return TEXTS
    if field.type_name == "bool":
        return st.booleans()
    if field.type_name.startswith("float"):
        return st.floats(width=32 if field.type_name == "float32" else 64)
    if field.type_name == "byte":  # rosbags has a sign in it
        return st.integers(0, 127)
    sign, bits = INTEGERS[field.type_name]
    return st.integers(0, 2**bits - 1) if sign else st.integers(-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
