"""The one grammar of commands, for every door: command line, zenoh queryable, console, sequences.

    command  = word { argument }
    argument = value | key "=" value          values without a key fill the arguments in their order
    value    = bare word | "quoted, with spaces"

Class names are compared without regard to case, and `_` and `-` count as a space: `traffic_light` is
"traffic light". A number may carry its own unit: `distance=3m`. Every command is a frozen dataclass whose
fields carry their key, unit and allowed range, so a command made in code is held to the same limits, and
`parse(str(command)) == command`.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import MISSING, Field, dataclass, fields
from typing import Annotated, Any, ClassVar, get_args, get_type_hints

from companion.points import points_from

# What a circle may ask of the vehicle sideways; the envelope's default acceleration.
MAX_CENTRIPETAL_MPS2 = 2.0

MOST_POINTS = 500
FARTHEST_M = 5000.0


class GrammarError(ValueError):
    """The text is no command. The message is one line for a person."""


@dataclass(frozen=True, slots=True)
class Number:
    """How a number is written and what it may be."""

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
class Choice:
    """One of a few words."""

    key: str
    words: tuple[str, ...]
    meaning: str


@dataclass(frozen=True, slots=True)
class Points:
    """A row of places, `north,east` or `north,east,height`, metres from home."""

    key: str
    meaning: str


Argument = Number | ClassName | Choice | Points


@dataclass(frozen=True, slots=True)
class Command:
    """What an operator asks for. `word` is how it is called, `meaning` what it does."""

    word: ClassVar[str]
    meaning: ClassVar[str]

    def __post_init__(self) -> None:
        for field, argument in _arguments(type(self)):
            value = getattr(self, field.name)
            if value is not None or field.default is not None:
                _check(self.word, argument, value, _default(field))

    @property
    def endless(self) -> bool:
        """It goes on until another command comes."""
        return False

    def __str__(self) -> str:
        words = [self.word]
        for field, argument in _arguments(type(self)):
            value = getattr(self, field.name)
            if value == _default(field):
                continue
            written = _quoted(value) if isinstance(value, str) else _plain_number(value)
            required = field.default is MISSING
            words.append(written if required else f"{argument.key}={written}")
        return " ".join(words)


@dataclass(frozen=True, slots=True)
class Takeoff(Command):
    word: ClassVar[str] = "takeoff"
    meaning: ClassVar[str] = "arm, climb to a height above home and stay there"

    altitude_m: Annotated[float, Number("altitude", "m", 1.0, 50.0, "height above home")] = 2.5


@dataclass(frozen=True, slots=True)
class Land(Command):
    word: ClassVar[str] = "land"
    meaning: ClassVar[str] = "land here and disarm"


@dataclass(frozen=True, slots=True)
class Rtl(Command):
    word: ClassVar[str] = "rtl"
    meaning: ClassVar[str] = "return to home, land and disarm"


@dataclass(frozen=True, slots=True)
class Stop(Command):
    word: ClassVar[str] = "stop"
    meaning: ClassVar[str] = "end our command; the autopilot holds its position by itself"


@dataclass(frozen=True, slots=True)
class Hold(Command):
    word: ClassVar[str] = "hold"
    meaning: ClassVar[str] = "stay here, under our command"

    duration_s: Annotated[
        float, Number("duration", "s", 0.0, 3600.0, "how long; 0: until another command")
    ] = 0.0

    @property
    def endless(self) -> bool:
        return self.duration_s == 0.0


@dataclass(frozen=True, slots=True)
class Orbit(Command):
    word: ClassVar[str] = "orbit"
    meaning: ClassVar[str] = "circle, nose to the centre: the point `radius` ahead, or an object of a class"

    class_name: Annotated[str, ClassName("class", "circle about this object, if given")] = ""
    radius_m: Annotated[float, Number("radius", "m", 1.0, 100.0, "of the circle")] = 10.0
    speed_mps: Annotated[float, Number("speed", "m/s", 0.1, 10.0, "along the circle")] = 2.0
    laps: Annotated[float, Number("laps", "", 0.0, 100.0, "how many; 0: until another command")] = 0.0
    direction: Annotated[str, Choice("direction", ("clockwise", "counterclockwise"), "seen from above")] = (
        "clockwise"
    )

    @property
    def endless(self) -> bool:
        return self.laps == 0.0

    def __post_init__(self) -> None:
        super(Orbit, self).__post_init__()
        fastest = math.sqrt(MAX_CENTRIPETAL_MPS2 * self.radius_m)
        if self.speed_mps > fastest:
            raise GrammarError(
                f"orbit: speed must be at most {math.floor(fastest * 100) / 100:g} m/s on a radius of "
                f"{self.radius_m:g} m, got {self.speed_mps:g}"
            )


@dataclass(frozen=True, slots=True)
class Goto(Command):
    word: ClassVar[str] = "goto"
    meaning: ClassVar[str] = "fly straight to a place, given by one pair of its arguments"

    north_m: Annotated[float | None, Number("north", "m", -5000.0, 5000.0, "of home, with east")] = None
    east_m: Annotated[float | None, Number("east", "m", -5000.0, 5000.0, "of home, with north")] = None
    altitude_m: Annotated[float | None, Number("altitude", "m", 1.0, 500.0, "above home; else as it is")] = (
        None
    )
    forward_m: Annotated[float | None, Number("forward", "m", -5000.0, 5000.0, "of here, with right")] = None
    right_m: Annotated[float | None, Number("right", "m", -5000.0, 5000.0, "of here, with forward")] = None
    latitude_deg: Annotated[
        float | None, Number("latitude", "deg", -90.0, 90.0, "WGS 84, with longitude")
    ] = None
    longitude_deg: Annotated[
        float | None, Number("longitude", "deg", -180.0, 180.0, "WGS 84, with latitude")
    ] = None
    speed_mps: Annotated[float, Number("speed", "m/s", 0.2, 20.0, "at most")] = 3.0
    heading_deg: Annotated[
        float | None, Number("heading", "deg", -360.0, 360.0, "of the nose; else along the way")
    ] = None

    def __post_init__(self) -> None:
        super(Goto, self).__post_init__()
        pairs = {
            "north and east": (self.north_m, self.east_m),
            "forward and right": (self.forward_m, self.right_m),
            "latitude and longitude": (self.latitude_deg, self.longitude_deg),
        }
        begun = [name for name, pair in pairs.items() if pair != (None, None)]
        if len(begun) != 1:
            got = " and ".join(begun) if begun else "none of them"
            raise GrammarError(f"goto: give exactly one pair of {', '.join(pairs)}; got {got}")
        if None in pairs[begun[0]]:
            raise GrammarError(f"goto: {begun[0]} belong together; one of them is missing")


@dataclass(frozen=True, slots=True)
class FollowPath(Command):
    word: ClassVar[str] = "follow-path"
    meaning: ClassVar[str] = "fly along a row of points, slowing down for corners"

    points: Annotated[
        str, Points("points", 'north,east or north,east,height, metres from home: "0,0 10,0,5 10,10"')
    ]
    speed_mps: Annotated[float, Number("speed", "m/s", 0.2, 20.0, "at most")] = 3.0
    laps: Annotated[float, Number("laps", "", 0.0, 1000.0, "how many; 0: until another command")] = 1.0
    nose: Annotated[
        str, Choice("nose", ("along", "still"), "where it points: along the way, or as it is")
    ] = "along"

    @property
    def endless(self) -> bool:
        return self.laps == 0.0

    def __post_init__(self) -> None:
        super(FollowPath, self).__post_init__()
        if 0.0 < self.laps < 1.0:
            raise GrammarError(f"follow-path: laps must be 0, or 1 or more, got {self.laps:g}")

    @property
    def places(self) -> tuple[tuple[float, ...], ...]:
        """(north, east) or (north, east, height) of each point, metres from home."""
        return points_from(self.points)


@dataclass(frozen=True, slots=True)
class FigureEight(Command):
    word: ClassVar[str] = "figure-eight"
    meaning: ClassVar[str] = "fly a level eight about this place, first towards the nose"

    radius_m: Annotated[float, Number("radius", "m", 3.0, 200.0, "from its middle to either end")] = 10.0
    speed_mps: Annotated[float, Number("speed", "m/s", 0.2, 20.0, "at most; bends are slower")] = 2.0
    laps: Annotated[float, Number("laps", "", 0.0, 1000.0, "how many; 0: until another command")] = 1.0
    nose: Annotated[
        str, Choice("nose", ("along", "still"), "where it points: along the way, or as it is")
    ] = "along"

    @property
    def endless(self) -> bool:
        return self.laps == 0.0


@dataclass(frozen=True, slots=True)
class Seek(Command):
    word: ClassVar[str] = "seek"
    meaning: ClassVar[str] = "turn on the spot until an object of the class is seen, then face it"

    class_name: Annotated[str, ClassName("class", "what to look for")]
    laps: Annotated[float, Number("laps", "", 0.25, 20.0, "turns before giving up")] = 2.0
    rate_radps: Annotated[float, Number("rate", "rad/s", 0.05, 1.0, "how fast to turn")] = 0.5
    confidence: Annotated[float, Number("confidence", "", 0.05, 1.0, "least confidence that counts")] = 0.4
    direction: Annotated[str, Choice("direction", ("clockwise", "counterclockwise"), "seen from above")] = (
        "clockwise"
    )


@dataclass(frozen=True, slots=True)
class Approach(Command):
    word: ClassVar[str] = "approach"
    meaning: ClassVar[str] = "fly to an object of the class, keeping the height, and stop before it"

    class_name: Annotated[str, ClassName("class", "what to fly to")]
    distance_m: Annotated[float, Number("distance", "m", 1.0, 100.0, "where to stop, to its surface")] = 5.0
    speed_mps: Annotated[float, Number("speed", "m/s", 0.2, 10.0, "at most")] = 2.0
    confidence: Annotated[float, Number("confidence", "", 0.05, 1.0, "least confidence that counts")] = 0.3
    lost_timeout_s: Annotated[
        float, Number("lost_timeout", "s", 0.5, 60.0, "wait for a lost object this long")
    ] = 5.0


COMMANDS: dict[str, type[Command]] = {
    kind.word: kind
    for kind in (Takeoff, Land, Rtl, Stop, Hold, Goto, FollowPath, FigureEight, Orbit, Seek, Approach)
}


def parse(text: str, class_names: Sequence[str] | None = None) -> Command:
    """One command.

    Args:
        text: as described at the top of this module.
        class_names: what the detector knows; names are then checked and written as the detector writes them.
            None: any name is taken as it is.

    Raises:
        GrammarError: with one line that says what is wrong and what would be right.
    """
    tokens = list(_tokens(text))
    if not tokens:
        raise GrammarError(f"no command; there are: {', '.join(COMMANDS)}")
    word = tokens[0].text.lower()
    if word not in COMMANDS or tokens[0].key is not None:
        raise GrammarError(f"unknown command {tokens[0].whole!r}; {_nearest(word, list(COMMANDS))}")
    kind = COMMANDS[word]
    values = {
        name: _value(word, argument, written, class_names)
        for name, argument, written in _assigned(kind, tokens[1:])
    }
    for field, argument in _arguments(kind):
        if field.default is MISSING and field.name not in values:
            raise GrammarError(f"{word}: {argument.key} is missing ({argument.meaning}): {usage(kind)}")
    return kind(**values)


def usage(kind: type[Command]) -> str:
    """One line: how the command is written, with its defaults."""
    words = [kind.word]
    for field, argument in _arguments(kind):
        default = _default(field)
        if field.default is MISSING:
            words.append(argument.key.upper())
        elif isinstance(argument, ClassName):
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


def describe() -> str:
    """The help text: every command, its arguments, units, ranges and defaults."""
    lines = []
    for kind in COMMANDS.values():
        lines += [usage(kind), f"    {kind.meaning}"]
        for _, argument in _arguments(kind):
            match argument:
                case Number(key, unit, low, high, meaning):
                    lines.append(f"    {key}: {meaning} ({low:g} to {high:g}{' ' + unit if unit else ''})")
                case Choice(key, words, meaning):
                    lines.append(f"    {key}: {meaning} ({' or '.join(words)})")
                case ClassName(key, meaning) | Points(key, meaning):
                    lines.append(f"    {key}: {meaning}")
    return "\n".join(lines)


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
    arguments = _arguments(kind)
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
            raise GrammarError(f"{kind.word}: {bare[len(arguments)].whole!r} is too much: {usage(kind)}")
        for token, (_, argument) in zip(bare, arguments, strict=False):
            yield claim(argument.key, token.text)
    for token in tokens:
        if token.key is None:
            continue
        if token.key not in by_key:
            known = _nearest(token.key, list(by_key)) if by_key else "it takes none"
            raise GrammarError(f"{kind.word}: unknown argument {token.key!r}; {known}")
        yield claim(token.key, token.text)


def _value(word: str, argument: Argument, text: str, class_names: Sequence[str] | None) -> float | str:
    match argument:
        case Number(key, unit):
            number = text.removesuffix(unit) if unit else text
            try:
                return float(number)
            except ValueError:
                raise GrammarError(f"{word}: {key} must be {_range(argument)}, got {text!r}") from None
        case Choice():
            return text.lower()
        case Points():
            return text
        case ClassName():
            return text if class_names is None else known_class(text, class_names)


def known_class(text: str, class_names: Sequence[str]) -> str:
    """The detector's own spelling of a class name. Raises GrammarError with the nearest names."""
    if text in class_names:
        return text
    for name in class_names:
        if _plain(name) == _plain(text):
            return name
    raise GrammarError(f"unknown class {text!r}; {_nearest(_plain(text), list(class_names))}")


