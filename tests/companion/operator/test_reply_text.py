"""A command's reply for people."""

from __future__ import annotations

import pytest

from companion.operator.reply_text import reply_text


@pytest.mark.parametrize(
    ("success", "reason", "text"),
    [
        (True, "arrived", "done: arrived"),
        (False, "no position", "failed: no position"),
        (True, "in progress", "accepted, in progress"),
        (
            True,
            "in progress; took over from position mode",
            "accepted, in progress; took over from position mode",
        ),
        (False, "in progress elsewhere", "failed: in progress elsewhere"),
    ],
)
def test_reply_says_result_and_takeover(success: bool, reason: str, text: str) -> None:
    state = "in_progress" if text.startswith("accepted") else "ended"
    assert reply_text({"state": state, "success": success, "reason": reason}) == text


def test_control_characters_of_a_reason_are_replaced() -> None:
    reply = {"success": False, "reason": "\x1b]0;title\x07no\nposition\x9b2J"}
    assert reply_text(reply) == "failed: ?]0;title?no\nposition?2J"
