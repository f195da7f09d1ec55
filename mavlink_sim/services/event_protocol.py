"""MAVLink's events interface (https://mavlink.io/en/services/events.html): send, store and repeat events."""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Protocol

from pymavlink.generator.mavcrc import x25crc

from mavlink_sim.wire.links import Link
from mavlink_sim.wire.messages import event, event_error

EVENTS_KEPT = 20  # the size of PX4's event buffer
REQUEST_EVENT_CRC_EXTRA = 33
_REQUEST = struct.Struct("<HHBB")


@dataclass(frozen=True, slots=True)
class Event:
    """One event as it was first sent."""

    sequence: int
    identifier: int
    boot_ms: int
    log_levels: int
    arguments: bytes


class EventBuffer:
    """The newest events, in order. `sequence` is the newest one's number, 0 before the first."""

    def __init__(self) -> None:
        self.sequence = 0
        self._kept: deque[Event] = deque(maxlen=EVENTS_KEPT)

    def emit(
        self, links: Iterable[Link], identifier: int, boot_ms: int, levels: int, arguments: bytes
    ) -> None:
        """Number an event, store it, send it on every link."""
        self.sequence = (self.sequence + 1) & 0xFFFF
        kept = Event(self.sequence, identifier, boot_ms, levels, arguments)
        self._kept.append(kept)
        for link in links:
            _send(link, kept)

    def find(self, sequence: int) -> Event | None:
        return next((kept for kept in self._kept if kept.sequence == sequence), None)

    def oldest_after(self, sequence: int) -> int:
        """The number of the first stored event after this one, the newest number without one."""
        ahead = [(kept.sequence - sequence) & 0xFFFF for kept in self._kept if kept.sequence != sequence]
        return (sequence + min(ahead)) & 0xFFFF if ahead else self.sequence


class EventContext(Protocol):
    """What the events interface uses of a vehicle. `events`: the newest ones."""

    system_id: int
    events: EventBuffer


def request(vehicle: EventContext, link: Link, message: Any) -> None:
    """REQUEST_EVENT, unknown to pymavlink's dialects: repeat the events, or send an error for each missing
    one.

    The range may wrap at 65535. The answers end with the first gap longer than the buffer.
    """
    frame = bytes(message.get_msgbuf())
    fields = _request_of(frame)
    if fields is None:
        return
    first, last, system, component = fields
    if system not in (0, vehicle.system_id) or component not in (0, 1):
        return
    source = (frame[5], frame[6])  # pymavlink does not have the source of an unknown message
    missing = 0
    for ahead in range(((last - first) & 0xFFFF) + 1):
        sequence = (first + ahead) & 0xFFFF
        kept = vehicle.events.find(sequence)
        if kept is not None:
            _send(link, kept)
            continue
        missing += 1
        link.send(event_error(*source, sequence, vehicle.events.oldest_after(sequence)))
        if missing > EVENTS_KEPT:
            return


def _send(link: Link, kept: Event) -> None:
    link.send(event(kept.identifier, kept.boot_ms, kept.sequence, kept.log_levels, kept.arguments))


def _request_of(frame: bytes) -> tuple[int, int, int, int] | None:
    """(first, last, target system, target component); None where the checksum is wrong."""
    if len(frame) < 12 or frame[0] != 0xFD:
        return None
    length = frame[1]
    if len(frame) < 12 + length:
        return None
    crc = x25crc(frame[1 : 10 + length])
    crc.accumulate([REQUEST_EVENT_CRC_EXTRA])
    if crc.crc != int.from_bytes(frame[10 + length : 12 + length], "little"):
        return None
    first, last, system, component = _REQUEST.unpack(frame[10 : 10 + length].ljust(_REQUEST.size, b"\0")[:6])
    return first, last, system, component
