"""Texts of PX4's events, from MAVLink's events metadata (https://mavlink.io/en/services/events.html)."""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Mapping
from typing import Any, NamedTuple

from companion.vehicle.report import ALL_MODES, Report

_LAYOUTS = {
    "uint8_t": "<B",
    "int8_t": "<b",
    "uint16_t": "<H",
    "int16_t": "<h",
    "uint32_t": "<I",
    "int32_t": "<i",
    "uint64_t": "<Q",
    "int64_t": "<q",
    "float": "<f",
}
# {argument, from 1}{decimals}{unit}; literal braces are escaped.
_ARGUMENT = re.compile(r"(?<!\\)\{(\d+)(?::\.(\d+))?([^}]*)\}")
_TAG = re.compile(r"(?<!\\)<[^>]*>")
_UNITS = {"m": " m", "m_v": " m", "m^2": " m²", "m/s": " m/s", "C": " °C"}
_MODES_TYPE = "navigation_mode_group_t"
_MAX_LEVEL = 7  # MAV_SEVERITY_DEBUG; above it are messages between machines


class Event(NamedTuple):
    """The fields of EVENT (410). `log_levels`: external level in the lower 4 bits; `arguments`: 40 bytes."""

    identifier: int
    sequence: int
    log_levels: int
    arguments: bytes


class EventCatalogue:
    """The events of one autopilot's metadata.

    Args:
        metadata: the events JSON; None: not available, so events are reported by number.

    Raises:
        ValueError: `metadata` is not events JSON.
    """

    def __init__(self, metadata: bytes | None) -> None:
        self._events: dict[int, tuple[str, Mapping[str, Any]]] = {}
        self._enums: dict[str, Mapping[str, Any]] = {}
        if metadata is None:
            return
        try:
            components = json.loads(metadata)["components"]
            for number, component in components.items():
                self._enums |= {
                    f"{component['namespace']}::{name}": enum
                    for name, enum in component.get("enums", {}).items()
                }
                for group, content in component.get("event_groups", {}).items():
                    for identifier, event in content.get("events", {}).items():
                        self._events[int(number) << 24 | int(identifier)] = (group, event)
        except (KeyError, TypeError, AttributeError, UnicodeDecodeError) as error:
            raise ValueError(f"not events metadata: {type(error).__name__}: {error}") from error

    def report(self, event: Event, now_ns: int) -> Report | None:
        """Convert an event to a report. None for summaries and for levels beyond debug."""
        level = event.log_levels & 0x0F
        group, known = self._events.get(event.identifier, ("", {}))
        if level > _MAX_LEVEL or known.get("type") == "summary":
            return None
        if "message" not in known:
            return Report(now_ns, level, f"event {event.identifier:#010x} (not in the metadata)")
        arguments = known.get("arguments", ())
        values = self._values(arguments, event.arguments)
        of_modes = bool(arguments) and arguments[0]["type"].endswith(_MODES_TYPE)
        modes = int.from_bytes(event.arguments[:4], "little") if of_modes else ALL_MODES

        def formatted(match: re.Match[str]) -> str:
            number = int(match[1]) - 1
            return _value(values[number], match[2], match[3]) if number < len(values) else "?"

        text = _ARGUMENT.sub(formatted, _TAG.sub("", str(known["message"])))
        return Report(
            now_ns, level, re.sub(r"\\(.)", r"\1", text).strip(), group, str(known.get("name", "")), modes
        )

    def _values(self, arguments: Any, packed: bytes) -> list[str | float]:
        """Decode the arguments in order, up to the first that the metadata does not describe."""
        values: list[str | float] = []
        offset = 0
        for argument in arguments:
            enum = self._enums.get(argument["type"]) or self._enums.get(f"px4::{argument['type']}")
            layout = _LAYOUTS.get(argument["type"] if enum is None else enum["type"])
            if layout is None or offset + struct.calcsize(layout) > len(packed):
                break
            (number,) = struct.unpack_from(layout, packed, offset)
            offset += struct.calcsize(layout)
            values.append(number if enum is None else _named(enum, number))
        return values


def _named(enum: Mapping[str, Any], number: int) -> str:
    entries = {int(value): entry["description"] or entry["name"] for value, entry in enum["entries"].items()}
    if not enum.get("is_bitfield"):
        return str(entries.get(number, number))
    return ", ".join(words for bit, words in sorted(entries.items()) if number & bit) or "none"


def _value(value: str | float, decimals: str | None, unit: str) -> str:
    words = f"{value:.{decimals}f}" if decimals is not None and not isinstance(value, str) else f"{value}"
    return words + _UNITS.get(unit, unit)
