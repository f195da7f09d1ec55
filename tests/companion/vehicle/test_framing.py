from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink

from companion.vehicle.framing import (
    CRC_EXTRA,
    CURRENT_MODE_ID,
    Frame,
    Framer,
    frames_of,
    pack_frame,
    with_sequence,
)
from companion.vehicle.state import FlightMode, LandedState, VehicleState
from companion.vehicle.telemetry import TELEMETRY_MESSAGES, apply_message

CODEC = mavlink.MAVLink(None, 1, 1)
HEARTBEAT = bytes(mavlink.MAVLink_heartbeat_message(2, 12, 29, 0x03040000, 3, 3).pack(CODEC))
HEARTBEAT_V1 = bytes(
    mavlink.MAVLink_heartbeat_message(2, 12, 29, 0x03040000, 3, 3).pack(CODEC, force_mavlink1=True)
)
POSITION = bytes(mavlink.MAVLink_local_position_ned_message(5, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0).pack(CODEC))
UNKNOWN = b"\xfd\x03\x00\x00\x07\x01\x01" + (60000).to_bytes(3, "little") + b"abc" + b"\x12\x34"

good_frames = st.sampled_from([HEARTBEAT, HEARTBEAT_V1, POSITION])
# Noise without a magic byte cannot consume following frames.
noise = st.binary(max_size=40).map(lambda data: data.replace(b"\xfd", b"\0").replace(b"\xfe", b"\0"))


@given(
    parts=st.lists(st.tuples(noise, good_frames), max_size=8), cuts=st.lists(st.integers(0, 400), max_size=12)
)
def test_stream_is_framed_however_it_is_split(parts: list[tuple[bytes, bytes]], cuts: list[int]) -> None:
    stream = b"".join(junk + frame for junk, frame in parts)
    framer = Framer()
    found = []
    position = 0
    for cut in [*cuts, len(stream)]:
        found += framer.feed(stream[position : position + cut], datagram=False)
        position += cut
    assert [frame.raw for frame in found] == [frame for _, frame in parts]
    assert framer.skipped_bytes == sum(len(junk) for junk, _ in parts)


@given(st.binary(max_size=700), st.booleans())
def test_framer_recovers_from_any_bytes(data: bytes, datagram: bool) -> None:
    framer = Framer()
    framer.feed(data, datagram=datagram)
    # On a stream a false header may announce the longest frame.
    filler = b"" if datagram else bytes(300)
    assert framer.feed(filler + HEARTBEAT, datagram=datagram)[-1].raw == HEARTBEAT


@given(st.integers(1, len(POSITION) - 1), st.integers(1, 255))
def test_corrupt_byte_loses_only_its_frame(at: int, flip: int) -> None:
    broken = bytearray(POSITION)
    broken[at] ^= flip
    found = [frame.raw for frame in frames_of(bytes(broken) + HEARTBEAT)]
    assert POSITION not in found
    assert HEARTBEAT in found


def test_a_rest_does_not_hold_back_whole_frames() -> None:
    framer = Framer()
    assert framer.feed(POSITION[:20], datagram=True) == []
    assert [frame.raw for frame in framer.feed(HEARTBEAT, datagram=True)] == [HEARTBEAT]
    assert framer.skipped_bytes == 20


def test_headers_of_both_protocol_versions() -> None:
    for raw in (HEARTBEAT, HEARTBEAT_V1):
        (frame,) = frames_of(raw)
        assert (frame.message_id, frame.system_id, frame.component_id, frame.checked) == (0, 1, 1, True)
        assert frame.padded(9)[:4] == struct.pack("<I", 0x03040000)


def test_undefined_message_is_framed_unchecked() -> None:
    (frame,) = frames_of(UNKNOWN)
    assert (frame.message_id, frame.checked, frame.payload) == (60000, False, b"abc")
    assert with_sequence(frame, 99) == UNKNOWN


@given(payload=st.binary(min_size=28, max_size=28), sequence=st.integers(0, 255), again=st.integers(0, 255))
def test_pymavlink_reads_what_we_pack(payload: bytes, sequence: int, again: int) -> None:
    raw = pack_frame(32, payload, system_id=9, component_id=8, sequence=sequence)
    (frame,) = frames_of(raw)
    assert (frame.system_id, frame.component_id, frame.sequence) == (9, 8, sequence)
    assert frame.padded(28) == payload
    for data, number in ((raw, sequence), (with_sequence(frame, again), again)):
        message = CODEC.decode(bytearray(data))
        assert (message.get_type(), message.get_seq(), message.get_srcSystem()) == (
            "LOCAL_POSITION_NED",
            number,
            9,
        )


