"""Commands: the types of their arguments, the base class, and the table that `behaviour` adds them to.

A behaviour is one file. It holds its command (word, arguments with unit, range and help) and the behaviour
that the command becomes, and registers itself:

    @behaviour("circle", "fly a circle about the point ahead")
    class Circle(Command):
        radius_m: Annotated[float, Number("radius", "m", 2.0, 50.0, "of the circle")] = 8.0

        def build(self, context: BuildContext) -> Behaviour:
            return CircleBehaviour(self.radius_m)

A field `subject: Subject` gives the arguments `class`, `track` and `marker`, of which exactly one must be
given (`Subject | None = None`: at most one).

Grammar, help, documentation and JSON Schema are generated from the table. A file outside of this package is
loaded only if the setting `plugins.modules` names it (`companion.plugins`).
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, replace
from functools import cache
from typing import Any, ClassVar, NamedTuple, TypeVar, dataclass_transform, get_args, get_type_hints

from companion.geometry.points import points_from
from companion.guidance.behaviour import Behaviour
from companion.guidance.objects.tracked_object import GimbalGoal, Subject
from companion.guidance.search_pattern import Footprint
from vision.class_names import class_named
from vision.registry import RegistrationError

MOST_POINTS = 500
FARTHEST_M = 5000.0
LAST_TRACK_ID = 2**63 - 1  # of an int64
LAST_MARKER_ID = 1023
MARKER_ID_TEXT = "the id of a marker, a whole number from 0 to 1023"
TRACK_ID_TEXT = "a track_id of the topic detections, a whole number from 1"


class GrammarError(ValueError):
    """The text is not a valid command. The message is one line for a person."""


@dataclass(frozen=True, slots=True)
class Number:
    """A number with its unit and allowed range.

    >>> from typing import Annotated
    >>> from companion import Number
    >>> Radius = Annotated[float, Number("radius", "m", 2.0, 50.0, "of the circle")]  # the type of a field
    >>> Radius.__metadata__[0].high
    50.0
    """

    key: str
    unit: str
    low: float
    high: float
    meaning: str


@dataclass(frozen=True, slots=True)
class EnumArgument:
    """One of a fixed set of words.

    >>> from typing import Annotated
    >>> from companion import EnumArgument
    >>> Side = Annotated[str, EnumArgument("side", ("left", "right"), "where to pass")]  # the type of a field
    >>> Side.__metadata__[0].words
    ('left', 'right')
    """

    key: str
    words: tuple[str, ...]
    meaning: str


@dataclass(frozen=True, slots=True)
class Text:
    """An argument that is read as it is written."""

    key: str
    meaning: str


class ClassName(Text):
    """The name of an object class.

    >>> from typing import Annotated
    >>> from companion import ClassName
    >>> Target = Annotated[str, ClassName("class", "of the object")]  # the type of a command's field
    >>> Target.__metadata__[0].key
    'class'
    """


class ClassNames(Text):
    """Names of object classes, separated by commas."""


class Points(Text):
    """A list of points, `north,east` or `north,east,height`, metres from home."""


class FileName(Text):
    """The name of a file, or a path."""


class Word(Text):
    """A free word, such as a vehicle's name."""


class TrackId(Text):
    """The `track_id` of an object in the steering camera's detections."""


class MarkerId(Text):
    """The id of a printed marker."""


Argument = Number | EnumArgument | Text


def names_in(text: str) -> tuple[str, ...]:
    """Split a comma-separated list of names; `\\,` is a comma of a name."""
    return tuple(name.replace("\\,", ",").strip() for name in re.split(r"(?<!\\),", text))


def names_text(names: Iterable[str]) -> str:
    """A list of names, for `names_in`."""
    return ",".join(name.replace(",", "\\,") for name in names)


def known_class(text: str, class_names: Sequence[str]) -> str:
    """The detector's spelling of a class name. Raises GrammarError that suggests the nearest names."""
    try:
        return class_named(text, class_names)
    except ValueError as error:
        # It could be an object's track, or a class's number in the model.
        hint = "; a number is no class here: track=N is an object" if text.isdecimal() else ""
        raise GrammarError(f"{error}{hint}") from None


def check(word: str, argument: Argument, value: Any, default: Any) -> None:
    """Validate an argument's value. Raises GrammarError."""
    match argument:
        case Number(key, _, low, high):
            if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
                shown = f"{value:g}" if isinstance(value, float) else repr(value)
                raise GrammarError(f"{word}: {key} must be {range_of(argument)}, got {shown}")
        case TrackId(key):
            if not isinstance(value, int) or isinstance(value, bool) or not 1 <= value <= LAST_TRACK_ID:
                raise GrammarError(f"{word}: {key} must be {TRACK_ID_TEXT}, got {value!r}")
        case MarkerId(key):
            if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= LAST_MARKER_ID:
                raise GrammarError(f"{word}: {key} must be {MARKER_ID_TEXT}, got {value!r}")
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


