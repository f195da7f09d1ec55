"""The commands that look at nothing: to places, along paths, in formation, and the steps of a mission."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

from companion.geometry.formation import SHAPES
from companion.geometry.points import points_from
from companion.guidance.arguments import Choice, FileName, GrammarError, Number, Points, Word
from companion.guidance.command import Command

# More vehicles than have been flown, even on paper.
MOST_SLOTS = 200


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
