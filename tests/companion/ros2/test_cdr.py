"""CDR in both byte orders; what is not of its type is refused in one line."""

from __future__ import annotations

import struct
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.ros2.cdr import decode, encode
from companion.ros2.definitions import DEFINITIONS, fields_of
from tests.companion.ros2.message_readers import equal, rosbags_store, values_of

HEADER = "std_msgs/msg/Header"
IMAGE = "sensor_msgs/msg/Image"
DETECTIONS = "vision_msgs/msg/Detection2DArray"
TYPES_AND_VALUES = st.sampled_from(list(DEFINITIONS)).flatmap(
    lambda name: st.tuples(st.just(name), values_of(name))
)


def refused(type_name: str, payload: bytes) -> str:
    with pytest.raises(ValueError, match=type_name) as caught:
        decode(type_name, payload)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def error_of(type_name: str, payload: bytes) -> str:
    """Why it is refused; empty: it is read. Any other error is raised."""
    try:
        decode(type_name, payload)
    except ValueError as error:
        return str(error)
    return ""


@given(TYPES_AND_VALUES)
def test_decode_returns_what_was_encoded(sample: tuple[str, dict[str, Any]]) -> None:
    type_name, value = sample
    assert equal(decode(type_name, encode(type_name, value)), value)


def test_alignment_counts_from_behind_the_encapsulation() -> None:
    payload = encode("geometry_msgs/msg/PoseStamped", {"header": {"frame_id": "map"}, "pose": {}})
    # Stamp, length, "map" and its zero are 16 bytes: the first float64 follows at once.
    assert len(payload) == 4 + 16 + 7 * 8
    payload = encode("geometry_msgs/msg/PoseStamped", {"header": {"frame_id": "maps"}, "pose": {}})
    assert len(payload) == 4 + 24 + 7 * 8


def test_no_padding_is_written_before_an_empty_sequence_of_float64() -> None:
    fields = {"header": {"frame_id": "c"}, "distortion_model": "plumb_bob"}
    lengths = [len(encode("sensor_msgs/msg/CameraInfo", fields | {"d": [0.5] * n})) for n in (0, 1, 5)]
    # 4 bytes of padding follow the length in any case: before the first of `d`, or of `k`.
    assert [length - lengths[0] for length in lengths] == [0, 8, 40]


@given(TYPES_AND_VALUES)
def test_big_endian_is_read(sample: tuple[str, dict[str, Any]]) -> None:
    type_name, value = sample
    little = encode(type_name, value)
    big = bytes(STORE.serialize_cdr(STORE.deserialize_cdr(little, type_name), type_name, little_endian=False))
    assert big[:2] == b"\0\0"
    assert equal(decode(type_name, big), value)


STORE = rosbags_store()


def test_bytes_are_not_copied() -> None:
    payload = encode(IMAGE, {"height": 1, "width": 4, "encoding": "mono8", "step": 4, "data": b"abcd"})
    data = decode(IMAGE, payload)["data"]
    assert isinstance(data, memoryview)
    assert data.obj is payload
    assert data.readonly
    assert bytes(data) == b"abcd"


@pytest.mark.parametrize("data", [b"ab", bytearray(b"ab"), memoryview(b"ab"), [97, 98]])
def test_bytes_are_taken_from_any_buffer(data: Any) -> None:
    assert encode(IMAGE, {"data": data}) == encode(IMAGE, {"data": b"ab"})


def test_defaults_are_those_of_ros() -> None:
    assert decode("geometry_msgs/msg/Quaternion", encode("geometry_msgs/msg/Quaternion", {}))["w"] == 1.0
    assert decode("sensor_msgs/msg/NavSatStatus", encode("sensor_msgs/msg/NavSatStatus", {}))["status"] == -2
    assert encode("sensor_msgs/msg/BatteryState", {"voltage": None}) == encode(
        "sensor_msgs/msg/BatteryState", {}
    )


@pytest.mark.parametrize("type_name", DEFINITIONS)
def test_every_cut_payload_is_refused(type_name: str) -> None:
    payload = encode(
        type_name, {field.name: [{}] for field in fields_of(type_name) if field.length == 0 and field.nested}
    )
    for size in range(len(payload)):
        refused(type_name, payload[:size])


def test_padding_to_four_bytes_is_accepted_and_more_is_not() -> None:
    payload = encode("sensor_msgs/msg/RegionOfInterest", {"do_rectify": True})
    assert decode("sensor_msgs/msg/RegionOfInterest", payload + bytes(3))["do_rectify"] is True
    refused("sensor_msgs/msg/RegionOfInterest", payload + bytes(4))


