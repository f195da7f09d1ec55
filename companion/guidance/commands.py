"""The commands: what an operator, a mission or a program may ask for."""

from __future__ import annotations

import math
import re
from dataclasses import MISSING, Field, dataclass, fields
from typing import Annotated, Any, ClassVar, get_args, get_type_hints

from companion.geometry.formation import SHAPES
from companion.geometry.points import points_from
from companion.guidance.arguments import (
    Argument,
    Choice,
    ClassName,
    ClassNames,
    FileName,
    GrammarError,
    Number,
    Points,
    Word,
    check,
    names_in,
)

# What a circle may ask of the vehicle sideways; the envelope's default acceleration.
MAX_CENTRIPETAL_MPS2 = 2.0
# More vehicles than have been flown, even on paper.
MOST_SLOTS = 200


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
    meaning: ClassVar[str] = "turn, or search an area, until an object of the class is seen; then face it"

    class_name: Annotated[str, ClassName("class", "what to look for")]
    laps: Annotated[float, Number("laps", "", 0.25, 20.0, "turns before giving up")] = 2.0
    rate_radps: Annotated[float, Number("rate", "rad/s", 0.05, 1.0, "how fast to turn")] = 0.5
    confidence: Annotated[float, Number("confidence", "", 0.05, 1.0, "least confidence that counts")] = 0.4
    direction: Annotated[str, Choice("direction", ("clockwise", "counterclockwise"), "seen from above")] = (
        "clockwise"
    )
    pattern: Annotated[
        str, Choice("pattern", ("turn", "square", "lawnmower"), "on the spot, or over an area about it")
    ] = "turn"
    radius_m: Annotated[
        float | None, Number("radius", "m", 1.0, 500.0, "half a side of the expanding square")
    ] = None
    width_m: Annotated[
        float | None, Number("width", "m", 1.0, 1000.0, "of the lawnmower's area, west to east")
    ] = None
    height_m: Annotated[
        float | None, Number("height", "m", 1.0, 1000.0, "of the lawnmower's area, south to north")
    ] = None
    spacing_m: Annotated[
        float | None, Number("spacing", "m", 1.0, 200.0, "between strips; else what the camera sees")
    ] = None
    speed_mps: Annotated[float, Number("speed", "m/s", 0.2, 20.0, "over an area, at most")] = 2.0

    def __post_init__(self) -> None:
        super(Seek, self).__post_init__()
        given = {
            "radius": self.radius_m,
            "width": self.width_m,
            "height": self.height_m,
            "spacing": self.spacing_m,
        }
        needed = {"turn": (), "square": ("radius",), "lawnmower": ("width", "height")}[self.pattern]
        allowed = (*needed, "spacing") if needed else ()
        for key, value in given.items():
            if value is None and key in needed:
                raise GrammarError(f"seek: pattern={self.pattern} needs {' and '.join(needed)}")
            if value is not None and key not in allowed:
                raise GrammarError(f"seek: pattern={self.pattern} takes no {key}")


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
    retries: Annotated[
        float,
        Number("retries", "", 0.0, 20.0, "how often a lost object is looked for, where it was and around"),
    ] = 2.0

    def __post_init__(self) -> None:
        super(Approach, self).__post_init__()
        if self.retries != int(self.retries):
            raise GrammarError(f"approach: retries must be a whole number, got {self.retries:g}")


@dataclass(frozen=True, slots=True)
class Follow(Command):
    word: ClassVar[str] = "follow"
    meaning: ClassVar[str] = "keep a distance and a bearing to a moving object of the class"

    class_name: Annotated[str, ClassName("class", "what to follow")]
    distance_m: Annotated[float, Number("distance", "m", 1.5, 100.0, "to keep, to its surface")] = 8.0
    bearing: Annotated[
        str,
        Choice(
            "bearing",
            ("here", "compass", "course"),
            "where to stay: as it is, or `angle` from north or course",
        ),
    ] = "here"
    angle_deg: Annotated[
        float,
        Number("angle", "deg", -360.0, 360.0, "seen from the object, clockwise; of course, 180 is behind"),
    ] = 180.0
    speed_mps: Annotated[float, Number("speed", "m/s", 0.2, 20.0, "at most")] = 5.0
    confidence: Annotated[float, Number("confidence", "", 0.05, 1.0, "least confidence that counts")] = 0.3
    occlusion_s: Annotated[
        float, Number("occlusion", "s", 0.5, 60.0, "follow a hidden object's expected way this long")
    ] = 3.0
    duration_s: Annotated[
        float, Number("duration", "s", 0.0, 3600.0, "how long; 0: until another command")
    ] = 0.0

    @property
    def endless(self) -> bool:
        return self.duration_s == 0.0


