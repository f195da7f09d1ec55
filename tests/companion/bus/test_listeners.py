"""What arrives from other programs: every listener of the service, with every kind of bad message."""

from __future__ import annotations

import contextlib
import json
import random
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.bus import topics
from companion.bus.listeners import BATCH, MAX_WAITING, WARN_INTERVAL_S, Listener, ListenerQueue
from companion.host.peer_data import MAX_DEPTH, PeerDataError, parse_json
from companion.service.service import Service
from companion.settings import Settings

NS = 1_000_000_000
LISTENED = ("pose", "status", "velocity")
MIB = 1024 * 1024


class Loop:
    """The calls that a queue has scheduled, and its events. `now_s`: the clock."""

    def __init__(self) -> None:
        self.calls: list[tuple[Callable[..., Any], tuple[Any, ...]]] = []
        self.events: list[tuple[str, str]] = []
        self.now_s = 100.0

    def queue(self, listener: Listener) -> ListenerQueue:
        return ListenerQueue(
            listener,
            lambda call, *arguments: self.calls.append((call, arguments)),
            lambda *event: self.events.append(event),
            lambda: self.now_s,
        )

    def turn(self) -> None:
        """Run what is scheduled now, as one turn of asyncio's loop does."""
        calls, self.calls = self.calls, []
        for call, arguments in calls:
            call(*arguments)

    def run(self) -> None:
        while self.calls:
            self.turn()


class Payload:
    """A payload that counts its copies. `size`: as it states itself."""

    def __init__(self, data: bytes, size: int | None = None) -> None:
        self.data, self.copies = data, 0
        self.size = len(data) if size is None else size

    def __len__(self) -> int:
        return self.size

    def to_bytes(self) -> bytes:
        self.copies += 1
        return self.data


def service_listeners() -> dict[str, Listener]:
    service = Service(Settings())
    return {listener.topic.name: listener for listener in service.bus.listeners}


def valid(name: str, **changes: Any) -> dict[str, Any]:
    """A message that the listener of the topic uses."""
    return {
        "pose": {
            "vehicle": "beta",
            "source": "other",
            "published_ns": 5 * NS,
            "age_s": 0.0,
            "latitude_deg": 47.0,
            "longitude_deg": 8.0,
            "altitude_amsl_m": 500.0,
            "velocity_ned_mps": [0.0, 0.0, 0.0],
            "heading_rad": 0.0,
            "turn_rate_radps": 0.0,
            "role": "alone",
            "airborne": True,
            "formation": None,
        },
        "status": {
            "vehicle": {"name": "beta"},
            "service": "other",
            "uptime_s": 10.0,
            "pilot": {"in_command": False},
        },
        "velocity": {"source": "a", "stamp_ns": 5 * NS, "forward_mps": 1.0},
    }[name] | changes


