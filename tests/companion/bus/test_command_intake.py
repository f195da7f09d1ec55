"""Which queries are accepted as commands, and at which rate."""

from __future__ import annotations

import zenoh
from hypothesis import given
from hypothesis import strategies as st

from companion.bus.command_intake import (
    ALL_SENDERS,
    BURST,
    COMMANDS_PER_S,
    LARGEST_COMMAND_BYTES,
    CommandIntake,
)


class Clock:
    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def read(intake: CommandIntake, data: bytes, sender: bytes = b"") -> tuple[str | None, str]:
    return intake.read(zenoh.ZBytes(data), sender)


def test_burst_then_limited_rate() -> None:
    clock = Clock()
    intake = CommandIntake(clock)
    assert all(read(intake, b"hold")[0] == "hold" for _ in range(BURST))
    assert read(intake, b"hold")[0] is None
    accepted = 0
    for _ in range(1000):  # ten seconds, a hundred a second
        clock.now_s += 0.01
        accepted += read(intake, b"hold")[0] is not None
    assert abs(accepted - 10.0 * COMMANDS_PER_S) <= 1
    assert intake.refused == 1001 - accepted


def test_stop_has_a_separate_allowance() -> None:
    intake = CommandIntake(Clock())
    for _ in range(2 * BURST):
        read(intake, b"dance")
    assert read(intake, b"STOP ")[0] == "STOP "


def test_a_flood_of_one_sender_leaves_the_others_their_rate() -> None:
    intake = CommandIntake(Clock())
    flood = [read(intake, b"dance", b"one")[0] for _ in range(1000)]
    assert flood.count("dance") == BURST
    assert read(intake, b"hold", b"other")[0] == "hold"
    assert read(intake, b"hold")[0] == "hold"


def test_invented_senders_share_a_limit_and_are_forgotten() -> None:
    intake = CommandIntake(Clock())
    accepted = [read(intake, b"dance", str(number).encode())[0] for number in range(5000)]
    assert accepted.count("dance") == ALL_SENDERS * BURST
    assert read(intake, b"stop", b"other")[0] == "stop"


def test_too_large_payload_is_not_read() -> None:
    class Unread:
        def __len__(self) -> int:
            return LARGEST_COMMAND_BYTES + 1

        def to_bytes(self) -> bytes:
            raise AssertionError("the payload was read")

    text, reason = CommandIntake(Clock()).read(Unread())
    assert text is None
    assert f"{LARGEST_COMMAND_BYTES + 1} bytes" in reason


@given(st.binary(max_size=200))
def test_any_payload_is_text_or_refused(data: bytes) -> None:
    text, reason = read(CommandIntake(Clock()), data)
    assert (text is None) == bool(reason)
    assert text is None or text.encode() == data
