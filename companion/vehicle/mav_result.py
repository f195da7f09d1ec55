"""MAV_RESULT: the result of a command (MAVLink common)."""

from __future__ import annotations

ACCEPTED, IN_PROGRESS = 0, 5
RESULT_NAMES = {
    0: "accepted",
    1: "temporarily rejected",
    2: "denied",
    3: "unsupported",
    4: "failed",
    5: "in progress",
    6: "cancelled",
}


def result_name(result: int) -> str:
    """Return a MAV_RESULT as text."""
    return RESULT_NAMES.get(result, f"MAV_RESULT {result}")