@pytest.mark.parametrize(
    "begin", [b"", b"\0", b"\0\1", b"\0\2\0\0", b"\0\7\0\0", b"\0\x0b\0\0", b"\x1f\x8b\0\0"]
)
def test_another_encapsulation_is_refused(begin: bytes) -> None:
    refused("builtin_interfaces/msg/Time", begin + bytes(8 if len(begin) == 4 else 0))


@pytest.mark.parametrize("count", [2**16, 2**31, 2**32 - 1])
@pytest.mark.parametrize("at", [4 + 8, 4 + 16])  # of the frame's name, and of the detections
def test_a_length_beyond_the_payload_is_refused(at: int, count: int) -> None:
    payload = bytearray(encode(DETECTIONS, {"header": {"frame_id": ""}}))
    payload[at : at + 4] = struct.pack("<I", count)
    refused(DETECTIONS, bytes(payload))


@pytest.mark.parametrize("type_name", DEFINITIONS)
def test_a_huge_number_anywhere_is_read_or_refused(type_name: str) -> None:
    payload = encode(type_name, {})
    for at in range(4, len(payload) - 3, 4):
        changed = payload[:at] + b"\xff\xff\xff\xff" + payload[at + 4 :]
        assert "\n" not in error_of(type_name, changed)


@pytest.mark.parametrize(
    ("written", "read"),
    [
        ("sensor_msgs/msg/CompressedImage", IMAGE),
        (IMAGE, "sensor_msgs/msg/CompressedImage"),
        (DETECTIONS, "vision_msgs/msg/Detection3DArray"),
        ("geometry_msgs/msg/Twist", "geometry_msgs/msg/PoseStamped"),
        ("geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/Twist"),
        ("std_msgs/msg/String", "std_msgs/msg/Header"),
    ],
)
def test_another_type_is_refused(written: str, read: str) -> None:
    value: dict[str, Any] = {"data": "car"} if written == "std_msgs/msg/String" else {}
    if written == DETECTIONS:
        value = {"detections": [{"results": [{}]}]}
    refused(read, encode(written, value))


def test_type_of_another_version_is_refused() -> None:
    """Detection2D of vision_msgs 3 has `is_tracking` and `tracking_id` where 4 has `id`."""
    found = encode("vision_msgs/msg/Detection2D", {"results": [{"hypothesis": {"class_id": "car"}}]})
    assert refused("vision_msgs/msg/Detection2D", found[:-5] + b"\1\0\0\0\3\0\0\0ab\0")


@pytest.mark.parametrize("text", [b"ab", b"\xff\0", b"\xc3\0"])
def test_text_without_its_end_or_not_utf8_is_refused(text: bytes) -> None:
    payload = b"\0\1\0\0" + struct.pack("<I", len(text)) + text
    refused("std_msgs/msg/String", payload)


def test_empty_text_without_its_zero_is_read() -> None:
    assert decode("std_msgs/msg/String", b"\0\1\0\0" + bytes(4)) == {"data": ""}


@given(st.sampled_from(list(DEFINITIONS)), st.binary(max_size=120))
def test_any_bytes_are_read_or_refused(type_name: str, payload: bytes) -> None:
    for begin in (b"", b"\0\1\0\0"):
        assert "\n" not in error_of(type_name, begin + payload)


@pytest.mark.parametrize(
    ("type_name", "value"),
    [
        ("nav_msgs/msg/Odometry", {}),
        (HEADER, {"frame": "map"}),
        (HEADER, {"stamp": {"sec": 2**31}}),
        (HEADER, {"stamp": {"sec": 0.5}}),
        (HEADER, {"stamp": 5}),
        (HEADER, {"frame_id": 5}),
        (HEADER, {"frame_id": "\ud800"}),
        ("sensor_msgs/msg/BatteryState", {"voltage": 1e39}),
        ("sensor_msgs/msg/CameraInfo", {"k": [1.0] * 8}),
        (IMAGE, {"data": "text"}),
        (IMAGE, {"data": [256]}),
        (DETECTIONS, {"detections": [None, 5]}),
    ],
)
def test_value_that_its_field_cannot_have_is_refused(type_name: str, value: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=type_name) as caught:
        encode(type_name, value)
    assert "\n" not in str(caught.value)
