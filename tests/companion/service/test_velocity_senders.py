"""Velocities as they are received: their lifetime, order, and how many senders are known."""

from __future__ import annotations

import contextlib
import json
import math
from typing import Any

import pytest

from companion.host.peer_data import PeerDataError
from companion.service.velocity_senders import FORGET_S, MAX_SENDERS, VelocitySenders

S = 1_000_000_000


def message(**changes: Any) -> bytes:
    return json.dumps({"source": "a", "stamp_ns": 5 * S, "forward_mps": 1, **changes}).encode()


def test_lifetime_counts_from_the_sending_of_a_late_message() -> None:
    received = VelocitySenders()
    received.on_message(message(), 100 * S)
    assert received.newest(100 * S)[0].expires_ns == 100 * S + S // 2
    received.on_message(message(stamp_ns=6 * S, lifetime_s=0.3), 101 * S + S // 5)  # 0.2 s late
    assert received.newest(102 * S)[0].expires_ns == 101 * S + 3 * S // 10
    assert received.newest(130 * S) == ()


def test_message_that_a_newer_one_has_overtaken_is_refused() -> None:
    received = VelocitySenders()
    for stamp_ms, forward_mps in ((1000, 2.0), (1100, 0.0)):
        payload = message(stamp_ns=stamp_ms * S // 1000, forward_mps=forward_mps)
        received.on_message(payload, 100 * S + stamp_ms * S // 1000)
    with pytest.raises(PeerDataError, match="older"):
        received.on_message(message(stamp_ns=1090 * S // 1000, forward_mps=2.0), 100 * S + 1090 * S // 1000)
    (newest,) = received.newest(102 * S)
    assert (newest.forward_mps, newest.expires_ns) == (0.0, 101 * S + 6 * S // 10)


def test_sender_with_clock_set_back_is_accepted_only_later() -> None:
    received = VelocitySenders()
    received.on_message(message(stamp_ns=50 * S, forward_mps=0.0), 100 * S)
    accepted_s = []
    for second in range(1, 14):
        with contextlib.suppress(PeerDataError):
            received.on_message(message(stamp_ns=second * S, forward_mps=2.0), (100 + second) * S)
        if received.newest((100 + second) * S)[0].forward_mps:
            accepted_s.append(second)
    assert accepted_s[0] == FORGET_S + 1


def test_message_that_arrives_expired_is_reported() -> None:
    received = VelocitySenders()
    received.on_message(message(stamp_ns=5 * S), 100 * S)
    with pytest.raises(PeerDataError, match="late"):
        received.on_message(message(stamp_ns=6 * S), 101 * S + 6 * S // 10)
    assert received.newest(102 * S)[0].expires_ns == 101 * S + S // 2


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"\xff",
        b"[]",
        b'{"forward_mps": 1}',
        message(source="a b"),
        message(source="x" * 65),
        message(lifetime_s=0.6),
        message(lifetime_s=0),
        message(forward_mps="1"),
        message(forward_mps=51),
        message(turn_radps=math.nan),
    ],
)
def test_invalid_message_is_refused(payload: bytes) -> None:
    received = VelocitySenders()
    with pytest.raises(PeerDataError):
        received.on_message(payload, 100 * S)
    assert received.newest(100 * S) == ()


def test_senders_are_bounded_and_the_first_stay() -> None:
    received = VelocitySenders()
    for number in range(MAX_SENDERS):
        received.on_message(message(source=f"s{number}"), 100 * S)
    with pytest.raises(PeerDataError):
        received.on_message(message(source="late"), 100 * S)
    assert [one.source for one in received.newest(100 * S)] == [f"s{number}" for number in range(MAX_SENDERS)]
