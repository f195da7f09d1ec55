"""Argument types of commands: notation, allowed values, validation."""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from companion.geometry.points import points_from

MOST_POINTS = 500
FARTHEST_M = 5000.0


class GrammarError(ValueError):
    """The text is not a valid command. The message is one line for a person."""


@dataclass(frozen=True, slots=True)
class Number:
    """A number with its unit and allowed range."""

    key: str
    unit: str
    low: float
    high: float
    meaning: str


@dataclass(frozen=True, slots=True)
class ClassName:
    """The name of an object class."""

    key: str
    meaning: str


@dataclass(frozen=True, slots=True)
class EnumArgument:
    """One of a fixed set of words."""

    key: str
    words: tuple[str, ...]
    meaning: str


@dataclass(frozen=True, slots=True)
class Points:
    """A list of points, `north,east` or `north,east,height`, metres from home."""

    key: str
    meaning: str


@dataclass(frozen=True, slots=True)
class FileName:
    """The name of a file, or a path."""

    key: str
    meaning: str


@dataclass(frozen=True, slots=True)
class Word:
    """A free word, such as a vehicle's name."""

    key: str
    meaning: str


@dataclass(frozen=True, slots=True)
class ClassNames:
    """Names of object classes, separated by commas."""

    key: str
    meaning: str


Argument = Number | ClassName | EnumArgument | Points | FileName | ClassNames | Word


def names_in(text: str) -> tuple[str, ...]:
    """Split a comma-separated list of names."""
    return tuple(name.strip() for name in text.split(","))


def known_class(text: str, class_names: Sequence[str]) -> str:
    """The detector's spelling of a class name. Raises GrammarError that suggests the nearest names."""
    if text in class_names:
        return text
    for name in class_names:
        if _plain(name) == _plain(text):
            return name
    raise GrammarError(f"unknown class {text!r}; {nearest(_plain(text), list(class_names))}")


def check(word: str, argument: Argument, value: Any, default: Any) -> None:
    """Validate an argument's value. Raises GrammarError."""
    match argument:
        case Number(key, _, low, high):
            if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
                shown = f"{value:g}" if isinstance(value, float) else repr(value)
                raise GrammarError(f"{word}: {key} must be {range_of(argument)}, got {shown}")
        case EnumArgument(key, words):
            if value not in words:
                raise GrammarError(f"{word}: {key} must be {' or '.join(words)}, got {value!r}")
        case Word(key):
            if not isinstance(value, str) or not re.fullmatch(r"[\w.-]+", value):
                raise GrammarError(f"{word}: {key} must be a word, got {value!r}")
        case Points(key):
            try:
                points = points_from(str(value))
            except ValueError as error:
                raise GrammarError(f"{word}: {key}: {error}") from None
            if not 1 <= len(points) <= MOST_POINTS:
                raise GrammarError(f"{word}: {key} must be 1 to {MOST_POINTS} points, got {len(points)}")
            for point in points:
                if max(map(abs, point[:2])) > FARTHEST_M or not all(1 <= high <= 500 for high in point[2:]):
                    raise GrammarError(
                        f"{word}: {key} must be within {FARTHEST_M:g} m of home and 1 to 500 m high, "
                        f"got {point}"
                    )
        case FileName(key):
            if not isinstance(value, str) or not value.strip() or not value.isprintable():
                raise GrammarError(f"{word}: {key} must be a file name or a path, got {value!r}")
        case ClassNames(key):
            names = names_in(value) if isinstance(value, str) and value.isprintable() else ()
            if not names or not all(names):
                raise GrammarError(f"{word}: {key} must be class names such as person,car, got {value!r}")
        case ClassName(key):
            if value == default:
                return
            if not isinstance(value, str) or not value.strip() or not value.isprintable():
                raise GrammarError(f"{word}: {key} must be a class name, got {value!r}")


def range_of(argument: Number) -> str:
    """The allowed range of a number, in words."""
    return (
        f"a number from {argument.low:g} to {argument.high:g}{' ' + argument.unit if argument.unit else ''}"
    )


def nearest(word: str, known: list[str]) -> str:
    """Suggest known words close to an unknown one, or list the known words."""
    plain = {_plain(name): name for name in known}
    near = [plain[match] for match in difflib.get_close_matches(_plain(word), list(plain), 3, 0.5)]
    if near:
        return f"did you mean {' or '.join(near)}?"
    more = ", …" if len(known) > 12 else ""
    return f"known: {', '.join(known[:12])}{more}"


def _plain(name: str) -> str:
    return " ".join(re.split(r"[\s_-]+", name.strip().lower()))