@dataclass(frozen=True, slots=True)
class BuildContext:
    """What a command may need to build its behaviour.

    Attributes:
        footprint: of the steering camera; None: not known.
        class_names: the detector's classes; None: not known.
        attachment: lines sent along with the command (a mission's text).
        check_requirements: `Guidance.check_requirements`; a mission calls it at each step.
        loop_rate_hz: updates of a behaviour a second; None: not known.

    >>> from companion import BuildContext
    >>> BuildContext(class_names=("person", "car")).class_names
    ('person', 'car')
    """

    footprint: Footprint | None = None
    class_names: tuple[str, ...] | None = None
    attachment: str = ""
    check_requirements: Callable[[Behaviour], str | None] = lambda behaviour: None
    loop_rate_hz: float | None = None


NO_CONTEXT = BuildContext()


@dataclass(frozen=True)
class Command(ABC):
    """An operator's command. A subclass is turned into a dataclass and registered by `behaviour`.

    Attributes:
        word: name in the grammar. help: one line.
        takes_attachment: further lines may be sent along.
        renamed: former key of an argument → its current key, for the error message.
        endless_without: field of which 0 means: until another command; empty: none has such a value.
        stated: names of parts that were asked for: the text has them also where they equal their default.

    >>> from companion import Behaviour, BuildContext, Command
    >>> from companion.guidance.behaviours.hold import HoldBehaviour
    >>> class Wait(Command):
    ...     def build(self, context: BuildContext) -> Behaviour:
    ...         return HoldBehaviour(10.0)
    >>> Wait().build(BuildContext()).name
    'hold'
    """

    word: ClassVar[str]
    help: ClassVar[str]
    takes_attachment: ClassVar[bool] = False
    renamed: ClassVar[Mapping[str, str]] = {}
    endless_without: ClassVar[str] = ""
    stated: ClassVar[frozenset[str]] = frozenset()

    def __post_init__(self) -> None:
        for part, argument in arguments_of(type(self)):
            value = value_of(self, part)
            if value is not None or part.default is not None:
                check(self.word, argument, value, default_of(part))

    @abstractmethod
    def build(self, context: BuildContext) -> Behaviour:
        """Build the behaviour. Raises GrammarError where the command cannot be flown."""

    def read_attachment(self) -> str:
        """Read the lines that were not sent along, on this computer. Raises GrammarError."""
        return ""

    @property
    def endless(self) -> bool:
        """Whether it runs until another command comes."""
        return bool(self.endless_without) and not getattr(self, self.endless_without)

    @property
    def aim(self) -> GimbalGoal | None:
        """For a command that only points the gimbal, where to; None: the command has a behaviour."""
        return None

    def __str__(self) -> str:
        words = [self.word]
        for index, (part, argument) in enumerate(arguments_of(type(self))):
            value = value_of(self, part)
            if value in (None, "") or (value == default_of(part) and part.name not in self.stated):
                continue
            written = _quoted(value) if isinstance(value, str) else _plain_number(value)
            # All words without a key may belong to the first argument.
            bare = index == 0 and (part.default is MISSING or isinstance(argument, ClassName))
            words.append(written if bare else f"{argument.key}={written}")
        return " ".join(words)


def make_stated(kind: type[Command], values: Mapping[str, Any]) -> Command:
    """A command of which these parts are stated. Raises GrammarError."""
    either = either_of(kind)
    if either and all(values.get(name, "") == "" for name in _SUBJECT):
        raise GrammarError(f"{kind.word}: {' or '.join(either)} is missing")
    return _stating(kind(**_fields(kind, values)), values)


def changed(command: Command, **changes: Any) -> Command:
    """The command with other parts, which are stated too. Raises GrammarError."""
    return _stating(replace(command, **_fields(type(command), changes)), {*command.stated, *changes})


def _fields(kind: type[Command], values: Mapping[str, Any]) -> dict[str, Any]:
    """The values by field: the parts of a subject are one."""
    parts = [part for part, _ in arguments_of(kind) if part.of_subject]
    given = [part for part in parts if values.get(part.name, "") != ""]
    if len(given) > 1:
        got = both_of([_SUBJECT[part.name].key for part in given])
        raise GrammarError(f"{kind.word}: give either {SUBJECT_KEYS}, got {got}")
    found = {name: value for name, value in values.items() if name not in _SUBJECT or not parts}
    if given:
        found[given[0].of_subject] = Subject(**{given[0].name: values[given[0].name]})
    return found


def _stating(command: Command, names: Iterable[str]) -> Command:
    # No field: it is neither an argument nor part of the equality.
    object.__setattr__(command, "stated", frozenset(names))
    return command


