"""The MAVLink dialect the vehicle speaks: pymavlink's `development`, and PX4's messages that it lacks.

PX4 is built with MAVLink's development dialect. pymavlink's copy of it has CURRENT_MODE (436), but not
LINK_NODE_STATUS, TIME_ESTIMATE_TO_TARGET, EVENT and CURRENT_EVENT_SEQUENCE; those are defined here from the
public XML definitions. A client whose dialect lacks one of them gets UNKNOWN_<id>, as with PX4. With
pymavlink's `common` that includes CURRENT_MODE (id 436, CRC extra 193, payload `<IIB`: custom mode, intended
custom mode, standard mode); `development` and `all` decode it.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import development as dialect

__all__ = [
    "Command",
    "Outgoing",
    "command_of",
    "component_metadata",
    "current_event_sequence",
    "dialect",
    "event",
    "event_error",
    "is_misencoded",
    "link_node_status",
    "parser",
    "protocol_version",
    "time_estimate_to_target",
]

NOT_GIVEN = 2**31 - 1  # x and y of COMMAND_INT
NAN_AS_INTEGER = 0x7FF80000


@dataclass(frozen=True, slots=True)
class Command:
    """A command; of its parameters, 5 and 6 are latitude and longitude in degrees, 7 is AMSL metres."""

    identifier: int
    parameters: tuple[float, float, float, float, float, float, float]
    source_component: int
    source_system: int = 0


def command_of(message: Any) -> Command:
    """The command of a COMMAND_LONG or COMMAND_INT message."""
    if message.get_type() == "COMMAND_INT":
        # both INT32_MAX: "not given", as NaN in COMMAND_LONG. PX4 ignores the frame, z is always AMSL
        given = (message.x, message.y) != (NOT_GIVEN, NOT_GIVEN)
        point = (message.x / 1e7, message.y / 1e7) if given else (math.nan, math.nan)
        tail = (*point, message.z)
    else:
        tail = (message.param5, message.param6, message.param7)
    head = (message.param1, message.param2, message.param3, message.param4)
    return Command(int(message.command), head + tail, message.get_srcComponent(), message.get_srcSystem())


def is_misencoded(message: Any) -> bool:
    """Whether the position of a COMMAND_INT is a float NaN stored as an integer; PX4 denies it."""
    return message.get_type() == "COMMAND_INT" and (message.x, message.y) == (NAN_AS_INTEGER, NAN_AS_INTEGER)


_NODE_STATUS = struct.Struct("<QIIIIIHHHBB")
_TIME_ESTIMATE = struct.Struct("<5i")
_EVENT = struct.Struct("<IIHBBB40s")
_PROTOCOL_VERSION = struct.Struct("<HHH8s8s")
_EVENT_SEQUENCE = struct.Struct("<HB")
_EVENT_ERROR = struct.Struct("<HHBBB")
_COMPONENT_METADATA = struct.Struct("<II100s")


class Outgoing(NamedTuple):
    """A message that the vehicle sends, with the component it comes from.

    `forwarded`: it was received on another link and is sent on byte for byte.
    """

    message: Any
    system: int
    component: int
    forwarded: bool = False

    def pack(self, codec: Any) -> bytes:
        """Its bytes, with the sequence number and checksum of a `parser()` of its link."""
        if self.forwarded:
            return bytes(self.message.get_msgbuf())
        codec.srcSystem, codec.srcComponent = self.system, self.component
        packed: bytes = self.message.pack(codec)
        codec.seq = (codec.seq + 1) % 256
        return packed


class _PackedMessage(dialect.MAVLink_message):  # type: ignore[misc]
    """A message given as its packed payload."""

    def __init__(self, identifier: int, name: str, crc_extra: int, packed: bytes, **fields: Any) -> None:
        super().__init__(identifier, name)
        self._fieldnames = list(fields)
        self._crc_extra = crc_extra
        self._packed = packed
        for field, value in fields.items():
            setattr(self, field, value)

    def pack(self, mav: Any, force_mavlink1: bool = False) -> bytes:
        packed: bytes = self._pack(mav, self._crc_extra, self._packed, force_mavlink1=force_mavlink1)
        return packed


def link_node_status(timestamp_ms: int, sent: int, received: int, lost: int) -> Any:
    """LINK_NODE_STATUS (8): counters of one link."""
    packed = _NODE_STATUS.pack(timestamp_ms, 0, 0, sent, received, lost, 0, 0, 0, 0, 0)
    return _PackedMessage(
        8,
        "LINK_NODE_STATUS",
        117,
        packed,
        timestamp=timestamp_ms,
        messages_sent=sent,
        messages_received=received,
        messages_lost=lost,
    )


def time_estimate_to_target(safe_return_s: int, land_s: int) -> Any:
    """TIME_ESTIMATE_TO_TARGET (380), seconds; -1 where unknown."""
    packed = _TIME_ESTIMATE.pack(safe_return_s, land_s, -1, -1, -1)
    return _PackedMessage(380, "TIME_ESTIMATE_TO_TARGET", 232, packed, safe_return=safe_return_s, land=land_s)


def event(identifier: int, boot_ms: int, sequence: int, log_levels: int, arguments: bytes = b"") -> Any:
    """EVENT (410) of the events interface, to everyone."""
    packed = _EVENT.pack(identifier, boot_ms, sequence, 0, 0, log_levels, arguments)
    return _PackedMessage(
        410,
        "EVENT",
        160,
        packed,
        id=identifier,
        event_time_boot_ms=boot_ms,
        sequence=sequence,
        log_levels=log_levels,
        arguments=arguments,
    )


def current_event_sequence(sequence: int) -> Any:
    """CURRENT_EVENT_SEQUENCE (411): the newest event's number."""
    return _PackedMessage(
        411, "CURRENT_EVENT_SEQUENCE", 106, _EVENT_SEQUENCE.pack(sequence, 0), sequence=sequence, flags=0
    )


