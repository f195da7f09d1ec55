"""The grammar of faults, for the command line, the console, zenoh and Python.

    FAULT [VALUE…] [OPTION=VALUE…] [at=SECONDS] [for=SECONDS] [seed=NUMBER]

Words in any order: `link_delay 0.2`, `at=20 motor_failure 2`, `packet_loss 0.3 link=onboard way=out for=10`.
`at` is in simulated seconds since the simulator started; without it a fault begins at once. Without `for`
it lasts until ended. Other commands are `list`, `help [FAULT]` and `end NUMBER|FAULT|all`.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any


class FaultError(ValueError):
    """An invalid fault or an invalid command. The message is one line for the user."""


@dataclass(frozen=True, slots=True)
class Field:
    """One value of a fault.

    Attributes:
        read: parses its text; raises ValueError with what was expected.
        default: its value if not given; `REQUIRED` if it must be.
    """

    name: str
    read: Callable[[str], Any]
    default: Any
    meaning: str


REQUIRED: Any = object()


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of fault: its name, its values in order, one line about its effect."""

    name: str
    summary: str
    fields: tuple[Field, ...] = ()
    momentary: bool = False  # has no duration

    @property
    def usage(self) -> str:
        words = [self.name]
        for one in self.fields:
            optional = f"[{one.name}]" if one.default is None else f"[{one.name}={_shown(one.default)}]"
            words.append(one.name.upper() if one.default is REQUIRED else optional)
        return " ".join(words)


@dataclass(frozen=True, slots=True)
class Fault:
    """A parsed fault.

    Attributes:
        values: by field name, complete.
        at_s: when it begins, simulated seconds since the start; None: now.
        duration_s: None: until ended.
        seed: of its random numbers; None: derived from the vehicle's seed and its number.
    """

    kind: Kind
    values: Mapping[str, Any] = field(default_factory=dict)
    at_s: float | None = None
    duration_s: float | None = None
    seed: int | None = None

    def __str__(self) -> str:
        words = [self.kind.name]
        for one in self.kind.fields:
            value = self.values[one.name]
            if one.default is REQUIRED:
                words.append(_shown(value))
            elif value != one.default:
                words.append(f"{one.name}={_shown(value)}")
        if self.duration_s is not None:
            words.append(f"for={self.duration_s:g}")
        return " ".join(words)


def parse_fault(text: str, kinds: Mapping[str, Kind]) -> Fault:
    """Parse a fault. Raises FaultError."""
    words = text.split()
    plain = [word for word in words if "=" not in word]
    if not plain:
        raise FaultError(f"{text[:40]!r} names no fault; {_all(kinds)}")
    name, *positional = plain
    kind = kind_named(name, kinds)
    given: dict[str, str] = {}
    for word in words:
        key, equals, value = word.partition("=")
        if equals:
            if key in given:
                raise FaultError(f"{name}: {key[:40]} is given twice")
            given[key] = value
    return make_fault(kind, positional, given)


def kind_named(name: str, kinds: Mapping[str, Kind]) -> Kind:
    """Return the kind of a name. Raises FaultError."""
    if (kind := kinds.get(name)) is not None:
        return kind
    near = difflib.get_close_matches(name, kinds, 1)
    hint = f"did you mean {near[0]}?" if near else _all(kinds)
    raise FaultError(f"there is no fault {name[:40]!r}; {hint}")


def _all(kinds: Mapping[str, Kind]) -> str:
    """Where all kinds are, which are too many for an error."""
    return f"the console's `help` lists all {len(kinds)}, as does docs/faults.md"


def make_fault(kind: Kind, positional: list[str], given: Mapping[str, str]) -> Fault:
    """Build a fault from positional and named values, all as text. Raises FaultError."""
    named = dict(given)
    at_s = _timing(kind, named, "at", _seconds)
    duration_s = _timing(kind, named, "for", positive)
    seed = _timing(kind, named, "seed", whole(-(2**63), 2**63))
    if duration_s is not None and kind.momentary:
        raise FaultError(f"{kind.name} has no duration; leave for= out")
    values: dict[str, Any] = {}
    left = list(positional)
    for one in kind.fields:
        if one.name in named:
            text = named.pop(one.name)
        elif left:
            text = left.pop(0)
        elif one.default is REQUIRED:
            raise FaultError(f"{kind.name} needs {one.name}, {one.meaning}; usage: {kind.usage}")
        else:
            values[one.name] = one.default
            continue
        values[one.name] = _read(kind, one.name, one.read, text)
    if left or named:
        stray = left[0] if left else f"{next(iter(named))[:39]}="
        raise FaultError(
            f"{kind.name}: unexpected {stray[:40]!r}; usage: {kind.usage} [at=S] [for=S] [seed=N]"
        )
    return Fault(kind, values, at_s, duration_s, seed)


def _timing(kind: Kind, named: dict[str, str], name: str, read: Callable[[str], Any]) -> Any:
    return _read(kind, name, read, named.pop(name)) if name in named else None


def _read(kind: Kind, name: str, read: Callable[[str], Any], text: str) -> Any:
    try:
        return read(text)
    except ValueError as error:
        raise FaultError(f"{kind.name}: {name}={text[:40]}: expected {error}") from None


def _shown(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


# ---- parsers of values: each takes a text and raises ValueError with what was expected


def number(low: float, high: float, unit: str = "") -> Callable[[str], float]:
    """A finite number within limits."""
    return partial(_number, low, high, unit)


def _number(low: float, high: float, unit: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not low <= value <= high or math.isinf(value):
        raise ValueError(f"a number, {low:g} to {high:g}{f' {unit}' if unit else ''}")
    return value


def whole(low: int, high: int) -> Callable[[str], int]:
    """A whole number within limits."""
    return partial(_whole, low, high)


def _whole(low: int, high: int, text: str) -> int:
    try:
        value = int(text)
    except ValueError:
        value = low - 1
    if not low <= value <= high:
        raise ValueError(f"a whole number, {low} to {high}")
    return value


def choice(*words: str) -> Callable[[str], str]:
    """One of some words, in any case."""
    return partial(_choice, words)


def _choice(words: tuple[str, ...], text: str) -> str:
    for word in words:
        if word.lower() == text.lower():
            return word
    raise ValueError(f"one of {', '.join(words)}")


probability = number(0.0, 1.0)
_seconds = number(0.0, 1e6, "s")


def positive(text: str) -> float:
    """A duration above zero."""
    value = number(0.0, 1e6, "s")(text)
    if value <= 0.0:
        raise ValueError("a number above 0 s")
    return value
