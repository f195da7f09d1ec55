"""Which queries are commands, and how many of them are taken."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from companion.bus.command_intake import BURST, COMMANDS_PER_S, LARGEST_COMMAND_BYTES, CommandIntake


class Clock:
    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def read(intake: CommandIntake, data: bytes) -> tuple[str | None, str]:
    return intake.read(len(data), lambda: data)


def test_a_burst_is_taken_and_then_only_so_many_a_second() -> None:
    clock = Clock()
    intake = CommandIntake(clock)
    assert all(read(intake, b"hold")[0] == "hold" for _ in range(BURST))
    assert read(intake, b"hold")[0] is None
    taken = 0
    for _ in range(1000):  # ten seconds, a hundred a second
        clock.now_s += 0.01
        taken += read(intake, b"hold")[0] is not None
    assert abs(taken - 10.0 * COMMANDS_PER_S) <= 1
    assert intake.refused == 1001 - taken


def test_stop_is_taken_when_the_others_have_used_up_theirs() -> None:
    intake = CommandIntake(Clock())
    for _ in range(2 * BURST):
        read(intake, b"dance")
    assert read(intake, b"STOP ")[0] == "STOP "


def test_what_is_too_large_is_not_even_read() -> None:
    def payload() -> bytes:
        raise AssertionError("it was read")

    text, why = CommandIntake(Clock()).read(LARGEST_COMMAND_BYTES + 1, payload)
    assert text is None
    assert f"it is {LARGEST_COMMAND_BYTES + 1} bytes long" in why


@given(st.binary(max_size=200))
def test_whatever_comes_is_a_text_or_refused_with_words(data: bytes) -> None:
    text, why = read(CommandIntake(Clock()), data)
    assert (text is None) == bool(why)
    assert text is None or text.encode() == data
