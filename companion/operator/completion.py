"""What may follow in a typed command, and its help, from the JSON Schema of the commands.

The schema is that of the running service: it has the commands of its plug-ins and the classes of its model.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

Schema = Mapping[str, Any]

CONSOLE_WORDS: Mapping[str, str] = {
    "status": "the state of the service, in one line",
    "set": "change a limit or what is detected until the next start: set KEY=VALUE; alone: all of them",
    "ask": "a sentence in plain words: ask find a car and circle it",
    "help": "all commands; help COMMAND: its arguments",
    "quit": "end",
}
"""Words of the console itself, with their help."""

_CLASS, _CLASSES = "class", "classes"
_MOST_RECENT = 10


def completions(
    before: str, schema: Schema, *, keys: Sequence[str], recent: Sequence[str], vehicles: Sequence[str] = ()
) -> tuple[int, list[str]]:
    """Return where the word before the cursor begins, and the words that it can become.

    Args:
        before: the line up to the cursor.
        keys: of the settings that `set` changes.
        recent: lines that were typed before, the oldest first.
        vehicles: names that may stand before a command.
    """
    words = before.split(" ")
    fragment, given = words[-1], [word for word in words[:-1] if word]
    named = bool(given) and given[0] in vehicles
    if named:
        del given[0]
    commands = schema.get("$defs", {})
    if not given:
        found = [*commands, *CONSOLE_WORDS, *(() if named else vehicles)]
    elif given[0] == "help":
        found = list(commands)
    elif given[0] == "set":
        found = list(_settings(fragment, keys, _classes_of(commands)))
    elif given[0] in commands:
        command = commands[given[0]]
        found = [*_arguments(command, fragment, given[1:]), *_recent(given[0], recent)]
    else:
        found = list(_recent(given[0], recent))
    unique = dict.fromkeys(word for word in found if word.startswith(fragment) and word != fragment)
    return len(before) - len(fragment), list(unique)


def _arguments(command: Schema, fragment: str, given: Sequence[str]) -> Iterator[str]:
    """Values of the argument whose key was typed, else values of the first one, and keys."""
    properties: Mapping[str, Schema] = command["properties"]
    key, is_value, _ = fragment.partition("=")
    if is_value:
        if key in properties:
            yield from (f"{key}={value}" for value in _values(properties[key]))
        return
    first = next(iter(properties), None)
    bare = [word for word in given if "=" not in word]
    if first is not None and not bare and f"{first}=" not in {word[: len(first) + 1] for word in given}:
        yield from _values(properties[first])
    typed = {word.partition("=")[0] for word in given} | ({first} if bare else set())
    yield from (f"{each}=" for each in properties if each not in typed)


def _values(schema: Schema) -> Iterator[str]:
    yield from (_as_word(str(value)) for value in schema.get("enum", ()))


def _as_word(name: str) -> str:
    """A class name in one word; `_` is read as a space."""
    return name if name.isidentifier() else re.sub(r"[\s,\"]+", "_", name)


def _settings(fragment: str, keys: Sequence[str], classes: Sequence[str]) -> Iterator[str]:
    key, is_value, value = fragment.partition("=")
    if not is_value:
        yield from (f"{each}=" for each in keys)
    elif key.endswith(f".{_CLASSES}"):
        listed = value.rpartition(",")[0]
        begin = f"{key}={listed}," if listed else f"{key}="
        yield from (f"{begin}{_as_word(name)}" for name in classes)


def _classes_of(commands: Schema) -> list[str]:
    """The classes of the model; empty: not known."""
    found = (each["properties"].get(_CLASS, {}).get("enum") for each in commands.values())
    return next(([str(name) for name in names] for names in found if names), [])


def _recent(command: str, lines: Sequence[str]) -> Iterator[str]:
    """Words that were typed after a command, the newest first."""
    found: dict[str, None] = {}
    for line in reversed(lines):
        words = line.split()
        if words[:1] == [command] or words[1:2] == [command]:
            found |= dict.fromkeys(words[1 + (words[0] != command) :])
        if len(found) >= _MOST_RECENT:
            break
    return iter(list(found)[:_MOST_RECENT])


def help_lines(schema: Schema, word: str = "") -> Iterable[str]:
    """Return the help of a command, or a line for each. Raises ValueError: no such command."""
    commands: Mapping[str, Schema] = schema.get("$defs", {})
    if not word:
        meanings = {name: str(each["description"]) for name, each in commands.items()}
        meanings |= CONSOLE_WORDS
        return [f"{name:<16}{meaning}" for name, meaning in meanings.items()]
    if word in CONSOLE_WORDS:
        return [f"{word:<16}{CONSOLE_WORDS[word]}"]
    if word not in commands:
        raise ValueError(f"no command {word!r}; help lists them")
    command = commands[word]
    arguments = [
        f"  {key:<14}{_about(argument, key in command['required'])}"
        for key, argument in command["properties"].items()
    ]
    return [f"{word:<16}{command['description']}", *arguments]


def _about(argument: Schema, required: bool) -> str:
    values = argument.get("enum", ())
    parts = [str(argument["description"])]
    if "maximum" in argument:
        unit = argument.get("unit", "")
        parts.append(f"{argument['minimum']:g} to {argument['maximum']:g}{f' {unit}' if unit else ''}")
    elif values:
        parts.append(", ".join(map(str, values)))
    if argument.get("default") not in (None, ""):
        parts.append(f"default {argument['default']}")
    elif required:
        parts.append("required")
    return "; ".join(parts)
