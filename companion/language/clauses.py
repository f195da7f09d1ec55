"""One clause of a sentence to a command or a question. Every word of it must be understood."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from companion.guidance.command import COMMANDS, Command, arguments_of, changed, make_stated, value_of
from companion.language.nouns import COLOUR_WORDS, classes_of, noun_pattern
from companion.language.scene import Scene, SceneObject

QUESTIONS = ("seen", "battery", "state", "why_not")


@dataclass(frozen=True, slots=True)
class Question:
    """A question about the vehicle.

    Attributes:
        name: one of QUESTIONS. The others restrict "seen".
        classes: any of these. colour: of `vision.colour.COLOURS`. choice: of CHOICE. side: left or right.
    """

    name: str
    classes: tuple[str, ...] = ()
    colour: str = ""
    choice: str = ""
    side: str = ""
    track_id: int | None = None

    def __str__(self) -> str:
        track = "" if self.track_id is None else f"track={self.track_id}"
        side = self.side and f"on the {self.side}"
        words = (f"?{self.name}", *self.classes, self.colour, self.choice, side, track)
        return " ".join(filter(None, words))

    def select(self, objects: Sequence[SceneObject]) -> list[SceneObject]:
        """Those that it asks for.

        Raises:
            UnclearError: colours or ranges are not known.
        """
        found = [
            each
            for each in objects
            if (not self.classes or each.class_name in self.classes)
            and self.track_id in (None, each.track_id)
        ]
        if self.colour:
            found = _of_colour(self.colour, found)
        if self.side:
            found = _on_side(self.side, found)
        return [_chosen(self.choice, found)] if self.choice and found else found


class UnclearError(ValueError):
    """The sentence is ambiguous or not understood. The message is the question to the operator."""


class NotSeenError(Exception):
    """An object is described that is not in view; its class must be searched for."""

    def __init__(self, class_name: str) -> None:
        self.class_name = class_name


POLITE = re.compile(
    r"^(?:please|now|ok|okay|hey|drone|so|and|then|(?:can|could|would|will) you|i (?:want|would like) you to"
    r"|let us|lets|go and)\b ?"
)
_FILLERS = frozenset(
    re.findall(r"\w+", "the a an that this of to at in on it me us there here please now with for")
)
COLOUR = "|".join(COLOUR_WORDS)
CHOICE = "nearest|closest|farthest|furthest|left|leftmost|right|rightmost|biggest"
# These refer to an object or a place; a command that took no object has not understood them.
_REFERRING = frozenset(("that", "on", "it", "me", "us", "there"))
_N = r"(-?\d+(?:\.\d+)?)"
_TURN_BACK = {"left": -90.0, "right": 90.0, "around": 180.0, "round": 180.0}
_COMPASS = {"north": 0.0, "east": 90.0, "south": 180.0, "west": 270.0}
_RELATIVE = {
    "forward": (1, 0),
    "forwards": (1, 0),
    "ahead": (1, 0),
    "back": (-1, 0),
    "backward": (-1, 0),
    "backwards": (-1, 0),
    "left": (0, -1),
    "right": (0, 1),
}


def make_command(word: str, **values: Any) -> Command:
    """A command of the table; arguments that are None have their default. Raises GrammarError."""
    return make_stated(COMMANDS[word], {key: value for key, value in values.items() if value is not None})


class Clause:
    """One clause; `take` removes what was understood. `focus`: the object that the clause before named."""

    def __init__(self, words: str, scene: Scene, focus: dict[str, Any]) -> None:
        self._whole = self._rest = POLITE.sub("", words.strip(" ,;."))
        self._scene, self.focus = scene, focus
        self._missing: str | None = None
        self._took_object = False

    def take(self, pattern: str) -> re.Match[str] | None:
        """The first occurrence of a pattern, as whole words, which is removed."""
        found = re.search(rf"(?<![\w.]){pattern}(?![\w/])", self._rest)
        if found is not None:
            self._rest = f"{self._rest[: found.start()]} {self._rest[found.end() :]}"
        return found

    def number(self, unit: str) -> float | None:
        found = self.take(rf"{_N} {unit}")
        return None if found is None else float(found[1])

    def intent(self) -> Command | Question:
        """The command or question of this clause; every word must have been taken.

        Raises:
            UnclearError: not so. NotSeenError: the object described is not in view.
        """
        for pattern, handler in _HANDLERS:
            found = re.match(rf"(?:{pattern})(?![\w/])", self._whole)
            if found is None:
                continue
            self._rest = self._whole[found.end() :]
            intent = handler(self, found)
            fillers = _FILLERS if self._took_object else _FILLERS - _REFERRING
            if left := [word for word in re.findall(r"[\w/.-]+", self._rest) if word not in fillers]:
                classes = ", ".join(self._scene.class_names[:12]) or "none"
                raise UnclearError(
                    f"{self._whole!r}: not understood: {' '.join(left)!r}. The detector's classes: {classes}"
                )
            if self._missing is not None:
                raise NotSeenError(self._missing)
            return intent
        raise self._not_understood()

    def _not_understood(self) -> UnclearError:
        known = "take off, land, come home, stop, hold, go, turn, find, approach, follow, circle, look"
        return UnclearError(
            f"{self._whole!r} is not understood. Begin with a verb: {known}; or ask a question"
        )

    # --- what a clause refers to

    def target(self) -> dict[str, Any]:
        """The field of a command that names the object: class_name, track_id or marker_id; empty: none named.

        Raises:
            UnclearError: several objects or classes fit.
        """
        self.focus = target = self._named()
        self._took_object = bool(target)
        return target

    def _named(self) -> dict[str, Any]:
        for key, pattern in (
            ("track_id", r"track (?:number )?(\d+)"),
            ("marker_id", r"marker (?:number )?(\d+)"),
        ):
            if found := self.take(pattern):
                return {key: int(found[1])}
        nouns = noun_pattern(self._scene.class_names)
        any_one = self.take(rf"(?:an?|any|some)(?= (?:(?:{COLOUR}) )?(?:{nouns})\b)")
        which = self.take(rf"(?:{CHOICE})")
        colour = self.take(rf"(?:{COLOUR})")
        noun = self.take(rf"(?:{nouns})")
        side = self.take(r"on the (left|right)") if which is None else None
        word = which[0] if which is not None else side[1] if side is not None else None
        if noun is None:
            if self.take("1") or word or colour:
                return self._in_view(word, colour)
            return self._same_object() if self.take(r"(?:it|that|them|him|her)") else {}
        names = classes_of(noun[0], self._scene.class_names)
        if len(names) > 1:
            seen = tuple(
                name for name in names if any(each.class_name == name for each in self._scene.objects)
            )
            if len(seen) != 1:
                raise UnclearError(f"which {noun[0]}: {' or '.join(seen or names)}?")
            names = seen
        return self._object_of(names[0], word, colour, definite=not any_one)

    def _object_of(
        self, class_name: str, word: str | None, colour: re.Match[str] | None, *, definite: bool
    ) -> dict[str, Any]:
        """An object of one class. `word`: a superlative or a side."""
        seen = self._tracked(class_name, colour)
        if colour is not None and not seen:
            self._missing = class_name
        elif word is not None and seen:
            return {"track_id": _chosen(word, seen).track_id}
        elif len(seen) > 1 and definite:
            raise UnclearError(f"which {class_name}: {_options(seen)}")
        elif colour is not None:
            return {"track_id": seen[0].track_id}
        return {"class_name": class_name}

    def _in_view(self, word: str | None, colour: re.Match[str] | None) -> dict[str, Any]:
        """ "the red one", "the left one": of any class."""
        seen = self._tracked(None, colour)
        if word is not None and seen:
            return {"track_id": _chosen(word, seen).track_id}
        if len(seen) != 1:
            raise UnclearError(f"{self._whole!r}: which one: {_options(seen) if seen else 'none is in view'}")
        return {"track_id": seen[0].track_id}

    def _tracked(self, class_name: str | None, colour: re.Match[str] | None) -> list[SceneObject]:
        """Objects with a track, of a class and of a colour.

        Raises:
            UnclearError: none is known to have the colour, and that of some is unknown.
        """
        of_class = [
            each
            for each in self._scene.objects
            if each.track_id is not None and class_name in (None, each.class_name)
        ]
        try:
            return of_class if colour is None else _of_colour(COLOUR_WORDS[colour[0]], of_class)
        except UnclearError as error:
            raise UnclearError(f"{self._whole!r}: {error}") from None

    def _same_object(self) -> dict[str, Any]:
        if self.focus:
            return self.focus
        last = self._scene.last
        for part, _ in () if last is None else arguments_of(type(last)):
            named = part.name in ("track_id", "marker_id", "class_name")
            if last is not None and named and (value := value_of(last, part)) is not None:
                return {part.name: value}
        seen = [each for each in self._scene.objects if each.track_id is not None]
        if len(seen) == 1:
            return {"track_id": seen[0].track_id}
        raise UnclearError(f"{self._whole!r}: what is 'it'? Name a class, or a track")

    # --- commands

    def takeoff(self, _: re.Match[str]) -> Command:
        self.take("(?:high|altitude|height|above (?:the )?(?:ground|home))")
        return make_command("takeoff", altitude_m=self.number("m"))

    def land(self, _: re.Match[str]) -> Command:
        if marker := self.take(r"(?:on )?(?:the )?marker (?:number )?(\d+)"):
            return make_command("land-on-marker", identifier=float(marker[1]))
        self.take("(?:right here|where you are|immediately)")
        return make_command("land")

    def rtl(self, _: re.Match[str]) -> Command:
        self.take("(?:and land|home|launch|base|back|start)")
        self.take("home")
        return make_command("rtl")

    def stop(self, _: re.Match[str]) -> Command:
        return make_command("stop")

    def hold(self, _: re.Match[str]) -> Command:
        self.take("(?:your position|position|still|where you are|on|it|there)")
        return make_command("hold", duration_s=self.number("s"))

    def seek(self, _: re.Match[str]) -> Command | Question:
        laps = self.number("x")
        target = self.target()
        if "track_id" in target:
            identifier = target["track_id"]
            names = [each.class_name for each in self._scene.objects if each.track_id == identifier]
            return Question("seen", tuple(names[:1]), track_id=identifier)
        if "class_name" not in target:
            raise UnclearError(
                f"{self._whole!r}: find what? The classes: {', '.join(self._scene.class_names[:12])}"
            )
        return make_command("seek", class_name=target["class_name"], laps=laps)

    def approach(self, _: re.Match[str]) -> Command:
        return make_command("approach", **self._object(), **self._speed(), distance_m=self._distance())

    def follow(self, _: re.Match[str]) -> Command:
        behind = self.take("(?:from )?behind")
        bearing = {"bearing": "course"} if behind else {}
        return make_command(
            "follow",
            **self._object(),
            **self._speed(),
            **bearing,
            distance_m=self._distance(),
            duration_s=self.number("s"),
        )

    def orbit(self, _: re.Match[str]) -> Command:
        direction = self.take("(counterclockwise|counter-clockwise|anticlockwise|anti-clockwise|clockwise)")
        turned = (
            None if direction is None else "clockwise" if direction[1] == "clockwise" else "counterclockwise"
        )
        self.take("(?:around|round|about)")
        laps, speed, radius = self.number("x"), self._speed(), self._distance()
        return make_command("orbit", **self.target(), **speed, radius_m=radius, laps=laps, direction=turned)

    def figure_eight(self, _: re.Match[str]) -> Command:
        laps = self.number("x")
        return make_command("figure-eight", **self._speed(), radius_m=self._distance(), laps=laps)

    def look(self, found: re.Match[str]) -> Command:
        """The gimbal."""
        if angle := self.take(rf"(?:{_N} deg )?(down|up)(?: {_N} deg)?"):
            given = angle[1] or angle[3]
            if given is None and angle[2] == "up":
                raise UnclearError(f"{self._whole!r}: how many degrees?")
            pitch = float(given) if given else 90.0
            return make_command("gimbal", pitch_deg=-pitch if angle[2] == "down" else pitch)
        if side := self.take(rf"(?:{_N} deg )?(?:to the )?(left|right)(?: {_N} deg)?"):
            yaw = float(side[1] or side[3] or 90.0)
            return make_command("gimbal", yaw_deg=-yaw if side[2] == "left" else yaw)
        if self.take("(?:straight )?(?:ahead|forward|forwards|level)"):
            return make_command("gimbal")
        target = self.target()
        if "class_name" in target:
            seen = [each for each in self._scene.objects if each.class_name == target["class_name"]]
            target = {"track_id": seen[0].track_id} if len(seen) == 1 else {}
        if target.get("track_id") is None:
            raise UnclearError(
                f"{self._whole!r}: where to? Down, ahead, left, right, or at an object in view"
            )
        return make_command("gimbal", track_id=target["track_id"])

    def turn(self, _: re.Match[str]) -> Command:
        """Yaw on the spot, or the direction of the circle."""
        if self.take("(?:the )?other (?:way|direction)"):
            return self.other_way(_)
        if compass := self.take(f"({'|'.join(_COMPASS)})"):
            heading = _COMPASS[compass[1]]
        else:
            angle = self.number("deg")
            side = self.take(f"({'|'.join(_TURN_BACK)})")
            if self._scene.yaw_rad is None:
                raise UnclearError(f"{self._whole!r}: the heading is not known. Say for example 'face north'")
            if side is None:
                raise UnclearError(f"{self._whole!r}: which way? Say for example 'turn left 90 degrees'")
            by = _TURN_BACK[side[1]] if angle is None else math.copysign(angle, _TURN_BACK[side[1]])
            heading = round(math.degrees(self._scene.yaw_rad) + by) % 360
        return make_command("goto", forward_m=0.0, right_m=0.0, heading_deg=float(heading))

    def go(self, found: re.Match[str]) -> Command:
        """Fly to an object, or by some metres."""
        speed = self._speed()
        if found[0] in ("climb", "rise", "ascend", "descend") and " to " not in f" {self._rest} ":
            self._rest += " down" if found[0] == "descend" else " up"
        if home := self.take(rf"{_N} m (north|south)(?: and)? {_N} m (east|west) of home"):
            return make_command(
                "goto", **speed, north_m=_signed(home[1], home[2]), east_m=_signed(home[3], home[4])
            )
        if home := self.take(rf"{_N} m (north|south|east|west) of home"):
            axis = "north_m" if home[2] in ("north", "south") else "east_m"
            place = {"north_m": 0.0, "east_m": 0.0} | {axis: _signed(home[1], home[2])}
            return make_command("goto", **speed, **place)
        if vertical := self.take(rf"(?:(?:by )?{_N} m )?(up|down|higher|lower)(?: by)?(?: {_N} m)?(?! m)"):
            given = vertical[1] or vertical[3]
            if given is None and (to := self.take(rf"to {_N} m")):
                return self._to_height(float(to[1]), speed)
            if given is None:
                raise UnclearError(f"{self._whole!r}: how many metres?")
            if self._scene.altitude_m is None:
                raise UnclearError(f"{self._whole!r}: the height is not known. Say 'climb to N metres'")
            by = float(given) if vertical[2] in ("up", "higher") else -float(given)
            return self._to_height(round(self._scene.altitude_m + by, 1), speed)
        sides = "|".join((*_RELATIVE, *_COMPASS))
        if moved := self.take(rf"(?:{_N} m )?(?:to the )?({sides})(?: by)?(?: {_N} m)?"):
            given = moved[1] or moved[3]
            if given is None:
                raise UnclearError(f"{self._whole!r}: how many metres?")
            return make_command("goto", **speed, **self._displacement(float(given), moved[2]))
        if height := self.take(rf"(?:to )?{_N} m(?: high| altitude| height| above home)"):
            return self._to_height(float(height[1]), speed)
        if found[0] in ("climb", "rise", "ascend", "descend") and (height := self.take(rf"to {_N} m")):
            return self._to_height(float(height[1]), speed)
        if self.take("home"):
            return make_command("rtl")
        distance = self._distance()
        return make_command("approach", **self._object(), **speed, distance_m=distance)

    def back(self, _: re.Match[str]) -> Command:
        metres = self.number("m")
        if metres is None:
            raise UnclearError(f"{self._whole!r}: how many metres?")
        return make_command("goto", **self._speed(), **self._displacement(metres, "back"))

    def _to_height(self, height_m: float, speed: dict[str, float]) -> Command:
        return make_command("goto", **speed, forward_m=0.0, right_m=0.0, altitude_m=height_m)

    def _displacement(self, metres: float, side: str) -> dict[str, float]:
        if side in _RELATIVE:
            forward, right = _RELATIVE[side]
            return {"forward_m": metres * forward, "right_m": metres * right}
        if self._scene.yaw_rad is None:
            raise UnclearError(f"{self._whole!r}: the heading is not known. From home ('{side} of home')?")
        by = math.radians(_COMPASS[side]) - self._scene.yaw_rad
        return {"forward_m": round(metres * math.cos(by), 2), "right_m": round(metres * math.sin(by), 2)}

    def _object(self) -> dict[str, Any]:
        if target := self.target():
            return target
        raise UnclearError(
            f"{self._whole!r}: which object? For example: {', '.join(self._scene.class_names[:3])}"
        )

    def _distance(self) -> float | None:
        found = self.take(
            rf"(?:to )?(?:within )?(?:(?:with )?(?:a )?(?:distance|radius) (?:of )?)?{_N} m"
            r"(?: (?:distance|radius|away from|away))?"
        )
        return None if found is None else float(found[1])

    def _speed(self) -> dict[str, float]:
        speed = self.number("m/s")
        return {} if speed is None else {"speed_mps": speed}

    # --- changes of the newest command

    def scaled(self, found: re.Match[str]) -> Command:
        """ "twice as far", "three times as high": a factor on the distance, the speed or the height."""
        word, what = found["factor"], found["what"]
        factor = {"twice": 2.0, "half": 0.5}.get(word) or float(word.split()[0])
        if factor == 0:
            raise self._not_understood()
        if what in ("close", "slow"):
            factor = 1 / factor
        if what not in ("high", "height", "altitude"):
            return self._changed(what in ("fast", "slow", "speed"), lambda value: value * factor)
        if self._scene.altitude_m is None:
            raise UnclearError(f"{self._whole!r}: the height is not known. Say 'climb to N metres'")
        return self._to_height(round(self._scene.altitude_m * factor, 1), {})

    def higher(self, found: re.Match[str]) -> Command:
        """ "two metres higher"."""
        self._rest = self._whole
        return self.go(found)

    def faster(self, _: re.Match[str]) -> Command:
        """ "slower"."""
        raise UnclearError(f"{self._whole!r}: how fast? Say for example 'twice as fast', 'half as fast'")

    def same_with(self, found: re.Match[str]) -> Command:
        """ "the same with the car", or only "the car": the newest command with another object."""
        if found[1] is None:
            self._rest = self._whole
        last, target = self._scene.last, self.target()
        if last is None or not target:
            raise self._not_understood()
        if not target.keys() <= {part.name for part, _ in arguments_of(type(last))}:
            raise self._not_understood()
        return changed(last, **target)

    def shifted(self, found: re.Match[str]) -> Command:
        """ "five metres closer"."""
        if found[1] is None:
            raise UnclearError(f"{self._whole!r}: how many metres? Or say 'twice as far', 'half as far'")
        by = float(found[1]) * (-1 if found[2] in ("closer", "nearer") else 1)
        return self._changed(False, lambda value: value + by)

    def keep_distance(self, found: re.Match[str]) -> Command:
        """ "keep ten metres"."""
        return self._changed(False, lambda _: float(found[1]))

    def other_way(self, _: re.Match[str]) -> Command:
        direction = getattr(self._scene.last, "direction", None)
        if self._scene.last is None or direction is None:
            raise UnclearError(f"{self._whole!r}: nothing circles. Circle what?")
        other = "counterclockwise" if direction == "clockwise" else "clockwise"
        return changed(self._scene.last, direction=other)

    def again(self, _: re.Match[str]) -> Command:
        if self._scene.last is None:
            raise UnclearError(f"{self._whole!r}: there was no command. Do what?")
        return self._scene.last

    def _changed(self, speed: bool, change: Callable[[float], float]) -> Command:
        last = self._scene.last
        fields = ("speed_mps",) if speed else ("distance_m", "radius_m", "altitude_m")
        for field in fields:
            value = getattr(last, field, None)
            if last is not None and value is not None:
                return changed(last, **{field: round(change(value), 3)})
        raise UnclearError(f"{self._whole!r}: of what? The newest command has no such value")


def _signed(metres: str, side: str) -> float:
    return -float(metres) if side in ("south", "west") else float(metres)


def _options(seen: Sequence[SceneObject]) -> str:
    return f"{'; '.join(map(str, seen))}? Say for example 'track {seen[0].track_id}'"


def _of_colour(colour: str, seen: Sequence[SceneObject]) -> list[SceneObject]:
    """Raises UnclearError: none is known to have the colour, and that of some is unknown."""
    matching = [each for each in seen if each.colour == colour]
    if not matching and (unknown := [each for each in seen if each.colour is None]):
        raise UnclearError(
            "colours are not known: no preview image, or too small in it: "
            f"{'; '.join(map(str, unknown))}. Name a track, or ask again"
        )
    return matching


def _on_side(side: str, seen: Sequence[SceneObject]) -> list[SceneObject]:
    """Those left or right of the nose. Raises UnclearError: a direction is unknown."""
    if unknown := [each for each in seen if each.bearing_deg is None]:
        raise UnclearError(f"directions are not known: {'; '.join(map(str, unknown))}")
    sign = -1 if side == "left" else 1
    return [each for each in seen if sign * (each.bearing_deg or 0.0) > 0.0]


def _chosen(word: str, seen: Sequence[SceneObject]) -> SceneObject:
    """One of several objects by a superlative or a side."""
    if word.startswith(("left", "right")):
        known = [each for each in seen if each.bearing_deg is not None]
        sign = 1 if word.startswith("left") else -1
        key: Callable[[SceneObject], float] = lambda each: sign * (each.bearing_deg or 0.0)  # noqa: E731
    else:
        known = [each for each in seen if each.range_m is not None]
        sign = -1 if word in ("farthest", "furthest") else 1
        key = lambda each: sign * (each.range_m or 0.0)  # noqa: E731
    if word == "biggest" or len(known) < len(seen):
        raise UnclearError(f"which is the {word} is not known: {'; '.join(map(str, seen))}. Which track?")
    return min(known, key=key)


_Handler = Callable[[Clause, re.Match[str]], Command | Question]
_HANDLERS: tuple[tuple[str, _Handler], ...] = (
    (
        r"(?:go |stay |be |fly )?(?P<factor>twice|half|\d+(?:\.\d+)? x) (?:as )?(?:the )?"
        r"(?P<what>far|close|distance|radius|fast|slow|speed|high|height|altitude)",
        Clause.scaled,
    ),
    (rf"(?:{_N} m )?(?:higher|lower)$", Clause.higher),
    (r"(?:go |fly )?(?:faster|slower)$", Clause.faster),
    (
        rf"(?:go |come |move |get |stay )?(?:{_N} m )?(closer|nearer|farther|further)(?: away)?$",
        Clause.shifted,
    ),
    (rf"(?:keep|stay)(?: at)?(?: a)?(?: distance of)? {_N} m(?: away| distance)?$", Clause.keep_distance),
    (
        r"(?:go |circle |orbit )?(?:in )?(?:the )?other (?:way|direction)(?: round| around)?",
        Clause.other_way,
    ),
    (r"(?:do (?:it|that) |once more|1 x more|again)(?:again)?$", Clause.again),
    (r"take off|takeoff|launch|lift off", Clause.takeoff),
    (r"land|touch down|come down$", Clause.land),
    (
        r"(?:come|return|go|fly|get)(?: back)?(?: to)? (?:home|base|launch|start)|return|come back|rtl",
        Clause.rtl,
    ),
    (r"stop|halt|abort|freeze", Clause.stop),
    (r"hold|hover|wait|stay", Clause.hold),
    (r"fly (?:a )?figure (?:of )?(?:eight|8)|figure (?:of )?(?:eight|8)", Clause.figure_eight),
    (
        r"circle|orbit|(?:fly|go) (?:in )?(?:a )?circles?(?: (?:around|round|about))?"
        r"|(?:fly|go) (?:around|round)",
        Clause.orbit,
    ),
    (r"follow|chase|tail|track(?! \d)|keep following", Clause.follow),
    (r"approach|get close to|(?:get|go|fly|come|move) (?:near|closer to|up to)", Clause.approach),
    (r"find|search for|look for|seek|locate|search", Clause.seek),
    (r"look|(?:point|aim|turn) (?:the |your )?(?:camera|gimbal)", Clause.look),
    (r"turn|face|rotate|yaw", Clause.turn),
    (r"(?:go |move )?back (?:up|off|away)", Clause.back),
    (r"(?:go|fly|move|come) over(?= to)|go|fly|move|climb|rise|ascend|descend|come|back", Clause.go),
    (r"((?:do )?the same (?:with|for|to|on|around))|the|an?|track|marker", Clause.same_with),
)
