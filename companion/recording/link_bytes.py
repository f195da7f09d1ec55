"""The bytes on the autopilot's link as one message of the bus."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import NamedTuple

_FIRST = struct.Struct("<Q")
_PIECE = struct.Struct("<QBI")


class LinkBytes(NamedTuple):
    """A piece of the bytes on the autopilot's link: when (CLOCK_MONOTONIC), whether we sent it."""

    stamp_ns: int
    sent: bool
    data: bytes


def pack_link_bytes(first: int, pieces: list[LinkBytes]) -> bytes:
    """Join pieces into one message. `first`: the number of the first one, counted since the start."""
    parts = [_FIRST.pack(first)]
    for stamp_ns, sent, data in pieces:
        parts += (_PIECE.pack(stamp_ns, sent, len(data)), data)
    return b"".join(parts)


def unpack_link_bytes(message: bytes) -> Iterator[tuple[int, LinkBytes]]:
    """Return the number of each piece, and the piece. Raises ValueError for anything else."""
    try:
        (number,) = _FIRST.unpack_from(message)
        at = _FIRST.size
        while at < len(message):
            stamp_ns, sent, length = _PIECE.unpack_from(message, at)
            at += _PIECE.size + length
            if at > len(message):
                raise ValueError("link bytes end inside a piece")
            yield number, LinkBytes(stamp_ns, bool(sent), message[at - length : at])
            number += 1
    except struct.error as error:
        raise ValueError(f"not link bytes: {error}") from error
