"""The body of every message as a type: the public contract with subscribers. Fields are added, never changed.

JSON Schema and the tables of `companion describe topics` are made of these types. They cost nothing when a
message is published: a body is a plain dict. Stamps are CLOCK_MONOTONIC nanoseconds of the publishing
computer; frames, quaternions (w, x, y, z) and vectors are as in `companion.vehicle.state`. Boxes are pixels:
left, top, right, bottom.
"""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field

Two = Annotated[list[float], Field(min_length=2, max_length=2)]
Three = Annotated[list[float], Field(min_length=3, max_length=3)]
Four = Annotated[list[float], Field(min_length=4, max_length=4)]
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


def one_of(*words: str) -> Any:
    """Return the field of a word out of these."""
    return Field(json_schema_extra={"enum": list(words)})