def both_of(keys: Sequence[str]) -> str:
    """Keys of which only one may be given, in words."""
    return f"{'both ' if len(keys) == 2 else ''}{' and '.join(keys)}"


class Part(NamedTuple):
    """What an argument sets: a field of the command, or a part of its subject.

    Attributes:
        name: of the field, here or in `Subject`. default: MISSING where it is required.
        of_subject: the field that holds the subject; empty: it is a field itself.
    """

    name: str
    default: Any
    of_subject: str = ""


_SUBJECT: dict[str, Argument] = {
    "class_name": ClassName("class", "an object of this class"),
    "track_id": TrackId("track", "the object of this track"),
    "marker_id": MarkerId("marker", "this printed marker"),
}
SUBJECT_KEYS = " or ".join(argument.key for argument in _SUBJECT.values())


@cache  # evaluates annotations: half a millisecond
def arguments_of(kind: type[Command]) -> tuple[tuple[Part, Argument], ...]:
    """The parts of a command with their argument types, in order: a subject's track and marker at the end."""
    hints = get_type_hints(kind, include_extras=True)
    found: list[tuple[Part, Argument]] = []
    last: list[tuple[Part, Argument]] = []
    for each in fields(kind):
        if _is_subject(hints[each.name]):
            named, *last = [(Part(name, None, each.name), argument) for name, argument in _SUBJECT.items()]
            found.append(named)
        else:
            found.append((Part(each.name, each.default), get_args(hints[each.name])[1]))
    return (*found, *last)


@cache
def either_of(kind: type[Command]) -> tuple[str, ...]:
    """Keys of which exactly one must be given; the first may be written without its key."""
    hints = get_type_hints(kind, include_extras=True)
    needed = any(hints[each.name] is Subject and each.default is MISSING for each in fields(kind))
    return tuple(argument.key for argument in _SUBJECT.values()) if needed else ()


def value_of(command: Command, part: Part) -> Any:
    """The value of a part; None: not given."""
    if not part.of_subject:
        return getattr(command, part.name)
    subject = getattr(command, part.of_subject)
    value = None if subject is None else getattr(subject, part.name)
    return None if value == "" else value


def default_of(part: Part) -> Any:
    """The default of a part; None where the argument is required."""
    return None if part.default is MISSING else part.default


def _is_subject(hint: Any) -> bool:
    return hint is Subject or hint == Subject | None


def _quoted(text: str) -> str:
    if re.fullmatch(r"[\w.:/+-]+", text):
        return text
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'


def _plain_number(value: float) -> str:
    """The shortest notation that keeps the value."""
    short = f"{value:g}"
    return short if float(short) == value else repr(value)


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
        RegistrationError: the word has other characters, or is already registered, or a field's type is not
            annotated with an argument (`Annotated[float, Number(...)]`), and is no Subject.

    >>> from typing import Annotated
    >>> from companion import Behaviour, BuildContext, Command, Number, behaviour
    >>> from companion.guidance.behaviours.hold import HoldBehaviour
    >>> from companion.guidance.grammar import parse
    >>> @behaviour("wait", "hold the position for some minutes")
    ... class Wait(Command):
    ...     minutes: Annotated[float, Number("minutes", "min", 0.1, 60.0, "how long")] = 1.0
    ...
    ...     def build(self, context: BuildContext) -> Behaviour:
    ...         return HoldBehaviour(60.0 * self.minutes)
    >>> command = parse("wait minutes=2")
    >>> command.minutes, command.build(BuildContext()).name
    (2.0, 'hold')
    """

    def register(kind: type[_Kind]) -> type[_Kind]:
        name = f"{kind.__module__}.{kind.__qualname__}"
        if _WORD.fullmatch(word) is None:
            raise RegistrationError(f"{name}: a command must be one lower-case word, got {word!r}")
        if (other := COMMANDS.get(word)) is not None and not _same(kind, other):
            raise RegistrationError(
                f"{name}: command {word!r} is already registered by {other.__module__}; choose another word"
            )
        made = dataclass(frozen=True)(kind)
        hints = get_type_hints(made, include_extras=True)
        for field in fields(made):
            hint = hints[field.name]
            if not _is_subject(hint) and not any(isinstance(a, Argument) for a in get_args(hint)[1:2]):
                raise RegistrationError(
                    f"{name}.{field.name}: expected Annotated[type, argument] or Subject, got {field.type}"
                )
        made.word, made.help = word, help_text
        COMMANDS[word] = made
        return made

    return register


def _same(kind: type[Command], other: type[Command]) -> bool:
    """Whether it is the same class, of a module that was imported twice."""
    return (kind.__module__, kind.__qualname__) == (other.__module__, other.__qualname__)
