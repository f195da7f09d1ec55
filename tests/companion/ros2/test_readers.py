"""Others read what we write, in every field: rclpy of Jazzy and Kilted, rosbags, Foxglove."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator

import pytest
from hypothesis import given, settings

from companion.ros2.cdr import decode, encode
from companion.ros2.definitions import DEFINITIONS, type_hash
from companion.ros2.messages import OUTPUT_TOPICS, Messages, RosTopic
from tests.companion.ros2.bus_samples import payload_for
from tests.companion.ros2.message_readers import (
    Read,
    equal,
    foxglove_reader,
    rclpy_reader,
    rosbags_reader,
    values_of,
)
from tests.programs import ROS_PYTHONS

RCLPY = [
    pytest.param(release, marks=[pytest.mark.ros2, pytest.mark.needs(f"ROS 2 {release}")])
    for release in ROS_PYTHONS
]
FOXGLOVE = [pytest.mark.needs("node"), pytest.mark.needs("rosmsg2-serialization")]
READERS = [*RCLPY, "rosbags", pytest.param("foxglove", marks=FOXGLOVE)]


@pytest.fixture(scope="module", params=READERS)
def read(request: pytest.FixtureRequest) -> Iterator[Read]:
    if request.param == "rosbags":
        yield rosbags_reader()
        return
    with foxglove_reader() if request.param == "foxglove" else rclpy_reader(request.param) as reader:
        yield reader


@pytest.fixture(scope="module", params=RCLPY)
def read_with_ros(request: pytest.FixtureRequest) -> Iterator[Read]:
    with rclpy_reader(request.param) as reader:
        yield reader


@pytest.mark.hypothesis
@pytest.mark.parametrize("type_name", DEFINITIONS)
def test_every_field_of_every_type_is_read(read: Read, type_name: str) -> None:
    @settings(max_examples=12)
    @given(values_of(type_name))
    def check(value: dict[str, object]) -> None:
        answer = read(type_name, encode(type_name, value))
        assert equal(answer["value"], value)
        if "cdr" in answer:
            assert equal(decode(type_name, base64.b64decode(answer["cdr"])), value)

    check()


@pytest.mark.parametrize("topic", OUTPUT_TOPICS, ids=lambda topic: topic.name)
def test_every_topic_made_of_the_bus_is_read(read: Read, topic: RosTopic) -> None:
    cdr = Messages("drone1/", abs).convert(topic, None, *payload_for(topic))
    assert cdr is not None
    assert equal(read(topic.type_name, cdr)["value"], decode(topic.type_name, cdr))


@pytest.mark.parametrize("type_name", DEFINITIONS)
def test_missing_fields_have_the_defaults_of_ros(read_with_ros: Read, type_name: str) -> None:
    empty = encode(type_name, {})
    assert decode(type_name, empty) == decode(type_name, encode(type_name, decode(type_name, empty)))
    assert equal(read_with_ros(type_name, empty)["value"], decode(type_name, empty))


@pytest.mark.parametrize("text", ["", "Käfer", "\U0001f681", "x" * 1000])
def test_texts_are_read_unchanged(read: Read, text: str) -> None:
    value = {"header": {"frame_id": text}, "detections": [{"id": text, "results": [{}, {}]}]}
    kind = "vision_msgs/msg/Detection2DArray"
    found = read(kind, encode(kind, value))["value"]
    assert found["header"]["frame_id"] == found["detections"][0]["id"] == text
    assert len(found["detections"][0]["results"]) == 2


@pytest.mark.ros2
@pytest.mark.parametrize("release", RCLPY)
@pytest.mark.parametrize("type_name", DEFINITIONS)
def test_hash_is_that_of_ros(release: str, type_name: str) -> None:
    package, _, name = type_name.split("/")
    file = ROS_PYTHONS[release].parents[1] / "share" / package / "msg" / f"{name}.json"
    hashes = {row["type_name"]: row["hash_string"] for row in json.loads(file.read_text())["type_hashes"]}
    assert hashes[type_name] == type_hash(type_name)
