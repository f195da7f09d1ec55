"""Patrol: fly a closed path repeatedly, stop for detected objects, then continue."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar

from companion.geometry.points import points_from
from companion.guidance.behaviour import Behaviour, BehaviourContext, BehaviourOutput, Outcome, Requirement
from companion.guidance.behaviours.approach import ApproachBehaviour
from companion.guidance.behaviours.confirmation import DetectionConfirmer, YawAligner
from companion.guidance.behaviours.follow_path import FollowPathBehaviour
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
from companion.guidance.motion import ground_speed, home_of, position_and_yaw, stay_at
from companion.guidance.objects.closing_check import Approached
from companion.guidance.objects.target import Target
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import Vector3

# Slower than this the vehicle counts as stopped, and holds.
STANDING_MPS = 0.4
# A patrol ends after this time without a frame.
BLIND_TIMEOUT_S = 10.0


@dataclass(slots=True)
class _Known:
    """An object for which the patrol has stopped."""

    class_name: str
    track_id: int | None
    position_ned_m: Vector3 | None
    until_ns: float


@behaviour("patrol", "fly a closed path repeatedly, and stop for detected objects")
class Patrol(Command):
    renamed: ClassVar[Mapping[str, str]] = {
        "do": "on_detection",
        "wait": "dwell",
        "again": "revisit",
        "apart": "merge_radius",
    }
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
        float, Number("merge_radius", "m", 0.5, 100.0, "detections within this distance are one object")
    ] = 5.0
    speed_mps: Annotated[float, Number("speed", "m/s", 0.2, 20.0, "maximum speed")] = 3.0
    laps: Annotated[float, Number("laps", "", 0.0, 1000.0, "how many; 0: until another command")] = 0.0
    confidence: Annotated[float, Number("confidence", "", 0.05, 1.0, "minimum confidence")] = 0.4

    @property
    def endless(self) -> bool:
        return self.laps == 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.points_m) < 2:
            raise GrammarError(f"patrol: points must be at least 2 points, got {len(self.points_m)}")

    @property
    def points_m(self) -> tuple[tuple[float, ...], ...]:
        """(north, east) or (north, east, height) of each point, metres from home."""
        return points_from(self.points)

    @property
    def names(self) -> tuple[str, ...]:
        """The class names as a tuple."""
        return names_in(self.class_names)

    def build(self, context: BuildContext) -> Behaviour:
        return PatrolBehaviour(
            self.points_m,
            self.names,
            speed_mps=self.speed_mps,
            laps=self.laps,
            approach_m=self.distance_m if self.on_detection == "approach" else None,
            dwell_s=self.dwell_s,
            revisit_s=self.revisit_s,
            merge_radius_m=self.merge_radius_m,
            confidence=self.confidence,
        )


class PatrolBehaviour(Behaviour):
    """Flies the closed path; stops for a confirmed object, turns to it and logs its position.

    Args:
        points: (north, east) or (north, east, height) metres from home; a closed path.
        speed_mps: along the path. laps: 0: until another command.
        approach_m: distance to which to approach a find; None: face it from the path.
        dwell_s: time spent at an object.
        revisit_s: an object does not stop the patrol again within this time.
        merge_radius_m: detections within this distance of an object's position belong to it.
    """

    name = "patrol"
    requirements = frozenset({Requirement.POSITION, Requirement.IN_AIR, Requirement.PERCEPTION})

    def __init__(
        self,
        points: Sequence[tuple[float, ...]],
        class_names: Collection[str],
        *,
        speed_mps: float = 3.0,
        laps: float = 0.0,
        approach_m: float | None = None,
        dwell_s: float = 5.0,
        revisit_s: float = 120.0,
        merge_radius_m: float = 5.0,
        confidence: float = 0.4,
    ) -> None:
        self.class_names = tuple(class_names)
        if approach_m is not None:
            self.requirements = PatrolBehaviour.requirements | {Requirement.DEPTH_OR_SIZE}
        self._route = FollowPathBehaviour(points, speed_mps, laps=laps, round_trip=True)
        self._confirmer = DetectionConfirmer(class_names, confidence)
        self._speed_mps, self._confidence = speed_mps, confidence
        self._approach_m, self._dwell_s = approach_m, dwell_s
        self._revisit_s, self._merge_radius_m = revisit_s, merge_radius_m
        self._known: list[_Known] = []
        self._aligner: YawAligner | None = None
        self._reported = False
        self._approach: ApproachBehaviour | None = None
        self._wait_until_ns: float | None = None
        self._stop: Vector3 | None = None
        self._down_m = 0.0
        self._blind_since_ns: int | None = None
        self._found = 0

    def goals(self, context: BehaviourContext) -> tuple[Vector3, ...]:
        """See Behaviour."""
        return self._route.goals(context)

    def on_activate(self, context: BehaviourContext) -> None:
        self._route.on_activate(context)
        self._confirmer.reset(context.now_ns)
        self._known.clear()
        self._aligner = self._approach = self._stop = self._blind_since_ns = self._wait_until_ns = None
        self._found = 0

    def update(self, dt_s: float, context: BehaviourContext) -> BehaviourOutput:
        position, yaw_rad = position_and_yaw(context.state)
        if self._approach is not None:
            return self._fly_there(self._approach, dt_s, context, position)
        if not context.perception_fresh:
            return self._wait_blind(context, position)
        self._blind_since_ns = None
        if self._aligner is not None:
            return self._inspect(self._aligner, context, position, yaw_rad)
        found = self._confirmer.update(context, lambda target: not self._known_already(target, context))
        if found is not None:
            self._aligner, self._reported, self._stop = YawAligner(found, context.now_ns), False, None
            self._down_m = position[2]
            return self._stand(context, position, found.bearing_rad)
        if self._stop is not None:
            # It stopped while perception was stale.
            self._resume(context)
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
        if self._aligner is not None:
            return f"patrol, facing a {self._aligner.target.class_name}"
        return self._route.status.replace(self._route.name, "patrol", 1)

    def _inspect(
        self, aligner: YawAligner, context: BehaviourContext, position: Vector3, yaw_rad: float
    ) -> BehaviourOutput:
        """Stop, face the object and log it; then approach it, or dwell."""
        now_ns = context.now_ns
        aligner.follow(self._confirmer.fresh(context))
        if self._wait_until_ns is not None:
            self._remember(aligner.target, now_ns)
            if now_ns >= self._wait_until_ns:
                return self._go_on(context)
        elif aligner.lost(now_ns):
            self._note(f"lost a {_named(aligner.target)} before facing it")
            self._remember(aligner.target, now_ns)
            return self._go_on(context)
        elif aligner.faced(yaw_rad, now_ns):
            self._found += 1
            self._remember(aligner.target, now_ns)
            self._note(f"found a {_named(aligner.target)}, {self._position_text(aligner.target, context)}")
            if self._approach_m is not None:
                self._approach = ApproachBehaviour(
                    aligner.target.class_name,
                    distance_m=self._approach_m,
                    speed_mps=min(self._speed_mps, 3.0),
                    confidence=min(0.3, self._confidence),
                )
                self._approach.on_activate(context)
                return self._fly_there(self._approach, 0.0, context, position)
            self._wait_until_ns = now_ns + self._dwell_s * 1e9
        return self._stand(context, position, aligner.target.bearing_rad)

    def _fly_there(
        self, approach: ApproachBehaviour, dt_s: float, context: BehaviourContext, position: Vector3
    ) -> BehaviourOutput:
        step = approach.update(dt_s, context)
        if not isinstance(step, Outcome):
            return step
        approach.on_deactivate()
        self._approach = None
        self._note(step.reason)
        # The object ahead is the one approached: it is still updated while waiting.
        self._stop, self._wait_until_ns = None, context.now_ns + self._dwell_s * 1e9
        _, yaw_rad = position_and_yaw(context.state)
        return self._stand(context, position, yaw_rad)

    def _stand(self, context: BehaviourContext, position: Vector3, bearing_rad: float) -> Setpoint:
        """Brake, hold where the vehicle comes to rest, nose to a bearing."""
        if self._stop is None and ground_speed(context.state) < STANDING_MPS:
            self._stop = (position[0], position[1], self._down_m)
        velocity = (0.0, 0.0, 0.0) if self._stop is None else stay_at(self._stop, position)
        return Setpoint.velocity(velocity, context.now_ns, yaw_rad=bearing_rad)

    def _go_on(self, context: BehaviourContext) -> BehaviourOutput:
        self._aligner = self._wait_until_ns = None
        self._confirmer.forget()
        self._resume(context)
        return self._route.update(0.0, context)

    def _resume(self, context: BehaviourContext) -> None:
        self._stop = None
        self._route.resume(context)

    def _wait_blind(self, context: BehaviourContext, position: Vector3) -> BehaviourOutput:
        """Perception is stale: stop, so that no part of the path is flown unseen."""
        now_ns = context.now_ns
        if self._blind_since_ns is None:
            self._blind_since_ns, self._down_m, self._stop = now_ns, position[2], None
        if now_ns - self._blind_since_ns > BLIND_TIMEOUT_S * 1e9:
            why = context.perception_fault("no detections received")
            return Outcome(False, f"{why} for {BLIND_TIMEOUT_S:g} s")
        _, yaw_rad = position_and_yaw(context.state)
        return self._stand(context, position, yaw_rad)

    def _known_already(self, target: Target, context: BehaviourContext) -> bool:
        """Whether the patrol stopped for it within `revisit_s`. Updates the position of a moving object."""
        self._known = [known for known in self._known if known.until_ns > context.now_ns]
        for known in self._known:
            if self._same(known, target):
                _update(known, target)
                return True
        return False

    def _remember(self, target: Target, now_ns: int) -> None:
        until_ns = now_ns + self._revisit_s * 1e9
        for known in self._known:
            if self._same(known, target):
                _update(known, target)
                known.until_ns = until_ns
                return
        self._known.append(_Known(target.class_name, target.track_id, target.position_ned_m, until_ns))

    def _same(self, known: _Known, target: Target) -> bool:
        if known.class_name != target.class_name:
            return False
        if known.track_id is not None and known.track_id == target.track_id:
            return True
        if known.position_ned_m is None or target.position_ned_m is None:
            return False
        return math.dist(known.position_ned_m[:2], target.position_ned_m[:2]) <= self._merge_radius_m

    def _position_text(self, target: Target, context: BehaviourContext) -> str:
        position = target.position_ned_m
        if position is None:
            return f"bearing {math.degrees(target.bearing_rad) % 360:.0f}°, range unknown"
        home = home_of(context.state)
        north, east = position[0] - home[0], position[1] - home[1]
        return f"{target.ground_range_m:.1f} m away, {north:.1f} m north and {east:.1f} m east of home"

    def _note(self, text: str) -> None:
        self.add_notes(f"patrol: {text}")


def _named(target: Target) -> str:
    return target.class_name + ("" if target.track_id is None else f" (track {target.track_id})")


def _update(known: _Known, target: Target) -> None:
    known.position_ned_m = target.position_ned_m or known.position_ned_m
    known.track_id = target.track_id if target.track_id is not None else known.track_id
