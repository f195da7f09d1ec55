"""The fast packets are pymavlink's, byte for byte."""

import copy
import math
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.generator.mavcrc import x25crc

from mavlink_sim.wire import packing
from mavlink_sim.wire.messages import dialect, parser
from mavlink_sim.wire.packing import Packed, checksum

HOT = {
    name: getattr(dialect, f"MAVLink_{name}_message")
    for name, value in vars(packing).items()
    if callable(value) and hasattr(dialect, f"MAVLink_{name}_message")
}
LIMITS = {
    "uint8_t": (0, 255),
    "int8_t": (-128, 127),
    "uint16_t": (0, 65535),
    "int16_t": (-32768, 32767),
    "uint32_t": (0, 2**32 - 1),
    "int32_t": (-(2**31), 2**31 - 1),
    "uint64_t": (0, 2**64 - 1),
}


def test_frequent_messages_have_packers() -> None:
    assert {"attitude", "odometry", "highres_imu", "global_position_int"} <= set(HOT)
    assert len(HOT) >= 13


@given(st.binary(max_size=300))
def test_the_checksum_is_that_of_mavlink(data: bytes) -> None:
    assert int.from_bytes(checksum(data), "little") == x25crc(data).crc


@st.composite
def values(draw: st.DrawFn, message_class: Any) -> list[object]:
    lengths = dict(zip(message_class.ordered_fieldnames, message_class.array_lengths, strict=True))
    found: list[object] = []
    for name, kind in zip(message_class.fieldnames, message_class.fieldtypes, strict=True):
        if kind in LIMITS:
            number: st.SearchStrategy[object] = st.integers(*LIMITS[kind])
        else:
            number = st.one_of(st.just(math.nan), st.just(0.0), st.floats(width=32, allow_infinity=False))
        length = lengths[name]
        found.append(draw(st.lists(number, min_size=length, max_size=length) if length else number))
    return found


@pytest.mark.parametrize("name", sorted(HOT))
@settings(max_examples=25, deadline=None)
@given(st.data())
def test_any_values_make_the_same_packet(name: str, data: st.DataObject) -> None:
    arguments = data.draw(values(HOT[name]))
    fast, slow = parser(7, 1), parser(7, 1)
    fast.seq = slow.seq = data.draw(st.integers(0, 255))
    expected = HOT[name](*arguments)
    made = getattr(packing, name)(*arguments)
    assert made.pack(fast) == expected.pack(slow)
    assert (made.get_type(), made.get_msgId()) == (expected.get_type(), expected.get_msgId())


def test_fields_left_out_have_pymavlinks_values() -> None:
    arguments = (1, 2, 3, 4, 5, 6, 7, 8)
    made = packing.distance_sensor(*arguments)
    assert made.pack(parser()) == dialect.MAVLink_distance_sensor_message(*arguments).pack(parser())


def test_packed_has_pymavlink_attributes() -> None:
    made = packing.attitude(1200, 0.5, -0.25, 1.0, 0.0, 0.0, 0.0)
    assert isinstance(made, Packed)
    assert (made.time_boot_ms, made.roll, made.pitch) == (1200, 0.5, -0.25)
    assert made.to_dict() == made.message.to_dict()
    with pytest.raises(AttributeError, match="no_such_field"):
        _ = made.no_such_field


def test_only_a_copy_can_be_changed() -> None:
    made = packing.attitude(1200, 0.5, -0.25, 1.0, 0.0, 0.0, 0.0)
    changed: Any = copy.copy(made)
    changed.roll = 2.0
    assert (changed.roll, made.roll) == (2.0, 0.5)


def test_a_codec_that_signs_gets_a_signed_packet() -> None:
    codec = parser()
    codec.signing.secret_key = bytes(range(32))
    codec.signing.sign_outgoing = True
    codec.signing.timestamp = 1
    packet = packing.attitude(1200, 0.5, -0.25, 1.0, 0.0, 0.0, 0.0).pack(codec)
    assert packet[2] & 1  # MAVLINK_IFLAG_SIGNED
    assert packet[:10] == packet[:1] + bytes([packet[1], 1, 0]) + packet[4:10]
    assert len(packet) == 10 + packet[1] + 2 + 13