@dataclass(frozen=True, slots=True)
class Patrol(Command):
    word: ClassVar[str] = "patrol"
    meaning: ClassVar[str] = "fly a round of points again and again, and stop for what is seen on the way"

    points: Annotated[str, Points("points", "the round: north,east or north,east,height, metres from home")]
    class_names: Annotated[str, ClassNames("classes", "what to stop for, parted by commas")]
    do: Annotated[
        str, Choice("do", ("hold", "approach"), "look at it from the way, or fly up to `distance`")
    ] = "hold"
    distance_m: Annotated[float, Number("distance", "m", 1.0, 100.0, "where an approach stops")] = 5.0
    wait_s: Annotated[float, Number("wait", "s", 0.0, 600.0, "how long it stays there")] = 5.0
    again_s: Annotated[
        float, Number("again", "s", 0.0, 3600.0, "the same object does not stop it again within this")
    ] = 120.0
    apart_m: Annotated[
        float, Number("apart", "m", 0.5, 100.0, "nearer than this to where an object was is the same one")
    ] = 5.0
    speed_mps: Annotated[float, Number("speed", "m/s", 0.2, 20.0, "at most")] = 3.0
    laps: Annotated[float, Number("laps", "", 0.0, 1000.0, "how many; 0: until another command")] = 0.0
    confidence: Annotated[float, Number("confidence", "", 0.05, 1.0, "least confidence that counts")] = 0.4

    @property
    def endless(self) -> bool:
        return self.laps == 0.0

    def __post_init__(self) -> None:
        super(Patrol, self).__post_init__()
        if len(self.places) < 2:
            raise GrammarError("patrol: a round has at least two points")

    @property
    def places(self) -> tuple[tuple[float, ...], ...]:
        """(north, east) or (north, east, height) of each point, metres from home."""
        return points_from(self.points)

    @property
    def names(self) -> tuple[str, ...]:
        """The classes, each by itself."""
        return names_in(self.class_names)


@dataclass(frozen=True, slots=True)
class Mission(Command):
    word: ClassVar[str] = "mission"
    meaning: ClassVar[str] = "fly the steps of a mission file, with their time-outs and branches"

    file: Annotated[
        str, FileName("file", "a path on the service's computer, or the name of one that came along")
    ]


@dataclass(frozen=True, slots=True)
class Formation(Command):
    word: ClassVar[str] = "formation"
    meaning: ClassVar[str] = "hold a slot about a leader: another vehicle, or a virtual one on a path"

    shape: Annotated[str, Choice("shape", SHAPES, "of the formation")]
    leader: Annotated[str, Word("leader", 'vehicle.name of the leader, or "virtual"')]
    spacing_m: Annotated[float, Number("spacing", "m", 1.0, 100.0, "of neighbouring slots")] = 6.0
    slot: Annotated[str, Word("slot", "number of the slot to take, from 1, or auto")] = "auto"
    points: Annotated[
        str | None, Points("points", 'path of a virtual leader, from home: "0,0 20,0 20,20,8"')
    ] = None
    speed_mps: Annotated[float, Number("speed", "m/s", 0.2, 20.0, "of a virtual leader, at most")] = 2.0
    laps: Annotated[float, Number("laps", "", 0.0, 1000.0, "of its path; 0: until another command")] = 1.0
    lost_timeout_s: Annotated[
        float, Number("lost_timeout", "s", 0.5, 600.0, "hold this long for a leader not heard")
    ] = 5.0

    @property
    def endless(self) -> bool:
        return self.points is None or self.laps == 0.0

    @property
    def slot_number(self) -> int | None:
        """None: auto."""
        return None if self.slot == "auto" else int(self.slot)

    @property
    def places(self) -> tuple[tuple[float, ...], ...]:
        """(north, east) or (north, east, height) of each point of the path, metres from home."""
        return points_from(self.points or "")

    def __post_init__(self) -> None:
        super(Formation, self).__post_init__()
        if self.slot != "auto" and not (self.slot.isdecimal() and 1 <= int(self.slot) <= MOST_SLOTS):
            raise GrammarError(f"formation: slot must be auto or 1 to {MOST_SLOTS}, got {self.slot!r}")
        if (self.leader == "virtual") != (self.points is not None):
            raise GrammarError(
                "formation: leader=virtual and points=… belong together; one of them is missing"
            )
        if 0.0 < self.laps < 1.0:
            raise GrammarError(f"formation: laps must be 0, or 1 or more, got {self.laps:g}")


@dataclass(frozen=True, slots=True)
class LandOnMarker(Command):
    word: ClassVar[str] = "land-on-marker"
    meaning: ClassVar[str] = "find a marker below, descend onto it in a narrowing cone, land and disarm"

    identifier: Annotated[float, Number("id", "", 0.0, 1023.0, "of the marker whose pad to land on")]
    method: Annotated[
        str,
        Choice("method", ("offboard", "autopilot"), "who flies: we, or the autopilot by LANDING_TARGET"),
    ] = "offboard"
    pad: Annotated[str, Choice("pad", ("still", "moving"), "whether the pad may move")] = "still"
    attempts: Annotated[float, Number("attempts", "", 1.0, 10.0, "descents before giving up")] = 3.0
    search_m: Annotated[float, Number("search", "m", 0.0, 50.0, "how far around to look for it")] = 5.0
    speed_mps: Annotated[float, Number("speed", "m/s", 0.2, 5.0, "over ground, at most")] = 1.5

    def __post_init__(self) -> None:
        super(LandOnMarker, self).__post_init__()
        for key, value in (("id", self.identifier), ("attempts", self.attempts)):
            if value != int(value):
                raise GrammarError(f"land-on-marker: {key} must be a whole number, got {value:g}")
        if self.method == "autopilot" and self.pad == "moving":
            raise GrammarError("land-on-marker: the autopilot lands on a pad that is still; fly it offboard")


COMMANDS: dict[str, type[Command]] = {
    kind.word: kind
    for kind in (
        Takeoff,
        Land,
        Rtl,
        Stop,
        Hold,
        Goto,
        FollowPath,
        FigureEight,
        Orbit,
        Seek,
        Approach,
        Follow,
        Patrol,
        Mission,
        Formation,
        LandOnMarker,
    )
}
