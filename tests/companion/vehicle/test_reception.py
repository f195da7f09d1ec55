"""Frames of each sender, cut at any byte over its datagrams; loss and splitting are counted apart."""

from __future__ import annotations

import itertools
import random
import socket
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink

from companion.vehicle.drivers import DriverKind, open_driver
from companion.vehicle.reception import MAX_REST_AGE_S, MAX_SENDERS, Reception, ReceptionCounts
from mavlink_sim.wire.endpoint import UdpEndpoint
from tests.companion.vehicle.fake_autopilot import FakeAutopilot, wait_for_state

AUTOPILOT = ("192.168.4.1", 14555)


class Clock:
    """Time that the test sets, seconds."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def packed(count: int, kinds: list[str], text: bytes = b"\xfd\xfe") -> list[bytes]:
    """Frames with ascending sequence numbers, of the given kinds in turn."""
    codec = mavlink.MAVLink(None, 1, 1)
    signer = mavlink.MAVLink(None, 1, 1)
    signer.signing.secret_key, signer.signing.sign_outgoing = b"k" * 32, True
    frames = []
    for number in range(count):
        kind = kinds[number % len(kinds)]
        sender = signer if kind == "signed" else codec
        sender.seq = number % 256
        message: Any
        if number % 3 == 0:
            message = mavlink.MAVLink_heartbeat_message(2, 12, 29, 0x03040000, 3, 3)
        elif number % 3 == 1:
            message = mavlink.MAVLink_local_position_ned_message(5, 1.0, 2.0, number, 4.0, 5.0, 6.0)
        else:
            message = mavlink.MAVLink_statustext_message(6, (text + bytes([number % 256])) * 12)
        frames.append(bytes(message.pack(sender, force_mavlink1=kind == "v1")))
    return frames


def cut(stream: bytes, sizes: list[int]) -> list[bytes]:
    """The stream in datagrams of these sizes, in turn."""
    parts: list[bytes] = []
    position = 0
    for size in itertools.cycle(sizes):
        if position >= len(stream):
            return parts
        parts.append(stream[position : position + size])
        position += size
    raise AssertionError


def read(reception: Reception, datagrams: list[bytes], source: object = AUTOPILOT) -> list[bytes]:
    return [f.raw for d in datagrams for f in reception.feed(d, source, datagram=True, keep=AUTOPILOT)]


kinds = st.lists(st.sampled_from(["v1", "v2", "signed"]), min_size=1, max_size=4)
sizes = st.lists(st.integers(1, 300), min_size=1, max_size=12)


@given(st.integers(1, 20), kinds, sizes)
def test_any_split_of_any_frames_gives_the_same_frames(
    count: int, kinds: list[str], sizes: list[int]
) -> None:
    frames = packed(count, kinds)
    reception = Reception()
    assert read(reception, cut(b"".join(frames), sizes)) == frames
    assert reception.counts.skipped_bytes == 0


@given(st.integers(1, 12), sizes, sizes, st.randoms(use_true_random=False))
def test_interleaved_senders_do_not_disturb_each_other(
    count: int, sizes: list[int], others: list[int], order: random.Random
) -> None:
    frames = packed(count, ["v2", "v1"])
    streams = {AUTOPILOT: cut(b"".join(frames), sizes), "other": cut(b"".join(frames), others)}
    turns = [source for source, parts in streams.items() for _ in parts]
    order.shuffle(turns)
    reception, found = Reception(), dict[object, list[bytes]]()
    for source in turns:
        found.setdefault(source, []).extend(read(reception, [streams[source].pop(0)], source))
    assert found == {AUTOPILOT: frames, "other": frames}


@given(st.integers(30, 60), st.sampled_from([["v1"], ["v2"], ["v1", "v2"]]), st.integers(1, 60), st.data())
def test_a_lost_datagram_costs_only_what_it_held(
    count: int, kinds: list[str], size: int, data: st.DataObject
) -> None:
    """Of signed frames also the next one, if the loss is in a signature: no checksum covers that."""
    frames = packed(count, kinds, b"text")
    datagrams = cut(b"".join(frames), [size])
    lost = data.draw(st.integers(0, len(datagrams) - 1))
    # What follows pushes a false header's frame to its end.
    found = read(Reception(), datagrams[:lost] + datagrams[lost + 1 :] + cut(bytes(300), [12]))
    begins = list(itertools.accumulate(map(len, frames), initial=0))
    whole = [
        raw
        for raw, begin in zip(frames, begins, strict=False)
        if begin + len(raw) <= lost * size or begin >= (lost + 1) * size
    ]
    assert set(whole) <= set(found)


def test_a_mavlink_library_reads_the_same() -> None:
    frames = packed(40, ["v2", "signed", "v1"])
    for size in (1, 2, 12, 50, 263):
        codec = mavlink.MAVLink(None, 1, 1)
        datagrams = cut(b"".join(frames), [size])
        read_by_library = [
            bytes(message.get_msgbuf()) for part in datagrams for message in codec.parse_buffer(part) or []
        ]
        assert read(Reception(), datagrams) == read_by_library == frames


def test_splitting_and_loss_are_counted_apart() -> None:
    frames = packed(30, ["v2"])

    def counts(datagrams: list[bytes]) -> ReceptionCounts:
        reception = Reception()
        for datagram in datagrams:
            for frame in reception.feed(datagram, AUTOPILOT, datagram=True, keep=AUTOPILOT):
                reception.autopilot(frame)
        return reception.counts

    assert counts(frames) == ReceptionCounts(30)
    split = counts(cut(b"".join(frames), [12]))
    assert (split.frames, split.lost, split.skipped_bytes) == (30, 0, 0)
    assert split.split == 30
    assert counts(frames[:10] + frames[14:]) == ReceptionCounts(26, lost=4)
    exchanged = [*frames[:5], frames[6], frames[5], *frames[7:]]
    assert counts(exchanged).lost <= 1


def test_forged_senders_do_not_displace_the_autopilot() -> None:
    (frame,) = packed(1, ["v2"])
    reception = Reception(Clock())
    assert not read(reception, [frame[:9]])
    for port in range(10 * MAX_SENDERS):
        read(reception, [b"\xfd\xff\x00" * 80, frame], ("10.0.0.9", port))
    assert read(reception, [frame[9:]]) == [frame]
    assert len(reception._senders) <= MAX_SENDERS


def test_senders_without_frames_are_forgotten_first() -> None:
    """Before the autopilot is known, nobody who sends only noise takes its place."""
    heartbeat, position = packed(2, ["v2"])
    reception = Reception(Clock())
    reception.feed(heartbeat + position[:9], AUTOPILOT, datagram=True)
    for port in range(10 * MAX_SENDERS):
        reception.feed(b"\xfd\xff\x00" * 80, ("10.0.0.9", port), datagram=True)
    assert [f.raw for f in reception.feed(position[9:], AUTOPILOT, datagram=True)] == [position]


def test_an_old_rest_does_not_hold_back_the_next_frame() -> None:
    clock = Clock()
    reception = Reception(clock)
    first, second = packed(2, ["v2"])
    assert not read(reception, [b"\xfd\xff\x00\x00"])
    assert read(reception, [first]) == [first]  # whole: not held back, whatever came before
    # Of a sender that splits its frames only time shows it.
    assert read(reception, cut(first, [7])) == [first]
    assert not read(reception, [b"\xfd\xff\x00\x00"])
    assert not read(reception, [second])
    clock.now_s += MAX_REST_AGE_S + 0.1
    assert read(reception, [first]) == [second, first]


@pytest.mark.realtime
@pytest.mark.parametrize("size", [12, 50])
async def test_an_autopilot_that_splits_its_frames_connects(
    kind: DriverKind, port: int, autopilot: FakeAutopilot, size: int
) -> None:
    held = b""
    plain = autopilot.send_bytes

    def split(data: bytes) -> None:
        nonlocal held
        held += data
        while len(held) >= size:
            plain(held[:size])
            held = held[size:]

    def send(message: Any) -> None:
        split(bytes(message.pack(autopilot._codec)))
        autopilot._codec.seq = (autopilot._codec.seq + 1) % 256

    autopilot.send = send  # type: ignore[method-assign]
    driver = open_driver(kind, f"udpin://127.0.0.1:{port}")
    try:
        await driver.connect(10.0)
        autopilot.home()
        autopilot.heartbeat()  # which pushes out the rest
        state = await wait_for_state(driver, lambda state: state.home_altitude_amsl_m is not None)
        assert state.home_altitude_amsl_m == pytest.approx(488.0)
        counts = driver.reception
        assert counts.split > 0
        assert (counts.lost, counts.skipped_bytes) == (0, 0)
    finally:
        await driver.close()


@pytest.mark.realtime
def test_the_simulator_reads_split_frames_of_each_client() -> None:
    frames = packed(6, ["v2"])
    endpoint = UdpEndpoint("127.0.0.1", 0, 9)
    clients = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2)]
    found = dict[int, int]()
    try:
        for pair in zip(cut(b"".join(frames), [12]), cut(b"".join(frames), [12]), strict=True):
            for client, part in zip(clients, pair, strict=True):
                client.sendto(part, ("127.0.0.1", endpoint.port))
            for _, sender in endpoint.receive_from():
                found[sender[1]] = found.get(sender[1], 0) + 1
        assert sorted(found.values()) == [6, 6]
    finally:
        endpoint.close()
        for client in clients:
            client.close()
