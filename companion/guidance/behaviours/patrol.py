"""Patrol: fly a closed path repeatedly, stop for detected objects, then continue."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar

from companion.geometry.points import points_from
from companion.guidance.behaviour import Behaviour, BehaviourContext, BehaviourOutput, Outcome, Requirement
from companion.guidance.behaviours.approach import Approach, ApproachBehaviour
from companion.guidance.behaviours.follow_path import FollowPathBehaviour
from companion.guidance.behaviours.seek import BlindTime, Facing, range_m, range_text
from companion.guidance.command import (
    BuildContext,
    ClassNames,
    Command,
    EnumArgument,
    GrammarError,
    Number,
    Points,
    behaviour,
    names_in,
)
from companion.guidance.motion import home_of, in_degrees
from companion.guidance.objects.closing_check import Approached
from companion.guidance.objects.tracked_object import Subject, TrackedObject
from companion.vehicle.state import Vector3

# A patrol ends after this time without a frame.
BLIND_TIMEOUT_S = 10.0


@dataclass(slots=True)
class _Known:
    """An object for which the patrol has stopped."""

    object: TrackedObject
    until_ns: float


@behaviour("patrol", "fly a closed path repeatedly, and stop for detected objects")
class Patrol(Command):
    renamed: ClassVar[Mapping[str, str]] = {
        "do": "on_detection",
        "wait": "dwell",
        "again": "revisit",
        "apart": "merge_radius",
    }
    endless_without = "laps"
    points: Annotated[str, Points("points", "the path: north,east or north,east,height, metres from home")]
    class_names: Annotated[str, ClassNames("classes", "what to stop for, separated by commas")]
    on_detection: Annotated[
        str, EnumArgument("on_detection", ("hold", "approach"), "stop and face it, or fly up to `distance`")
    ] = "hold"
    distance_m: Annotated[
        float,
        Number("distance", "m", 1.0, 100.0, "where an approach stops, over ground to the nearest surface"),
    ] = 5.0
    dwell_s: Annotated[float, Number("dwell", "s", 0.0, 600.0, "time spent at an object")] = 5.0
    revisit_s: Annotated[
        float, Number("revisit", "s", 0.0, 3600.0, "time within which the same object is ignored")
    ] = 120.0
    merge_radius_m: Annotated[
        float,
        Number(
            "merge_radius",
            "m",
            0.5,
            100.0,
            "detections within this distance are one object",
        ),
    ] = 5.0
    speed_mps: Annotated[float, Number("speed", "m/s", 0.2, 20.0, "maximum speed")] = 3.0
    laps: Annotated[float, Number("laps", "", 0.0, 1000.0, "how many; 0: until another command")] = 0.0
    confidence: Annotated[float, Number("confidence", "", 0.05, 1.0, "minimum confidence")] = 0.4

    def __post_init__(self) -> None:
        super().__post_init__()
        if (count := len(points_from(self.points))) < 2:
            raise GrammarError(f"patrol: points must be at least 2 points, got {count}")

    @property
    def names(self) -> tuple[str, ...]:
        """The class names as a tuple."""
        return names_in(self.class_names)

    def build(self, context: BuildContext) -> Behaviour:
        return PatrolBehaviour(self)


class PatrolBehaviour(Behaviour):
    """Flies the closed path; stops for an object that is found, turns to it and logs its position."""

    name = "patrol"
    requirements = frozenset({Requirement.POSITION, Requirement.IN_AIR, Requirement.PERCEPTION})

    def __init__(self, command: Patrol) -> None:
        self._command = command
        self.class_names = command.names
        self._approaches = command.on_detection == "approach"
        if self._approaches:
            self.requirements = PatrolBehaviour.requirements | {Requirement.DEPTH_OR_SIZE}
        self._route = FollowPathBehaviour(
            points_from(command.points), command.speed_mps, laps=command.laps, round_trip=True
        )
        self._begin(0)

    def _begin(self, now_ns: int) -> None:
        self._begun_ns, self._found = now_ns, 0
        self._known: list[_Known] = []
        self._facing: Facing | None = None
        self._approach: ApproachBehaviour | None = None
        self._wait_until_ns: float | None = None
        self._blind = BlindTime(BLIND_TIMEOUT_S)

    def goals(self, context: BehaviourContext) -> tuple[Vector3, ...]:
        """See Behaviour."""
        return self._route.goals(context)

    def on_activate(self, context: BehaviourContext) -> None:
        self._route.on_activate(context)
        self._begin(context.now_ns)

    def update(self, dt_s: float, context: BehaviourContext) -> BehaviourOutput:
        if self._approach is not None:
            return self._fly_there(self._approach, dt_s, context)
        if (blind := self._blind.outcome(context)) is not None:
            return blind
        if not context.perception_fresh:
            return self._route.stand(dt_s, context)  # so that no part of the path is flown unseen
        self._known = [known for known in self._known if known.until_ns > context.now_ns]
        for known in self._known:
            known.object = context.objects.now(known.object)
        if self._facing is None:
            self._facing = self._find(context)
        if self._facing is not None:
            return self._inspect(self._facing, dt_s, context)
        return self._fly_on(dt_s, context)

    def _fly_on(self, dt_s: float, context: BehaviourContext) -> BehaviourOutput:
        step = self._route.update(dt_s, context)
        if isinstance(step, Outcome) and step.success:
            stops = f"{self._found} {'stop' if self._found == 1 else 'stops'}"
            return Outcome(True, f"{step.reason}, {stops}")
        return step

    @property
    def approached(self) -> Approached | None:
        return None if self._approach is None else self._approach.approached

    @property
    def status(self) -> str:
        if self._approach is not None:
            return f"patrol, approaching a find: {self._approach.status}"
        if self._facing is not None:
            return f"patrol, facing a {self._facing.object.class_name}"
        return self._route.status.replace(self._route.name, "patrol", 1)

    def _find(self, context: BehaviourContext) -> Facing | None:
        """The nearest find, if it has not been stopped for yet."""
        seen = context.objects.seen(self.class_names, self._command.confidence, self._begun_ns)
        finds = [each for each in seen if each.certain and not self._knows(each)]
        if not finds:
            return None
        return Facing(min(finds, key=lambda each: range_m(each, context)), context.now_ns)

    def _inspect(self, facing: Facing, dt_s: float, context: BehaviourContext) -> BehaviourOutput:
        """Stop, face the object and log it; then approach it, or dwell."""
        now_ns = context.now_ns
        facing.update(context)
        if self._wait_until_ns is not None:
            self._remember(facing.object, now_ns)
            if now_ns >= self._wait_until_ns:
                return self._go_on(context)
        elif facing.lost:
            self._note(f"lost a {_named(facing.object)} before facing it")
            self._remember(facing.object, now_ns)
            return self._go_on(context)
        elif facing.faced:
            self._found += 1
            self._remember(facing.object, now_ns)
            self._note(f"found a {_named(facing.object)}, {_place_text(facing.object, context)}")
            if self._approaches:
                return self._go_there(facing.object, context)
            self._wait_until_ns = now_ns + self._command.dwell_s * 1e9
        return self._route.stand(dt_s, context, facing.bearing_rad)

    def _go_there(self, found: TrackedObject, context: BehaviourContext) -> BehaviourOutput:
        command, subject = self._command, Subject(found.class_name)
        nearer = Approach(
            subject,
            distance_m=command.distance_m,
            speed_mps=min(command.speed_mps, 3.0),
            confidence=min(0.3, command.confidence),
            retries=0.0,
        )
        self._approach = ApproachBehaviour(nearer)
        self._approach.on_activate(context)
        context.objects.choose(subject, found)
        return self._fly_there(self._approach, 0.0, context)

    def _fly_there(
        self, approach: ApproachBehaviour, dt_s: float, context: BehaviourContext
    ) -> BehaviourOutput:
        step = approach.update(dt_s, context)
        if not isinstance(step, Outcome):
            return step
        approach.on_deactivate()
        self._approach = None
        self._note(step.reason)
        self._wait_until_ns = context.now_ns + self._command.dwell_s * 1e9
        self._route.resume(context)
        return self._route.stand(0.0, context)

    def _go_on(self, context: BehaviourContext) -> BehaviourOutput:
        self._facing = self._wait_until_ns = None
        return self._fly_on(0.0, context)

    def _knows(self, seen: TrackedObject) -> bool:
        """Whether the patrol stopped for it within `revisit_s`."""
        known = next((known for known in self._known if self._same(known.object, seen)), None)
        if known is not None and known.object.last_ns < seen.last_ns:
            known.object = seen  # it has another id now
        return known is not None

    def _remember(self, seen: TrackedObject, now_ns: int) -> None:
        others = [known for known in self._known if not self._same(known.object, seen)]
        self._known = [*others, _Known(seen, now_ns + self._command.revisit_s * 1e9)]

    def _same(self, known: TrackedObject, seen: TrackedObject) -> bool:
        if known.object_id == seen.object_id:
            return True
        if known.position_ned_m is None or seen.position_ned_m is None:
            return False
        apart_m = math.dist(known.position_ned_m[:2], seen.position_ned_m[:2])
        return known.class_name == seen.class_name and apart_m <= self._command.merge_radius_m

    def _note(self, text: str) -> None:
        self.add_notes(f"patrol: {text}")


def _named(found: TrackedObject) -> str:
    return found.class_name + ("" if found.track_id is None else f" (track {found.track_id})")


def _place_text(found: TrackedObject, context: BehaviourContext) -> str:
    place, home = found.position_ned_m, home_of(context.state)
    if place is None:
        return f"bearing {in_degrees(found.detection.bearing_rad)}°, range unknown"
    north, east = place[0] - home[0], place[1] - home[1]
    return f"{range_text(found, context)}, {north:.1f} m north and {east:.1f} m east of home"