def test_signed_frame_is_never_renumbered() -> None:
    signer = mavlink.MAVLink(None, 1, 1)
    signer.signing.secret_key = b"k" * 32
    signer.signing.sign_outgoing = True
    raw = bytes(mavlink.MAVLink_local_position_ned_message(5, 1, 2, 3, 4, 5, 6).pack(signer))
    frame, following = frames_of(raw + HEARTBEAT)
    assert (frame.raw, following.raw) == (raw, HEARTBEAT)
    assert with_sequence(frame, 77) == raw


def test_frame_with_unknown_flags_is_dropped() -> None:
    strange = bytearray(HEARTBEAT)
    strange[2] = 0x02
    assert [frame.raw for frame in frames_of(bytes(strange) + HEARTBEAT)] == [HEARTBEAT]


def test_current_mode_has_the_crc_extra_of_its_definition() -> None:
    """The rule of https://mavlink.io/en/guide/serialization.html#crc_extra, on the fields of message 436."""
    text = b"CURRENT_MODE " + b"".join(
        b"%s %s " % field
        for field in (
            (b"uint32_t", b"custom_mode"),
            (b"uint32_t", b"intended_custom_mode"),
            (b"uint8_t", b"standard_mode"),
        )
    )
    crc = mavlink.x25crc(text).crc
    assert (crc & 0xFF) ^ (crc >> 8) == CRC_EXTRA[CURRENT_MODE_ID]


@pytest.fixture
def flight_log() -> Path:
    root = Path(os.environ.get("COMPANION_TEST_DATA", Path(__file__).parents[3] / "../shared/data"))
    log = root / "px4" / "px4_sih_offboard_flight.tlog"
    if not log.exists():
        pytest.skip(f"no flight log of a real PX4 at {log}; set COMPANION_TEST_DATA")
    return log


def test_real_px4_log_is_decoded(flight_log: Path) -> None:
    """The log alternates a stamp of 8 bytes and a frame."""
    telemetry_ids = {number for number, m in mavlink.mavlink_map.items() if m.msgname in TELEMETRY_MESSAGES}
    telemetry_ids.add(CURRENT_MODE_ID)
    data = flight_log.read_bytes()
    state = VehicleState()
    modes: list[object] = []
    landed: list[object] = []
    armed: list[object] = []
    position = count = 0
    while position < len(data):
        header = data[position + 8 : position + 11]
        length = header[1] + (12 + 13 * (header[2] & 1) if header[0] == 0xFD else 8)
        (frame,) = frames_of(data[position + 8 : position + 8 + length])
        position += 8 + length
        count += 1
        if (frame.system_id, frame.component_id) != (1, 1) or frame.message_id not in telemetry_ids:
            continue
        name, fields = _decoded(frame)
        state = apply_message(state, name, fields, count)
        for seen, value in ((modes, state.mode), (landed, state.landed), (armed, state.armed)):
            if not seen or seen[-1] != value:
                seen.append(value)
    assert count > 1000
    assert {FlightMode.HOLD, FlightMode.OFFBOARD, FlightMode.TAKEOFF} <= set(modes)
    assert FlightMode.UNKNOWN not in modes[1:]
    assert [LandedState.ON_GROUND, LandedState.TAKING_OFF, LandedState.IN_AIR] == landed[1:4]
    assert armed[:2] == [False, True]
    assert state.home_altitude_amsl_m is not None
    assert state.position_ned_m is not None
    assert state.altitude_amsl_m is not None
    assert state.altitude_m is not None
    assert abs(state.altitude_amsl_m - state.home_altitude_amsl_m - state.altitude_m) < 2.0


def _decoded(frame: Frame) -> tuple[str, dict[str, Any]]:
    if frame.message_id == CURRENT_MODE_ID:
        return "CURRENT_MODE", {"custom_mode": struct.unpack("<I", frame.padded(4))[0]}
    message = CODEC.decode(bytearray(frame.raw))
    return message.get_type(), message.to_dict()
