"""What a pilot tells of the behaviours it runs."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from companion.guidance.behaviour import Outcome


class PilotEventKind(StrEnum):
    """What can happen to a behaviour."""

    STARTED = "started"
    ENGAGED = "engaged"  # the vehicle shows OFFBOARD and flies our setpoints
    NOTED = "noted"  # something on the way that people should know
    ENDED = "ended"
    REFUSED = "refused"
    LOST = "lost"  # command was taken from us
    BLIND = "blind"  # it brakes for want of depth
    BATTERY = "battery"  # too little charge to fly on, or none is told


@dataclass(frozen=True, slots=True)
class PilotEvent:
    """One line for the record. `behaviour` is its word; `outcome` is there when it ended or was refused."""

    stamp_ns: int
    kind: PilotEventKind
    behaviour: str
    message: str
    outcome: Outcome | None = None
