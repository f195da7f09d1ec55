"""What every command is: a word, a help text, its arguments as fields, and the behaviour it becomes."""

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
    """What a command may need to become a behaviour.

    Attributes:
        footprint: of the steering camera; None: not known.
        class_names: what the detector knows; None: not known.
        attachment: the lines that came with the command (a mission's text).
        check_requirements: guidance's own; a mission asks it at each of its steps.
    """

    footprint: Footprint | None = None
    class_names: tuple[str, ...] | None = None
    attachment: str = ""
    check_requirements: Callable[[Behaviour], str | None] = lambda behaviour: None


NO_CONTEXT = BuildContext()


@dataclass(frozen=True)
class Command(ABC):
    """What an operator asks for. A subclass is made and registered by `registry.behaviour`.

    Attributes:
        word: how it is called. help: what it does, one line.
        takes_attachment: further lines may come with it.
        renamed: former key of an argument → its key now, for the error message.
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
        """A new behaviour, ready for guidance. Raises GrammarError where the command cannot be flown."""

    @property
    def endless(self) -> bool:
        """It goes on until another command comes."""
        return False

    @property
    def aim(self) -> GimbalAim | None:
        """Where it points the gimbal while the active behaviour goes on; None: it has a behaviour."""
        return None

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
