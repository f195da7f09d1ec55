"""ROS 2 messages as bytes and back: CDR of OMG's DDSI-RTPS, as every version of ROS 2 sends it (XCDR1).

A message is a mapping of its fields' names to values: numbers, strings, mappings for messages, sequences.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

from companion.ros2.definitions import RosField, fields_of

# The encapsulation of DDSI-RTPS 10.2: its kind, and two bytes of options, which CDR does not use.
_HEADER = b"\x00\x01\x00\x00"
_ORDERS = {b"\x00\x00": ">", b"\x00\x01": "<"}
# A payload may be filled up to a multiple of four.
_MOST_PADDING = 3
_BYTES = ("uint8", "byte")
_COUNT = "I"
_SIZES = {code: struct.calcsize("<" + code) for code in "bBhHiIqQfd?"}


def encode(type_name: str, value: Mapping[str, Any]) -> bytes:
    """Return a message as little-endian CDR with its encapsulation.

    Args:
        type_name: as `std_msgs/msg/Header`, of `DEFINITIONS`.
        value: of each field; a missing one and None become the default of ROS. `uint8[]` is any bytes.

    Raises:
        ValueError: an unknown type or field, or a value that its field cannot have.
    """
    output = bytearray(_HEADER)
    try:
        _write(type_name, value, output)
    except (ArithmeticError, AttributeError, TypeError, ValueError, struct.error) as error:
        raise ValueError(f"{type_name} cannot be encoded: {error}") from error
    return bytes(output)


def decode(type_name: str, payload: bytes | memoryview) -> dict[str, Any]:
    """Return the message in CDR of either byte order.

    `uint8[]` becomes a read-only view of the payload, without a copy; other sequences become tuples.

    Raises:
        ValueError: an unknown type; the payload is no CDR, or not of this type: it is too short or too long,
            or a text is not valid.
    """
    view = memoryview(payload).cast("B").toreadonly()
    order = _ORDERS.get(bytes(view[:2]))
    if order is None or len(view) < len(_HEADER):
        raise ValueError(f"{type_name}: begins with {bytes(view[:4]).hex()!r}, expected CDR (0000 or 0001)")
    source = _Input(view[len(_HEADER) :], order)
    try:
        value = _read(type_name, source)
    except ValueError as error:
        raise ValueError(f"{type_name}: {error}; is it of another version?") from error
    if (rest := len(source.view) - source.offset) > _MOST_PADDING:
        raise ValueError(f"{type_name}: {rest} bytes more than the type has; is it of another version?")
    return value


@cache
def _names(type_name: str) -> frozenset[str]:
    return frozenset(field.name for field in fields_of(type_name))


def _write(type_name: str, value: Mapping[str, Any], output: bytearray) -> None:
    if not value.keys() <= _names(type_name):
        unknown = ", ".join(map(repr, value.keys() - _names(type_name)))
        raise ValueError(f"{type_name} has no field {unknown}: {', '.join(sorted(_names(type_name)))}")
    for field in fields_of(type_name):
        item = value.get(field.name)
        if field.length is None:
            _write_one(field, item, output)
        else:
            _write_many(field, (field.default,) * field.length if item is None else item, output)


def _write_one(field: RosField, item: Any, output: bytearray) -> None:
    if field.code:
        _write_numbers(field.code, (field.default if item is None else item,), output)
    elif field.nested:
        _write(field.type_name, {} if item is None else item, output)
    else:
        text = ("" if item is None else item).encode() + b"\0"
        _write_numbers(_COUNT, (len(text),), output)
        output += text


def _write_many(field: RosField, items: Any, output: bytearray) -> None:
    if field.length == 0:
        _write_numbers(_COUNT, (len(items),), output)
    elif len(items) != field.length:
        raise ValueError(f"{field.name} has {len(items)} values, expected {field.length}")
    if field.type_name in _BYTES:
        output += bytes(items) if isinstance(items, tuple | list) else items
    elif field.code:
        _write_numbers(field.code, items, output)
    else:
        for each in items:
            _write_one(field, each, output)


def _write_numbers(code: str, values: Sequence[Any], output: bytearray) -> None:
    """Append numbers, aligned to their size; nothing, and no padding, for none. `code`: of `struct`."""
    if len(values):
        output += bytes((len(_HEADER) - len(output)) % _SIZES[code])
        output += struct.pack(f"<{len(values)}{code}", *values)


class _Input:
    """The bytes behind the encapsulation, from which alignment counts, and how far they are read."""

    def __init__(self, view: memoryview, order: str) -> None:
        self.view = view
        self.order = order
        self.offset = 0

    def take(self, size: int, what: str) -> memoryview:
        part = self.view[self.offset : self.offset + size]
        if len(part) < size:
            raise ValueError(f"{what} needs {size} bytes, {len(part)} are left")
        self.offset += size
        return part

    def numbers(self, code: str, count: int, what: str) -> tuple[Any, ...]:
        if count == 0:
            return ()
        size = _SIZES[code]
        self.take(-self.offset % size, what)
        data = self.take(count * size, what)
        return struct.unpack(f"{self.order}{count}{code}", data)


def _read(type_name: str, source: _Input) -> dict[str, Any]:
    return {
        field.name: _read_one(field, source) if field.length is None else _read_many(field, source)
        for field in fields_of(type_name)
    }


def _read_one(field: RosField, source: _Input) -> Any:
    if field.code:
        return source.numbers(field.code, 1, field.name)[0]
    if field.nested:
        return _read(field.type_name, source)
    (size,) = source.numbers(_COUNT, 1, field.name)
    text = bytes(source.take(size, field.name))
    # Some writers send an empty text without its final zero.
    if text and text[-1]:
        raise ValueError(f"{field.name} does not end with a zero byte")
    return text[:-1].decode()


def _read_many(field: RosField, source: _Input) -> Any:
    count = field.length or source.numbers(_COUNT, 1, field.name)[0]
    if field.type_name in _BYTES:
        return source.take(count, field.name)
    if field.code:
        return source.numbers(field.code, count, field.name)
    # Each element takes bytes, so the payload bounds how many are made.
    return tuple(_read_one(field, source) for _ in range(count))
