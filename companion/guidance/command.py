"""Base class of commands: a word, a help text, arguments as fields, and the behaviour to build."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import MISSING, Field, dataclass, fields
from typing import Any, ClassVar, get_args, get_type_hints

from companion.guidance.arguments import Argument, check
from companion.guidance.behaviour import Behaviour
from companion.guidance.search_pattern import Footprint
from companion.vehicle.gimbal import GimbalAim


@dataclass(frozen=True, slots=True)
class BuildContext:
    """What a command may need to build its behaviour.

    Attributes:
        footprint: of the steering camera; None: not known.
        class_names: the detector's classes; None: not known.
        attachment: lines sent along with the command (a mission's text).
        check_requirements: `Guidance.check_requirements`; a mission calls it at each step.
    """

    footprint: Footprint | None = None
    class_names: tuple[str, ...] | None = None
    attachment: str = ""
    check_requirements: Callable[[Behaviour], str | None] = lambda behaviour: None


NO_CONTEXT = BuildContext()


@dataclass(frozen=True)
class Command(ABC):
    """An operator's command. A subclass is turned into a dataclass and registered by `registry.behaviour`.

    Attributes:
        word: name in the grammar. help: one line.
        takes_attachment: further lines may be sent along.
        renamed: former key of an argument → its current key, for the error message.
    """

    word: ClassVar[str]
    help: ClassVar[str]
    takes_attachment: ClassVar[bool] = False
    renamed: ClassVar[Mapping[str, str]] = {}

    def __post_init__(self) -> None:
        for field, argument in arguments_of(type(self)):
            value = getattr(self, field.name)
            if value is not None or field.default is not None:
                check(self.word, argument, value, default_of(field))

    @abstractmethod
    def build(self, context: BuildContext) -> Behaviour:
        """Build the behaviour. Raises GrammarError where the command cannot be flown."""

    @property
    def endless(self) -> bool:
        """Whether it runs until another command comes."""
        return False

    @property
    def aim(self) -> GimbalAim | None:
        """For a command that only points the gimbal, where to; None: the command has a behaviour."""
        return None

    def __str__(self) -> str:
        words = [self.word]
        for index, (field, argument) in enumerate(arguments_of(type(self))):
            value = getattr(self, field.name)
            if value == default_of(field):
                continue
            written = _quoted(value) if isinstance(value, str) else _plain_number(value)
            # All words without a key may belong to the first argument.
            required = field.default is MISSING and index == 0
            words.append(written if required else f"{argument.key}={written}")
        return " ".join(words)


def arguments_of(kind: type[Command]) -> list[tuple[Field[Any], Argument]]:
    """The fields of a command with their argument types, in order."""
    hints = get_type_hints(kind, include_extras=True)
    return [(field, get_args(hints[field.name])[1]) for field in fields(kind)]


def default_of(field: Field[Any]) -> Any:
    """The default of a field; None where the argument is required."""
    return None if field.default is MISSING else field.default


def _quoted(text: str) -> str:
    if re.fullmatch(r"[\w.:/+-]+", text):
        return text
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'


def _plain_number(value: float) -> str:
    """The shortest notation that keeps the value."""
    short = f"{value:g}"
    return short if float(short) == value else repr(value)
