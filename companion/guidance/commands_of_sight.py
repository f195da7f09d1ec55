"""The commands that go by what is seen: objects of a class, and markers."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, ClassVar

from companion.geometry.points import points_from
from companion.guidance.arguments import Choice, ClassName, ClassNames, GrammarError, Number, Points, names_in
from companion.guidance.command import Command
from companion.guidance.gimbal_sweep import LEAST_SWEEP_DEG, USUAL_RATE_DPS
from companion.vehicle.gimbal import GimbalAim

# What a circle may ask of the vehicle sideways; the envelope's default acceleration.
MAX_CENTRIPETAL_MPS2 = 2.0

GimbalUse = Annotated[
    str, Choice("gimbal", ("leave", "track"), "leave it alone, or keep its camera on the object")
]


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
    sweep_deg: Annotated[
        float | None,
        Number("sweep", "deg", -90.0, 90.0, "gimbal up and down between level and this; below is negative"),
    ] = None
    sweep_rate_dps: Annotated[
        float, Number("sweep_rate", "deg/s", 2.0, 60.0, "of the gimbal; slower, the turn is slower too")
    ] = USUAL_RATE_DPS

    def __post_init__(self) -> None:
        super(Seek, self).__post_init__()
        if self.sweep_deg is not None and abs(self.sweep_deg) < LEAST_SWEEP_DEG:
            raise GrammarError(
                f"seek: sweep must be {LEAST_SWEEP_DEG:g} deg or more from level, got {self.sweep_deg:g}"
            )
        if self.sweep_deg is not None and self.pattern != "turn":
            raise GrammarError(f"seek: pattern={self.pattern} takes no sweep")
        if self.sweep_deg is None and self.sweep_rate_dps != USUAL_RATE_DPS:
            raise GrammarError("seek: sweep_rate needs sweep")
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
    gimbal: GimbalUse = "leave"

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
    gimbal: GimbalUse = "leave"

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


@dataclass(frozen=True, slots=True)
class Gimbal(Command):
    word: ClassVar[str] = "gimbal"
    meaning: ClassVar[str] = "point the gimbal, whatever flies; alone: level and ahead"

    pitch_deg: Annotated[
        float, Number("pitch", "deg", -90.0, 90.0, "above the horizon; below is negative")
    ] = 0.0
    yaw_deg: Annotated[
        float, Number("yaw", "deg", -180.0, 180.0, "clockwise from the nose, with which it turns")
    ] = 0.0

    @property
    def aim(self) -> GimbalAim:
        """The same in radians."""
        return GimbalAim(math.radians(self.pitch_deg), math.radians(self.yaw_deg))