def bad_payloads(name: str) -> dict[str, bytes]:
    """Kind → payload. The values stand in every field in turn where that matters."""
    body = valid(name)
    largest = {topic.name: topic.largest_bytes for topic in (*topics.TOPICS, *topics.INPUT_TOPICS)}[name]
    found = {
        "huge": b" " * (largest + 1),
        "full of digits": b'{"a": ' + b"9" * (largest - 8) + b"}",
        "deep list": b"[" * (largest // 2),
        "deep object": b'{"a":' * (largest // 8),
        "deep and closed": b"[" * 150 + b"]" * 150,
        "empty": b"",
        "not UTF-8": b'{"vehicle": "\xff\xfe"}',
        "list": b"[]",
        "text": b'"x"',
        "null": b"null",
        "nothing in it": b"{}",
        "not JSON": b"{'a': 1}",
        "two values": b"{} {}",
        "lone surrogate": b'{"vehicle": "\\ud800"}',
    }
    for key in body:
        for kind, text in (
            ("NaN", "NaN"),
            ("infinite", "1e999"),
            ("huge integer", "9" * 400),
            ("deep", "[" * 40 + "]" * 40),
        ):
            found[f"{kind} in {key}"] = json.dumps({**body, key: "@"}).replace('"@"', text).encode()
    return found


def test_every_listener_of_the_service_is_in_this_table() -> None:
    assert set(service_listeners()) == set(LISTENED)
    for name, listener in service_listeners().items():
        listener.on_message(json.dumps(valid(name)).encode(), 6 * NS)


@pytest.mark.parametrize("name", LISTENED)
def test_bad_message_is_counted_and_reported_once(name: str) -> None:
    listener = service_listeners()[name]
    for kind, data in bad_payloads(name).items():
        loop, payload = Loop(), Payload(data)
        queue = loop.queue(listener)
        for _ in range(5):
            queue.offer(payload, 6 * NS)
            loop.run()
        assert queue.ignored == 5, kind
        assert [level for level, _ in loop.events] == ["warning"], kind
        assert "\n" not in loop.events[0][1], kind
        assert len(loop.events[0][1]) < 300, kind
        loop.now_s += WARN_INTERVAL_S
        queue.offer(payload, 6 * NS)
        loop.run()
        assert len(loop.events) == 2, kind


@pytest.mark.parametrize("name", LISTENED)
def test_too_large_message_is_never_copied_or_scheduled(name: str) -> None:
    loop = Loop()
    queue = loop.queue(service_listeners()[name])
    payload = Payload(b"", 90 * MIB)
    for _ in range(1000):
        queue.offer(payload, 0)
    assert payload.copies == 0
    assert queue.ignored == 1000
    loop.turn()  # the line
    assert loop.calls == []


def test_flood_is_bounded_and_the_newest_messages_stay() -> None:
    received: list[bytes] = []
    loop = Loop()
    queue = loop.queue(Listener(topics.POSE, lambda data, _: received.append(data)))
    for number in range(MAX_WAITING + 100):
        queue.offer(Payload(b"%04d" % number), number)
    assert len([call for call, _ in loop.calls if call == queue._handle]) == 1
    loop.turn()
    assert len(received) == BATCH  # then the loop's other work has its turn
    loop.run()
    assert received == [b"%04d" % number for number in range(100, MAX_WAITING + 100)]
    assert queue.ignored == 100
    queue.offer(Payload(b"last"), 0)
    loop.run()
    assert received[-1] == b"last"


def test_error_of_a_listener_does_not_end_the_next_message() -> None:
    received: list[bytes] = []

    def receive(data: bytes, _: int) -> None:
        received.append(data)
        raise RecursionError("deep")

    loop = Loop()
    queue = loop.queue(Listener(topics.POSE, receive))
    for data in (b"1", b"2"):
        queue.offer(Payload(data), 0)
    loop.run()
    assert received == [b"1", b"2"]
    assert queue.ignored == 2


@given(st.binary(max_size=300))
def test_any_bytes_are_parsed_or_refused(data: bytes) -> None:
    with contextlib.suppress(PeerDataError):
        parse_json(data)


def test_numbers_and_depth_are_checked() -> None:
    assert parse_json(b"[" * MAX_DEPTH + b"]" * MAX_DEPTH)
    assert parse_json(b'{"a": [1, 18446744073709551615, -1e308, true, null]}')
    for text in (
        "[" * (MAX_DEPTH + 1) + "]" * (MAX_DEPTH + 1),
        "1" * 21,
        "1e309",
        "-1e309",
        "NaN",
        "Infinity",
    ):
        with pytest.raises(PeerDataError):
            parse_json(text.encode())


@pytest.mark.parametrize("name", LISTENED)
def test_mutated_messages_are_used_or_ignored(name: str) -> None:
    numbers = random.Random(1)
    listener, loop = service_listeners()[name], Loop()
    queue = loop.queue(listener)
    base = json.dumps(valid(name)).encode()
    for _ in range(500):
        data = bytearray(base)
        for _ in range(numbers.randrange(1, 6)):
            data[numbers.randrange(len(data))] = numbers.randrange(256)
        queue.offer(Payload(bytes(data)), 6 * NS)
        loop.run()
    assert queue.ignored > 100
    assert len(loop.events) == 1
