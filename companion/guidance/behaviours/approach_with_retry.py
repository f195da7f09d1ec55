"""Approach with retries: a lost object is searched where it was last seen, then by a full turn."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, ClassVar

from companion.guidance.behaviour import Behaviour, BehaviourContext, BehaviourOutput, Outcome
from companion.guidance.behaviours.approach import ApproachBehaviour
from companion.guidance.behaviours.seek import SeekBehaviour
from companion.guidance.command import (
    BuildContext,
    ClassName,
    Command,
    GrammarError,
    MarkerId,
    Number,
    TrackId,
    behaviour,
)
from companion.guidance.gimbal.pitch import (
    LEAST_SWEEP_DEG,
    USUAL_RATE_DPS,
    GimbalSweep,
    GimbalTracking,
    GimbalUse,
)
from companion.guidance.motion import position_and_yaw, stay_at
from companion.guidance.objects.closing_check import Approached
from companion.guidance.search_pattern import field_of_view_rad
from companion.vehicle.gimbal import GimbalAim
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import Vector3

# How long to look at the last known position, once the nose points there.
LOOK_BACK_S = 3.0
# Time for half a turn at the slowest useful yaw rate.
LOOK_BACK_LIMIT_S = 12.0
POINTED_RAD = math.radians(6.0)


@behaviour(
    "approach", "fly to an object of the class, a track or a marker, keeping the height, and stop before it"
)
class Approach(Command):
    either: ClassVar[tuple[str, ...]] = ("class", "track", "marker")
    class_name: Annotated[str, ClassName("class", "what to fly to")] = ""
    distance_m: Annotated[
        float, Number("distance", "m", 1.0, 100.0, "where to stop, over ground to its nearest surface")
    ] = 5.0
    speed_mps: Annotated[float, Number("speed", "m/s", 0.2, 10.0, "maximum speed")] = 2.0
    confidence: Annotated[float, Number("confidence", "", 0.05, 1.0, "minimum confidence")] = 0.3
    lost_timeout_s: Annotated[
        float, Number("lost_timeout", "s", 0.5, 60.0, "wait for a lost object this long")
    ] = 5.0
    retries: Annotated[
        float,
        Number(
            "retries",
            "",
            0.0,
            20.0,
            "how often to search for a lost object, unless it is a track or a marker",
        ),
    ] = 2.0
    gimbal: GimbalUse = "leave"
    track_id: Annotated[int | None, TrackId("track", "fly to this track, instead of a class")] = None
    marker_id: Annotated[int | None, MarkerId("marker", "fly to this marker, instead of a class")] = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.retries != int(self.retries):
            raise GrammarError(f"approach: retries must be a whole number, got {self.retries:g}")

    def build(self, context: BuildContext) -> Behaviour:
        tracking = GimbalTracking() if self.gimbal == "track" else None

        def approach() -> ApproachBehaviour:
            return ApproachBehaviour(
                self.class_name,
                track_id=self.track_id,
                marker_id=self.marker_id,
                distance_m=self.distance_m,
                speed_mps=self.speed_mps,
                confidence=self.confidence,
                lost_timeout_s=self.lost_timeout_s,
                tracking=tracking,
            )

        if not self.class_name:
            return approach()  # a search would find another track
        return PersistentApproach(
            approach,
            self.class_name,
            retries=int(self.retries),
            confidence=self.confidence,
            tracking=tracking,
            field_rad=field_of_view_rad(context.footprint),
        )


class PersistentApproach(Behaviour):
    """Approaches; after losing the object looks at its last position, then turns once.

    Args:
        approach: builds a new approach. retries: how often a lost object is searched.
        confidence: minimum for detections of the search.
        tracking: gimbal tracking shared by the approaches; None: the gimbal is not used.
        field_rad: the camera's horizontal field of view.
    """

    name = "approach"

    def __init__(
        self,
        approach: Callable[[], ApproachBehaviour],
        class_name: str,
        *,
        retries: int,
        confidence: float,
        tracking: GimbalTracking | None = None,
        field_rad: float,
    ) -> None:
        self.class_names = (class_name,)
        self._make, self._class_name = approach, class_name
        self._retries, self._confidence = retries, confidence
        self._approach: ApproachBehaviour | None = approach()
        self.requirements = self._approach.requirements
        self._tracking, self._field_rad = tracking, field_rad
        self._seek: SeekBehaviour | None = None
        self._lost_at: Vector3 | None = None
        self._hold_point: Vector3 = (0.0, 0.0, 0.0)
        self._looking_since_ns: int | None = None
        self._begun_ns = 0
        self._tried = 0
        self._why = ""

    def on_activate(self, context: BehaviourContext) -> None:
        self._tried, self._why, self._seek = 0, "", None
        self._approach = self._make()
        self._approach.on_activate(context)

    def update(self, dt_s: float, context: BehaviourContext) -> BehaviourOutput:
        if self._approach is not None:
            step = self._approach.update(dt_s, context)
            lost_at = self._approach.lost_at
            if not isinstance(step, Outcome) or step.success or lost_at is None:
                return step
            self._why, self._lost_at, self._approach = step.reason, lost_at, None
            return self._look_again(context)
        if self._tracking is not None and (why := self._tracking.control_fault(context)) is not None:
            return Outcome(False, f"approach lost the gimbal: {why}")
        if self._seek is None:
            return self._look_back(context)
        step = self._seek.update(dt_s, context)
        if not isinstance(step, Outcome):
            return step
        self._seek = None
        if step.success:
            return self._go_there(context, step.reason)
        if not context.perception_fresh:
            return Outcome(False, f"{self._why}; {step.reason}")
        return self._look_again(context)

    @property
    def approached(self) -> Approached | None:
        return None if self._approach is None else self._approach.approached

    @property
    def gimbal_aim(self) -> GimbalAim | None:
        if self._tracking is None:
            return None
        swept = None if self._seek is None else self._seek.gimbal_aim
        return swept or self._tracking.aim

    @property
    def status(self) -> str:
        if self._approach is not None:
            return self._approach.status
        doing = "where it was" if self._seek is None else "all around"
        return f"lost the {self._class_name}, searching {doing} ({self._tried} of {self._retries})"

    def _look_again(self, context: BehaviourContext) -> BehaviourOutput:
        """Start another search where the object was; the outcome if the retries are used up."""
        if self._tried >= self._retries:
            times = "once" if self._tried == 1 else f"{self._tried} times"
            return Outcome(False, self._why + (f"; searched again {times}" if self._tried else ""))
        self._tried += 1
        self.add_notes(f"approach: {self._why}; searching, {self._tried} of {self._retries}")
        self._hold_point, _ = position_and_yaw(context.state)
        self._looking_since_ns, self._begun_ns = None, context.now_ns
        return self._look_back(context)

    def _look_back(self, context: BehaviourContext) -> BehaviourOutput:
        """Hold with the nose towards the last known position; then turn."""
        assert self._lost_at is not None
        now_ns = context.now_ns
        position, yaw_rad = position_and_yaw(context.state)
        seen = context.objects.seen(self.class_names, self._confidence, self._begun_ns)
        if any(each.certain for each in seen):
            return self._go_there(context, f"found the {self._class_name} where it was")
        bearing_rad = math.atan2(self._lost_at[1] - position[1], self._lost_at[0] - position[0])
        if (
            self._looking_since_ns is None
            and abs(math.remainder(bearing_rad - yaw_rad, math.tau)) < POINTED_RAD
        ):
            self._looking_since_ns = now_ns
        looked_ns = now_ns - (now_ns if self._looking_since_ns is None else self._looking_since_ns)
        if looked_ns > LOOK_BACK_S * 1e9 or now_ns - self._begun_ns > LOOK_BACK_LIMIT_S * 1e9:
            self._seek = SeekBehaviour(
                self._class_name, laps=1.0, confidence=self._confidence, sweep=self._sweep()
            )
            self._seek.on_activate(context)
            return self._seek.update(0.0, context)
        return Setpoint.velocity(stay_at(self._hold_point, position), now_ns, yaw_rad=bearing_rad)

    def _sweep(self) -> GimbalSweep | None:
        """A sweep between the pitch at which the object was lost and level."""
        aim = None if self._tracking is None else self._tracking.aim
        if aim is None or abs(math.degrees(aim.pitch_rad)) < LEAST_SWEEP_DEG:
            return None
        return GimbalSweep(aim.pitch_rad, math.radians(USUAL_RATE_DPS), self._field_rad)

    def _go_there(self, context: BehaviourContext, note: str) -> BehaviourOutput:
        self.add_notes(f"approach: {note}")
        self._approach = self._make()
        self._approach.on_activate(context)
        return self._approach.update(0.0, context)
