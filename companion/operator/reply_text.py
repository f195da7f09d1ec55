"""A command's reply for people."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_IN_PROGRESS = "in progress"  # the reason in the reply to an accepted endless command


def reply_text(reply: Mapping[str, Any]) -> str:
    """`done: REASON`, `failed: REASON`, or `accepted, in progress`. reply: `success` and `reason`."""
    if reply["success"] and reply["reason"] == _IN_PROGRESS:
        return f"accepted, {_IN_PROGRESS}"
    return f"{'done' if reply['success'] else 'failed'}: {reply['reason']}"
