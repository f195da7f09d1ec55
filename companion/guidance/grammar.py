"""The command grammar, shared by command line, zenoh queryable, console and missions.

    command  = word { argument }
    argument = value | key "=" value          values without a key fill the arguments in order
    value    = bare word | "quoted, with spaces"

Class names are read without case, spaces, `_` and `-`: `traffic_light` is "traffic light". In a list of
classes, a comma of a name is `\\,`, which may be left out where the detector's classes are known. A
number may be followed by its unit: `distance=3m`. Every command is a frozen dataclass whose fields declare
key, unit and allowed range, so a command made in code has the same limits, and
`parse(str(command)) == command`.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator, Sequence
from dataclasses import MISSING, dataclass
from typing import Any

from companion.guidance.command import (
    COMMANDS,
    LAST_MARKER_ID,
    Argument,
    ClassName,
    ClassNames,
    Command,
    EnumArgument,
    GrammarError,
    MarkerId,
    Number,
    Points,
    TrackId,
    arguments_of,
    default_of,
    either_of,
    known_class,
    make_stated,
    names_in,
    names_text,
)
from vision.class_names import joined_names, near_names


def parse(text: str, class_names: Sequence[str] | None = None) -> Command:
    """Parse one command.

    Args:
        text: see the module docstring.
        class_names: the detector's classes; names are checked and take the detector's spelling. None: any
            name is accepted.

    Raises:
        GrammarError: one line with the error and what was expected.
    """
    tokens = list(_tokens(text))
    if not tokens:
        raise GrammarError(f"no command; known: {', '.join(COMMANDS)}")
    word = tokens[0].text.lower()
    if word not in COMMANDS or tokens[0].key is not None:
        raise GrammarError(f"unknown command {tokens[0].whole!r}; {near_names(word, list(COMMANDS))}")
    kind = COMMANDS[word]
    values = {
        name: _value(argument, written, class_names)
        for name, argument, written in _assigned(kind, tokens[1:])
    }
    for field, argument in arguments_of(kind):
        if field.default is MISSING and field.name not in values:
            raise GrammarError(f"{word}: {argument.key} is missing ({argument.meaning}): {usage(kind)}")
    either = either_of(kind)
    if either and not any(part.name in values for part, a in arguments_of(kind) if a.key in either):
        raise GrammarError(f"{word}: {' or '.join(either)} is missing: {usage(kind)}")
    return make_stated(kind, values)


def usage(kind: type[Command]) -> str:
    """One line: the syntax of a command with its defaults."""
    words, either = [kind.word], either_of(kind)
    for field, argument in arguments_of(kind):
        default = default_of(field)
        if argument.key in either:
            if argument.key == either[0]:
                others = [f"{key}=…" for key in either[1:]]
                words.append("|".join([argument.key.upper(), *others]))
        elif field.default is MISSING:
            words.append(argument.key.upper())
        elif isinstance(argument, ClassName) and len(words) == 1:
            words.append(f"[{argument.key.upper()}]")
        elif default is None:
            words.append(f"[{argument.key}=…]")
        else:
            words.append(
                f"[{argument.key}={default:g}]"
                if isinstance(default, float)
                else f"[{argument.key}={default}]"
            )
    return " ".join(words)


def summary() -> str:
    """Every command in two lines: syntax and help."""
    lines = [f"  {usage(kind)}\n      {kind.help}" for kind in COMMANDS.values()]
    return "\n".join(["Commands (arguments: `companion describe commands`; plug-ins add more):", *lines])


def describe() -> str:
    """The full help text: every command with arguments, units, ranges and defaults."""
    lines = []
    for kind in COMMANDS.values():
        lines += [usage(kind), f"    {kind.help}"]
        for _, argument in arguments_of(kind):
            allowed = allowed_values(argument)
            lines.append(f"    {argument.key}: {argument.meaning}" + (f" ({allowed})" if allowed else ""))
    return "\n".join(lines)


def markdown() -> str:
    """The same as Markdown tables, one section per command."""
    lines = []
    for kind in COMMANDS.values():
        lines += [
            "",
            f"## {kind.word}",
            "",
            f"{kind.help[0].upper()}{kind.help[1:]}.",
            "",
            f"`{usage(kind)}`",
        ]
        if arguments := arguments_of(kind):
            lines += ["", "| Argument | Meaning | Allowed | Default |", "|---|---|---|---|"]
        for field, argument in arguments:
            default = default_of(field)
            if field.default is MISSING:
                shown = "required"
            elif argument.key in either_of(kind):
                shown = f"{' or '.join(either_of(kind))} required"
            elif default in (None, ""):
                shown = "–"
            else:
                shown = f"{default:g}" if isinstance(default, float) else str(default)
            lines.append(f"| `{argument.key}` | {argument.meaning} | {allowed_values(argument)} | {shown} |")
    return "\n".join(lines).strip() + "\n"


def allowed_values(argument: Argument) -> str:
    """The allowed values in words; empty: any value of the type."""
    match argument:
        case Number(_, unit, low, high):
            return f"{low:g} to {high:g}{' ' + unit if unit else ''}"
        case EnumArgument(_, words):
            return " or ".join(words)
        case TrackId():
            return "a track_id"
        case MarkerId():
            return f"0 to {LAST_MARKER_ID}"
    return ""


def json_schema(class_names: Sequence[str] | None = None) -> dict[str, Any]:
    """The commands as JSON Schema (draft 2020-12): word → object of its arguments by key.

    Args:
        class_names: the detector's classes; None: any class name is allowed.
    """
    commands: dict[str, Any] = {}
    for kind in COMMANDS.values():
        properties: dict[str, Any] = {}
        for field, argument in arguments_of(kind):
            properties[argument.key] = schema = _argument_schema(argument, class_names)
            if (default := default_of(field)) is not None:
                schema["default"] = default
        commands[kind.word] = {
            "type": "object",
            "description": kind.help,
            "properties": properties,
            "required": [a.key for field, a in arguments_of(kind) if field.default is MISSING],
            "additionalProperties": False,
        }
        if either := either_of(kind):
            commands[kind.word]["oneOf"] = [{"required": [key]} for key in either]
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "$defs": commands}


def _argument_schema(argument: Argument, class_names: Sequence[str] | None) -> dict[str, Any]:
    schema: dict[str, Any] = {"type": "string", "description": argument.meaning}
    match argument:
        case Number(_, unit, low, high):
            schema |= {"type": "number", "minimum": low, "maximum": high}
            if unit:
                schema["unit"] = unit
        case TrackId():
            schema |= {"type": "integer", "minimum": 1}
        case MarkerId():
            schema |= {"type": "integer", "minimum": 0, "maximum": LAST_MARKER_ID}
        case EnumArgument(_, words):
            schema["enum"] = list(words)
        case ClassName() if class_names is not None:
            schema["enum"] = list(class_names)
    return schema


@dataclass(frozen=True, slots=True)
class _Token:
    whole: str
    key: str | None
    text: str


_TOKEN = re.compile(
    r"""\s*(?:(?P<key>[A-Za-z_]+)=)?(?:"(?P<quoted>(?:[^"\\]|\\.)*)"|(?P<bare>[^\s"]+))(?=\s|$)"""
)


def _tokens(text: str) -> Iterator[_Token]:
    at, text = 0, text.strip()
    while at < len(text):
        found = _TOKEN.match(text, at)
        if found is None:
            raise GrammarError(f"cannot read {text[at:].strip()!r}: write key=value, and close every quote")
        quoted = found["quoted"]
        value = found["bare"] if quoted is None else re.sub(r"\\(.)", r"\1", quoted)
        yield _Token(found[0].strip(), found["key"], value)
        at = found.end()


def _assigned(kind: type[Command], tokens: list[_Token]) -> Iterator[tuple[str, Argument, str]]:
    """(field name, argument, text) of each token; words of a class name, and points, are joined."""
    arguments = arguments_of(kind)
    by_key = {argument.key: (field.name, argument) for field, argument in arguments}
    seen: set[str] = set()

    def claim(key: str, text: str) -> tuple[str, Argument, str]:
        if key in seen:
            raise GrammarError(f"{kind.word}: {key} is given twice")
        seen.add(key)
        name, argument = by_key[key]
        return name, argument, text

    bare = [token for token in tokens if token.key is None]
    if arguments and isinstance(arguments[0][1], ClassName | Points):
        if bare:
            yield claim(arguments[0][1].key, " ".join(token.text for token in bare))
    else:
        if len(bare) > len(arguments):
            raise GrammarError(
                f"{kind.word}: unexpected argument {bare[len(arguments)].whole!r}: {usage(kind)}"
            )
        for token, (_, argument) in zip(bare, arguments, strict=False):
            yield claim(argument.key, token.text)
    for token in tokens:
        if token.key is None:
            continue
        if token.key not in by_key and (now := kind.renamed.get(token.key)):
            raise GrammarError(
                f"{kind.word}: {token.key}= was renamed to {now}= in version 0.2.0: {usage(kind)}"
            )
        if token.key not in by_key:
            known = near_names(token.key, list(by_key)) if by_key else "the command takes no arguments"
            raise GrammarError(f"{kind.word}: unknown argument {token.key!r}; {known}")
        yield claim(token.key, token.text)


def _value(argument: Argument, text: str, class_names: Sequence[str] | None) -> float | int | str:
    match argument:
        # What is no number stays text, which the command then refuses.
        case Number(unit=unit):
            with contextlib.suppress(ValueError):
                return float(text.removesuffix(unit) if unit else text)
        # At most as many digits as the greatest one has: Python refuses to read thousands.
        case TrackId() | MarkerId() if re.fullmatch(r"[0-9]{1,19}", text):
            return int(text)
        case EnumArgument():
            return text.lower()
        case ClassNames():
            names = names_in(text)
            if class_names is not None:
                names = tuple(known_class(name, class_names) for name in joined_names(names, class_names))
            return names_text(names)
        case ClassName() if class_names is not None:
            return known_class(text, class_names)
    return text
