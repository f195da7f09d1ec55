"""What a service tells people of itself."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Event:
    """Something a person should know. `level` is info, warning or error."""

    stamp_ns: int
    level: str
    text: str
