"""Reads data of peers (the bus, the autopilot's files) within limits: size, depth, kinds of numbers.

A reader gets values that cannot surprise it: no recursion, no NaN or infinity, no integer beyond 64 bits.
"""

from __future__ import annotations

import math
from typing import Any, Protocol

from pydantic_core import from_json

MAX_DEPTH = 32
"""Of nested JSON; the deepest body of a message has 6."""
_LARGEST_INTEGER = 2**64


class PeerDataError(ValueError):
    """Data of a peer cannot be used. The message is one line."""


class Payload(Protocol):
    """Bytes that are not copied yet, such as zenoh's ZBytes."""

    def __len__(self) -> int: ...

    def to_bytes(self) -> bytes:
        """Return a copy."""
        ...


def copy_payload(payload: Payload, largest_bytes: int) -> bytes:
    """Return a copy of what a peer sent. Nothing else copies it. Raises PeerDataError: it is too large."""
    check_size(len(payload), largest_bytes)
    return payload.to_bytes()


def check_size(size: int, largest_bytes: int) -> None:
    """Raise PeerDataError for more bytes than are accepted. Called before the data are copied."""
    if size > largest_bytes:
        raise PeerDataError(f"{size} bytes, at most {largest_bytes} are accepted")


def parse_json(data: bytes) -> Any:
    """Return the value of a JSON text in UTF-8, of which the size was checked.

    Raises:
        PeerDataError: not strict JSON, nested deeper than `MAX_DEPTH`, or with an infinite number or an
            integer of more than 64 bits.
    """
    try:
        value = from_json(data, allow_inf_nan=False)  # refuses 200 levels; without recursion of Python
    except ValueError as error:
        raise PeerDataError(f"not JSON: {error}") from None
    waiting = [(value, 1)]
    while waiting:
        each, depth = waiting.pop()
        if isinstance(each, float) and not math.isfinite(each):
            raise PeerDataError("a number is infinite")
        if isinstance(each, int) and abs(each) > _LARGEST_INTEGER:
            raise PeerDataError("an integer has more than 64 bits")
        if isinstance(each, dict | list):
            if depth > MAX_DEPTH:
                raise PeerDataError(f"nested deeper than {MAX_DEPTH}")
            waiting += [(part, depth + 1) for part in (each.values() if isinstance(each, dict) else each)]
    return value


def parse_object(data: bytes) -> dict[str, Any]:
    """Return a JSON object, as `parse_json`. Raises PeerDataError also for another kind of value."""
    value = parse_json(data)
    if not isinstance(value, dict):
        raise PeerDataError(f"expected a JSON object, got {type(value).__name__}")
    return value