def event_error(system: int, component: int, sequence: int, oldest: int) -> Any:
    """RESPONSE_EVENT_ERROR (413): a requested event is no longer stored."""
    return _PackedMessage(
        413,
        "RESPONSE_EVENT_ERROR",
        77,
        _EVENT_ERROR.pack(sequence, oldest, system, component, 0),
        target_system=system,
        target_component=component,
        sequence=sequence,
        sequence_oldest_available=oldest,
        reason=0,
    )


def component_metadata(boot_ms: int, file_crc: int, uri: str) -> Any:
    """COMPONENT_METADATA (397): where the component's general metadata file is, and its checksum."""
    return _PackedMessage(
        397,
        "COMPONENT_METADATA",
        182,
        _COMPONENT_METADATA.pack(boot_ms, file_crc, uri.encode()),
        time_boot_ms=boot_ms,
        file_crc=file_crc,
        uri=uri,
    )


def protocol_version() -> Any:
    """PROTOCOL_VERSION (300): MAVLink 2, 1 understood."""
    return _PackedMessage(
        300,
        "PROTOCOL_VERSION",
        217,
        _PROTOCOL_VERSION.pack(200, 100, 200, b"", b""),
        version=200,
        min_version=100,
        max_version=200,
    )


class _Codec(dialect.MAVLink):  # type: ignore[misc]
    """A codec that can be copied: compiled structures cannot be, and are the same in all of them."""

    def __reduce__(self) -> tuple[Any, ...]:
        state = {name: value for name, value in vars(self).items() if not isinstance(value, struct.Struct)}
        return _Codec, (None,), state


def parser(system: int = 1, component: int = 1) -> Any:
    """A pymavlink codec: reads a stream of bytes without raising on garbage, numbers what it packs."""
    codec = _Codec(None, srcSystem=system, srcComponent=component)
    codec.robust_parsing = True
    return codec
