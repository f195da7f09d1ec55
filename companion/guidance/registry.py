"""The table of commands, and the decorator that registers those of this package and of plug-ins.

A behaviour is one file. It contains the command (word, arguments with unit, range and help) and the behaviour
that the command builds, and registers itself:

    @behaviour("circle", "fly a circle about the point ahead")
    class Circle(Command):
        radius_m: Annotated[float, Number("radius", "m", 2.0, 50.0, "of the circle")] = 8.0

        def build(self, context: BuildContext) -> Behaviour:
            return CircleBehaviour(self.radius_m)

Grammar, help, documentation and JSON Schema are generated from this table. A file outside this package is
loaded only if the setting `plugins` names it (`companion.plugins`).
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import TypeVar, dataclass_transform, get_args, get_type_hints

from companion.guidance.arguments import Argument
from companion.guidance.command import Command

COMMANDS: dict[str, type[Command]] = {}
"""Word → command, in the order of registration."""

_WORD = re.compile(r"[a-z][a-z0-9-]*")
_Kind = TypeVar("_Kind", bound=Command)


@dataclass_transform(frozen_default=True)
def behaviour(word: str, help_text: str) -> Callable[[type[_Kind]], type[_Kind]]:
    """Turn a command into a frozen dataclass and register it.

    Args:
        word: name in the grammar: lower-case letters, digits and hyphens.
        help_text: one line without a full stop.

    Raises:
        TypeError: a field's type is not annotated with an argument (`Annotated[float, Number(...)]`).
        ValueError: the word has other characters, or is already registered.
    """

    def register(kind: type[_Kind]) -> type[_Kind]:
        if _WORD.fullmatch(word) is None:
            raise ValueError(f"{kind.__qualname__}: a command must be one lower-case word, got {word!r}")
        if (other := COMMANDS.get(word)) is not None and not _same(kind, other):
            raise ValueError(
                f"{kind.__module__}: command {word!r} is already registered by {other.__module__}; "
                "choose another word"
            )
        made = dataclass(frozen=True)(kind)
        hints = get_type_hints(made, include_extras=True)
        for field in fields(made):
            if not any(isinstance(part, Argument) for part in get_args(hints[field.name])[1:2]):
                raise TypeError(f"{kind.__qualname__}.{field.name}: expected Annotated[type, argument]")
        made.word, made.help = word, help_text
        COMMANDS[word] = made
        return made

    return register


def _same(kind: type[Command], other: type[Command]) -> bool:
    """Whether it is the same class, of a module that was imported twice."""
    return (kind.__module__, kind.__qualname__) == (other.__module__, other.__qualname__)
