"""A command's reply for people."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

ENDED_BY_STOP = "ended by stop"  # the answer to a sentence that a stop ended


def printable(text: str, kept: str = "") -> str:
    """Replace control characters, which a text of the autopilot could send to a terminal, but those kept."""
    return "".join(each if each.isprintable() or each in kept else "?" for each in text)


def reply_text(reply: Mapping[str, Any]) -> str:
    """`done: REASON`, `failed: REASON`, or `accepted, in progress`; `printable` but for the ends of lines.

    reply: `success`, `reason`, `state`.
    """
    reason = printable(reply["reason"], "\n")
    if reply.get("state") == "in_progress":
        return f"accepted, {reason}"
    return f"{'done' if reply['success'] else 'failed'}: {reason}"