def _check(word: str, argument: Argument, value: Any, default: Any) -> None:
    match argument:
        case Number(key, _, low, high):
            if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
                shown = f"{value:g}" if isinstance(value, float) else repr(value)
                raise GrammarError(f"{word}: {key} must be {_range(argument)}, got {shown}")
        case Choice(key, words):
            if value not in words:
                raise GrammarError(f"{word}: {key} must be {' or '.join(words)}, got {value!r}")
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
        case ClassName(key):
            if value == default:
                return
            if not isinstance(value, str) or not value.strip() or not value.isprintable():
                raise GrammarError(f"{word}: {key} must be the name of a class, got {value!r}")


def _range(argument: Number) -> str:
    return (
        f"a number from {argument.low:g} to {argument.high:g}{' ' + argument.unit if argument.unit else ''}"
    )


def _nearest(word: str, known: list[str]) -> str:
    plain = {_plain(name): name for name in known}
    near = [plain[match] for match in difflib.get_close_matches(_plain(word), list(plain), 3, 0.5)]
    if near:
        return f"did you mean {' or '.join(near)}?"
    more = ", …" if len(known) > 12 else ""
    return f"there are: {', '.join(known[:12])}{more}"


def _plain(name: str) -> str:
    return " ".join(re.split(r"[\s_-]+", name.strip().lower()))


def _quoted(text: str) -> str:
    if re.fullmatch(r"[\w.:/+-]+", text):
        return text
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'


def _plain_number(value: float) -> str:
    """As people write it, where nothing is lost by that."""
    short = f"{value:g}"
    return short if float(short) == value else repr(value)


def _arguments(kind: type[Command]) -> list[tuple[Field[Any], Argument]]:
    hints = get_type_hints(kind, include_extras=True)
    return [(field, get_args(hints[field.name])[1]) for field in fields(kind)]


def _default(field: Field[Any]) -> Any:
    return None if field.default is MISSING else field.default
