"""The objects in TUNNEL, read by the example, and TARGET_RELATIVE."""

from __future__ import annotations

import math
import runpy
import select
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink

from companion.ground_station.component import RequestTable
from companion.ground_station.objects import MOST_BYTES, PAYLOAD_TYPE, Objects, encode, target_relative
from companion.ground_station.tracking import Tracking
from companion.host.clock import unix_offset_ns
from companion.vehicle.framing import frames_of
from mavlink_sim.testing import free_port
from tests.companion.ground_station.bodies import (
    HEIGHT,
    MS,
    NOW_NS,
    WIDTH,
    command_state,
    detection,
    frame,
    tracked_object,
)

EXAMPLE_FILE = str(Path(__file__).parents[3] / "examples" / "decode_objects.py")
EXAMPLE = runpy.run_path(EXAMPLE_FILE)
DEGREES = st.none() | st.floats(-180.0, 180.0) | st.just(math.nan)


def decoded(payloads: list[bytes]) -> list[dict[str, Any]]:
    assert all(len(payload) <= MOST_BYTES for payload in payloads)
    return [each for payload in payloads for each in EXAMPLE["decode"](payload)]


@st.composite
def detections(draw: st.DrawFn) -> Any:
    x, y = draw(st.tuples(st.floats(0, WIDTH), st.floats(0, HEIGHT)))
    return detection(
        draw(st.integers(1, 2**32 - 1)),
        [x, y, draw(st.floats(x, WIDTH)), draw(st.floats(y, HEIGHT))],
        class_name=draw(st.text(max_size=12).map(lambda text: text.encode("utf-8", "ignore").decode())),
        confidence=draw(st.floats(0.0, 1.0)),
        track_score=draw(st.none() | st.floats(0.0, 1.0)),
        latitude_deg=draw(DEGREES),
        longitude_deg=draw(DEGREES),
        altitude_amsl_m=draw(st.none() | st.floats(-500, 9000) | st.just(math.nan)),
    )


@given(st.lists(detections(), max_size=12), st.integers(0, 1000))
def test_objects_are_decoded_as_they_were(boxes: list[Any], number: int) -> None:
    read = decoded(encode(frame(*boxes), number, NOW_NS))
    assert len(read) == min(len(boxes), 10)
    surest = sorted(boxes, key=lambda each: -(each["track_score"] or each["confidence"]))
    for each, source in zip(read, surest, strict=False):
        assert (each["track"], each["set"], each["of"]) == (source["track_id"], number % 256, len(read))
        assert source["class_name"].startswith(each["class"])
        assert len(each["class"].encode()) <= 24
        assert each["confidence"] == pytest.approx(source["confidence"], abs=1 / 500)
        scaled = [edge / size for edge, size in zip(source["xyxy"], (WIDTH, HEIGHT) * 2, strict=True)]
        assert each["box"] == pytest.approx(scaled, abs=1 / 65535)
        latitude = source["latitude_deg"]
        if latitude is None or math.isnan(latitude):
            assert each["place"] is None
        elif each["place"] is not None:
            assert each["place"][0] == pytest.approx(latitude, abs=1e-7)
        assert each["altitude_m"] is None or abs(each["altitude_m"] - source["altitude_amsl_m"]) < 1e-3


@pytest.mark.parametrize("name", ["Fußgänger", "", "ä" * 40, "a" + "ä" * 40, "人" * 9])
def test_name_is_cut_between_letters(name: str) -> None:
    (read,) = decoded(encode(frame(detection(1, (0, 0, 9, 9), class_name=name)), 1, NOW_NS))
    assert name.startswith(read["class"])
    assert bool(read["class"]) == bool(name)


def test_ten_surest_of_many_are_sent() -> None:
    boxes = [detection(n, (0, 0, 9, 9), track_score=(n * 7 % 300) / 300) for n in range(1, 301)]
    boxes += [detection(900, (0, 0, 9, 9), track_score=1.0, track_state="tentative")]
    payloads = encode(frame(*boxes), 1, NOW_NS)
    read = decoded(payloads)
    assert [round(each["track"] * 7 % 300) for each in read] == list(range(299, 289, -1))
    assert len(payloads) == 4
    assert decoded(encode(frame(), 1, NOW_NS)) == []


@pytest.mark.parametrize("payload", [b"", b"CO", b"CO\x02" + bytes(5), b"XX\x01" + bytes(40)])
def test_payload_of_others_has_no_objects(payload: bytes) -> None:
    assert decoded([payload]) == []


def test_object_has_its_fused_position_and_flags() -> None:
    seen = detection(7, (0, 0, 320, 480), object_id=3)
    known = tracked_object(3, [7], ambiguous=True)
    (read,) = decoded(encode(frame(seen, objects=[known]), 1, NOW_NS, selected=7))
    assert read["place"] == pytest.approx((47.3977419, 8.5455938), abs=1e-7)
    assert read["altitude_m"] == 488.125
    assert (read["selected"], read["moving"], read["ambiguous"]) == (True, True, True)
    assert (read["box"], read["age_ms"]) == (pytest.approx([0, 0, 0.5, 1], abs=1e-4), 30)


