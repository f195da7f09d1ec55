"""What every command is: a word, a meaning, its arguments as fields; and how it is written again."""

from __future__ import annotations

import re
from dataclasses import MISSING, Field, dataclass, fields
from typing import Any, ClassVar, get_args, get_type_hints

from companion.guidance.arguments import Argument, check


@dataclass(frozen=True, slots=True)
class Command:
    """What an operator asks for. `word` is how it is called, `meaning` what it does."""

    word: ClassVar[str]
    meaning: ClassVar[str]

    def __post_init__(self) -> None:
        for field, argument in arguments_of(type(self)):
            value = getattr(self, field.name)
            if value is not None or field.default is not None:
                check(self.word, argument, value, default_of(field))

    @property
    def endless(self) -> bool:
        """It goes on until another command comes."""
        return False

    def __str__(self) -> str:
        words = [self.word]
        for index, (field, argument) in enumerate(arguments_of(type(self))):
            value = getattr(self, field.name)
            if value == default_of(field):
                continue
            written = _quoted(value) if isinstance(value, str) else _plain_number(value)
            # Words without a key may all belong to the first argument.
            required = field.default is MISSING and index == 0
            words.append(written if required else f"{argument.key}={written}")
        return " ".join(words)


def arguments_of(kind: type[Command]) -> list[tuple[Field[Any], Argument]]:
    """Each field of a command and what its argument may be, in their order."""
    hints = get_type_hints(kind, include_extras=True)
    return [(field, get_args(hints[field.name])[1]) for field in fields(kind)]


def default_of(field: Field[Any]) -> Any:
    """What the field is when the argument is left out; None where it may not be."""
    return None if field.default is MISSING else field.default


def _quoted(text: str) -> str:
    if re.fullmatch(r"[\w.:/+-]+", text):
        return text
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'


def _plain_number(value: float) -> str:
    """As people write it, where nothing is lost by that."""
    short = f"{value:g}"
    return short if float(short) == value else repr(value)
