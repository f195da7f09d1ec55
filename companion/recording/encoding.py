"""Values of dataclasses as JSON, exactly: `decode(encode(value)) == value`, every float bit for bit.

The types of the fields say how a value is written, so no type name of a file is ever looked up or imported.
A finite float is written as Python's shortest text that reads back as the same double; NaN and infinities,
which JSON lacks, are the texts "NaN", "Infinity" and "-Infinity". A value of a union of dataclasses has its
class name under the key "type". A field with the metadata `recorded: False` is left out and gets its default;
one with `recorded: "if set"` is written unless it is None, and is no part of the layout.
"""

from __future__ import annotations

import functools
import hashlib
import json
import math
import types
from collections.abc import Callable, Hashable
from dataclasses import fields, is_dataclass
from enum import Enum
from typing import Any, Literal, NamedTuple, TypeVar, Union, cast, get_args, get_origin, get_type_hints

_Value = TypeVar("_Value")
_TYPE = "type"
_PLAIN = (int, str, bool, types.NoneType)


class DecodeError(ValueError):
    """The data is not a value of the type."""


class _Codec(NamedTuple):
    """`layout` describes the type: two types with the same layout read each other's values."""

    encode: Callable[[Any], Any]
    decode: Callable[[Any], Any]
    layout: str


def encode(kind: type, value: object) -> Any:
    """Return a value of a type as JSON-able data. Raises TypeError, AttributeError for a value of another."""
    return _codec(kind).encode(value)


def dumps(data: Any) -> bytes:
    """Return encoded data as JSON text. Raises ValueError for a float that `encode` has not seen."""
    return json.dumps(data, separators=(",", ":"), allow_nan=False).encode()


def decode(kind: type[_Value], data: Any) -> _Value:
    """Return the value. Raises DecodeError for data of another layout."""
    try:
        value: _Value = _codec(cast(Hashable, kind)).decode(data)
    except (TypeError, ValueError, KeyError, AttributeError) as error:
        raise DecodeError(f"not a {kind.__name__}: {type(error).__name__}: {error}") from error
    return value


def layout_of(*kinds: type) -> str:
    """Return a short text that differs where a field of these types, or of a type in them, differs."""
    text = ";".join(_codec(kind).layout for kind in kinds)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


@functools.cache
def _codec(hint: Any) -> _Codec:
    if hint in _PLAIN:
        return _Codec(_same, _checked(hint), hint.__name__)
    if hint is float:
        return _Codec(_encode_float, _decode_float, "float")
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Literal:
        return _Codec(_same, _one_of(arguments), f"one of {arguments}")
    if origin in (Union, types.UnionType):
        return _union(arguments)
    if origin is tuple:
        return _tuple(arguments)
    if origin is frozenset:
        item = _codec(arguments[0])
        return _Codec(
            lambda value: [item.encode(each) for each in sorted(value)],
            lambda data: frozenset(item.decode(each) for each in data),
            f"set of {item.layout}",
        )
    if isinstance(hint, type) and issubclass(hint, Enum):
        names = ",".join(str(member.value) for member in hint)
        return _Codec(lambda value: value.value, hint, f"enum {names}")
    if isinstance(hint, type) and is_dataclass(hint):
        return _dataclass(hint)
    raise TypeError(f"{hint} cannot be recorded: no encoding for this type")


def _same(value: Any) -> Any:
    return value


def _checked(kind: type) -> Callable[[Any], Any]:
    def check(data: Any) -> Any:
        if type(data) is not kind:
            raise TypeError(f"expected {kind.__name__}, got {data!r}")
        return data

    return check


def _one_of(values: tuple[Any, ...]) -> Callable[[Any], Any]:
    def check(data: Any) -> Any:
        if data not in values:
            raise ValueError(f"expected one of {values}, got {data!r}")
        return data

    return check


def _encode_float(value: float) -> float | str:
    if math.isfinite(value):
        return value
    return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"


def _decode_float(data: Any) -> float:
    # A whole number stays an int: a field of floats may hold one.
    if type(data) in (float, int):
        return data  # type: ignore[no-any-return]
    if data in ("NaN", "Infinity", "-Infinity"):
        return float(data)
    raise TypeError(f"expected a float, got {data!r}")


def _union(kinds: tuple[Any, ...]) -> _Codec:
    several = [kind for kind in kinds if kind is not types.NoneType]
    optional = len(several) < len(kinds)
    if len(several) == 1:
        inner = _codec(several[0])
        return _Codec(
            lambda value: None if value is None else inner.encode(value),
            lambda data: None if data is None else inner.decode(data),
            f"optional {inner.layout}",
        )
    codecs = {kind: _dataclass(kind) for kind in several}  # only dataclasses are distinguished
    by_name = {kind.__name__: codec for kind, codec in codecs.items()}

    def encode_one(value: Any) -> Any:
        if value is None and optional:
            return None
        return {_TYPE: type(value).__name__, **codecs[type(value)].encode(value)}

    def decode_one(data: Any) -> Any:
        if data is None and optional:
            return None
        rest = dict(data)
        return by_name[rest.pop(_TYPE)].decode(rest)

    layout = "|".join(f"{name}={codec.layout}" for name, codec in by_name.items())
    return _Codec(encode_one, decode_one, f"({layout}){'?' if optional else ''}")


def _tuple(arguments: tuple[Any, ...]) -> _Codec:
    if arguments[-1:] == (...,):
        item = _codec(arguments[0])
        return _Codec(
            lambda value: [item.encode(each) for each in value],
            lambda data: tuple(item.decode(each) for each in data),
            f"[{item.layout}]",
        )
    items = [_codec(argument) for argument in arguments]
    return _Codec(
        lambda value: [codec.encode(each) for codec, each in zip(items, value, strict=True)],
        lambda data: tuple(codec.decode(each) for codec, each in zip(items, data, strict=True)),
        f"[{','.join(codec.layout for codec in items)}]",
    )


def _dataclass(kind: Any) -> _Codec:
    if not is_dataclass(kind):
        raise TypeError(f"{kind} cannot be recorded: expected a dataclass")
    hints, make = get_type_hints(kind), cast(Callable[..., Any], kind)
    codecs = [
        (field.name, _codec(hints[field.name]))
        for field in fields(kind)
        if field.metadata.get("recorded", True)
    ]
    names = {name for name, _ in codecs}
    added = {field.name for field in fields(kind) if field.metadata.get("recorded") == "if set"}

    def encode_fields(value: Any) -> dict[str, Any]:
        return {
            name: codec.encode(item)
            for name, codec in codecs
            if (item := getattr(value, name)) is not None or name not in added
        }

    def decode_fields(data: Any) -> Any:
        if not names - added <= data.keys() <= names:
            raise KeyError(f"expected the fields {', '.join(sorted(names))}, got {', '.join(sorted(data))}")
        return make(**{name: codec.decode(data[name]) for name, codec in codecs if name in data})

    layout = ",".join(f"{name}:{codec.layout}" for name, codec in codecs if name not in added)
    return _Codec(encode_fields, decode_fields, f"{{{layout}}}")