def test_example_prints_what_it_receives() -> None:
    port = free_port()
    program = [sys.executable, "-u", EXAMPLE_FILE, f"udpin:127.0.0.1:{port}"]
    (payload,) = encode(frame(detection(7, (0, 0, 9, 9), class_name="Fußgänger")), 1, NOW_NS)
    message = mavlink.MAVLink_tunnel_message(
        0, 0, PAYLOAD_TYPE, len(payload), payload.ljust(MOST_BYTES, b"\0")
    )
    packet = message.pack(mavlink.MAVLink(None, 1, 101))
    with (
        subprocess.Popen(program, stdout=subprocess.PIPE, text=True, encoding="utf-8") as process,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        assert process.stdout is not None
        try:
            while not select.select([process.stdout], [], [], 0.1)[0]:
                assert process.poll() is None
                sender.sendto(packet, ("127.0.0.1", port))
            line = process.stdout.readline()
        finally:
            process.kill()
    assert line.startswith("camera 101: ")
    assert "'class': 'Fußgänger'" in line


class Sender:
    """The objects of a camera."""

    def __init__(self, *, target: bool = False) -> None:
        self.requests = RequestTable()
        self.tracking = Tracking(
            "first",
            lambda: 100,
            self.requests,
            max_age_s=5.0,
            steers=True,
            follows=False,
            send=lambda *_: None,
            say=lambda *_: None,
        )
        self.objects = Objects(self.tracking, target_relative=target)
        self.now_ns, self.sequence = NOW_NS, 0

    def pass_time(self, milliseconds: int, *boxes: Any) -> list[Any]:
        self.now_ns += milliseconds * MS
        self.sequence += 1
        self.tracking.on_detections(frame(*boxes, now_ns=self.now_ns, sequence=self.sequence))
        return list(self.objects.due(self.now_ns))


def test_objects_are_sent_twice_a_second_and_their_end_once() -> None:
    sender, box = Sender(), detection(7, (0, 0, 9, 9))
    sent = [message for _ in range(60) for message in sender.pass_time(50, box)]
    assert {(each.get_type(), each.payload_type) for each in sent} == {("TUNNEL", PAYLOAD_TYPE)}
    assert 6 <= len(sent) <= 7
    sent = [message for _ in range(60) for message in sender.pass_time(50)]
    assert len(sent) == 1
    assert decoded([bytes(sent[0].payload)[: sent[0].payload_length]]) == []


def test_objects_are_sent_at_most_five_times_a_second() -> None:
    sender, box = Sender(), detection(7, (0, 0, 9, 9))
    sender.tracking.streams[mavlink.MAVLINK_MSG_ID_TUNNEL].set_interval(1000)
    sent = [message for _ in range(60) for message in sender.pass_time(50, box)]
    assert 15 <= len(sent) <= 16


def test_objects_of_an_old_frame_are_not_sent() -> None:
    sender = Sender()
    sender.pass_time(0, detection(7, (0, 0, 9, 9)))
    assert list(sender.objects.due(sender.now_ns + 600 * MS)) == []


def test_target_relative_is_a_valid_frame() -> None:
    message = target_relative(frame(), detection(300, (0, 0, 9, 9)))
    assert message is not None
    codec = mavlink.MAVLink(None, 1, 100)
    (sent,) = frames_of(message.pack(codec))
    assert (sent.message_id, sent.checked) == (511, True)
    fields = message.unpacker.unpack(sent.padded(message.unpacker.size))
    assert fields[0] == pytest.approx((unix_offset_ns() + frame()["captured_ns"]) / 1000, abs=1000.0)
    assert fields[1:4] == pytest.approx((8 * math.cos(0.5), 8 * math.sin(0.5), 6.0))
    assert fields[4:6] == pytest.approx((2.0, 1.0))
    assert all(map(math.isnan, fields[6:12]))
    assert fields[12:16] == (0.0, 0.0, 0.0, 0.0)
    assert fields[16:] == (300 % 256, 2, mavlink.LANDING_TARGET_TYPE_VISION_OTHER)


@pytest.mark.parametrize("target", [False, True])
def test_target_relative_is_of_the_selected_object_only(target: bool) -> None:
    sender, box = Sender(target=target), detection(7, (0, 0, 9, 9))
    others = detection(8, (0, 0, 9, 9))
    assert all(each.get_type() == "TUNNEL" for each in sender.pass_time(100, box, others))
    selected = command_state("s-1", "select x=0 y=0 width=1 height=1", "ended", "track 7, a person, is there")
    sender.tracking.on_command_state(selected)
    sent = [each.get_type() for each in sender.pass_time(100, box, others)]
    assert ("TARGET_RELATIVE" in sent) == target
    unknown = detection(7, (0, 0, 9, 9), ground_range_m=None)
    assert "TARGET_RELATIVE" not in [each.get_type() for each in sender.pass_time(200, unknown)]
