"""Fields of the settings: description of their values, parsing from text, and formatting as TOML."""

from __future__ import annotations

import json
import re
import types
from typing import Any, Literal, Union, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt, MinLen, MultipleOf
from pydantic import StringConstraints
from pydantic.fields import FieldInfo

from companion.settings.section import Section
from companion.settings.settings import CameraSections, Settings
from companion.settings.texts import PATTERN_MEANINGS

_TRUE, _FALSE = ("true", "yes", "on", "1"), ("false", "no", "off", "0")
_UNSET = ("", "none")
_KINDS = {bool: "true or false", int: "a whole number", float: "a number", str: "a text"}
_LONGEST_SHOWN = 80


def sections_of_file() -> dict[str, type[Section]]:
    """Return name → section, in the order of the file; without further cameras."""
    sections = {}
    for name, field in Settings.model_fields.items():
        if name == "cameras":
            continue
        section = field.annotation
        assert isinstance(section, type)
        assert issubclass(section, Section)
        sections[name] = section
    return sections


def fields_of_sections() -> dict[str, dict[str, FieldInfo]]:
    """Return section → name → field, in the order of the file; without further cameras."""
    return {name: section.fields_by_key() for name, section in sections_of_file().items()}


SECTIONS_OF_CAMERA = tuple(CameraSections.model_fields)
"""The sections that every camera has."""


def section_of(table: str) -> str | None:
    """Return the section of a table: `detector`, `cameras.down.detector` → `detector`; else None."""
    match table.split("."):
        case [section] if section in fields_of_sections():
            return section
        case ["cameras", _, section] if section in SECTIONS_OF_CAMERA:
            return section
    return None


def plain_type(field: FieldInfo) -> type:
    """Return bool, int, float, str or tuple."""
    annotation, _ = _without_none(field)
    origin = get_origin(annotation)
    if origin is Literal:
        return str
    if origin is tuple:
        return tuple
    assert isinstance(annotation, type)
    return annotation


def help_line(section: type[Section], name: str) -> str:
    """Return a key's line of help with its range, if any."""
    field = section.model_fields[name]
    annotation, _ = _without_none(field)
    text = section.help_texts().get(name, "")
    kind = get_args(annotation)[0] if get_origin(annotation) is tuple else annotation
    span = " or ".join(get_args(kind)) if get_origin(kind) is Literal else _span(field)
    return f"{text} ({span})" if span else text


def expectation(field: FieldInfo) -> str:
    """Describe the field's values, as text after `must be`."""
    annotation, optional = _without_none(field)
    origin = get_origin(annotation)
    if origin is Literal:
        *choices, last = get_args(annotation)
        words = f"{', '.join(choices)} or {last}"
    elif origin is tuple:
        item = get_args(annotation)[0]
        meaning = _pattern_meaning(get_args(item)[1:]) if str in get_args(item) else None
        if get_origin(item) is Literal:
            meaning = f"one of {', '.join(get_args(item))}"
        words = "a list of texts" + (f", each {meaning}" if meaning else "")
    else:
        words = _pattern_meaning(field.metadata) or _KINDS[annotation]
    span = _span(field)
    return words + (f", {span}" if span else "") + (", or unset" if optional else "")


def expectation_of_key() -> str:
    """Describe the names of cameras, as text after `must be`."""
    return PATTERN_MEANINGS[r"^[A-Za-z0-9][A-Za-z0-9_-]*$"]


def value_from_text(field: FieldInfo, text: str) -> Any:
    """Parse a flag's or variable's text. Raises ValueError; ranges are not checked here."""
    annotation, optional = _without_none(field)
    if optional and text.strip().lower() in _UNSET:
        return None
    kind = plain_type(field)
    if kind is tuple:
        items = [item.strip() for item in text.split(",") if item.strip()]
        return tuple(_item_from_text(get_args(annotation)[0], item) for item in items)
    if kind is bool:
        word = text.strip().lower()
        if word not in _TRUE + _FALSE:
            raise ValueError(text)
        return word in _TRUE
    return kind(text)


def toml_value(value: Any) -> str:
    """Format a value as TOML 1.0."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, str):
        # TOML's basic string equals JSON's, except that DEL must be escaped too.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, tuple | list):
        return f"[{', '.join(toml_value(item) for item in value)}]"
    raise TypeError(f"no TOML for {type(value).__name__}")


def shown(value: Any) -> str:
    """Format a value as in the file, shortened to fit in a message."""
    try:
        text = toml_value(value)
    except TypeError:  # a table or a date, which no field accepts
        text = str(value)
    return text if len(text) <= _LONGEST_SHOWN else f"{text[: _LONGEST_SHOWN - 3]}..."


def _without_none(field: FieldInfo) -> tuple[Any, bool]:
    """Return the annotation without `None`, and whether it had `None`."""
    annotation = field.annotation
    if get_origin(annotation) in (Union, types.UnionType):
        options = get_args(annotation)
        if type(None) in options:
            return next(option for option in options if option is not type(None)), True
    return annotation, False


def _item_from_text(kind: Any, text: str) -> Any:
    # A class is a name or an id.
    return int(text) if int in get_args(kind) and re.fullmatch("[0-9]+", text) else text


def _pattern_meaning(rules: Any) -> str | None:
    for rule in rules:
        if isinstance(rule, StringConstraints) and isinstance(rule.pattern, str):
            return PATTERN_MEANINGS[rule.pattern]
    return None


def _span(field: FieldInfo) -> str:
    """Format the range: `0 to 1` or `above 0, at most 30`; empty without limits."""
    low, high, words = "", "", []
    whole = True
    for rule in field.metadata:
        if isinstance(rule, Ge):
            low = f"{rule.ge}"
        elif isinstance(rule, Gt):
            low, whole = f"above {rule.gt}", False
        elif isinstance(rule, Le):
            high = f"{rule.le}"
        elif isinstance(rule, Lt):
            high, whole = f"below {rule.lt}", False
        elif isinstance(rule, MultipleOf):
            words.append(f"a multiple of {rule.multiple_of}")
        elif isinstance(rule, MinLen):
            words.append("not empty")
    if low and high and whole:
        return ", ".join([f"{low} to {high}", *words])
    low = low if not low or low.startswith("above") else f"at least {low}"
    high = high if not high or high.startswith("below") else f"at most {high}"
    return ", ".join(filter(None, [low, high, *words]))
