"""Area search: fly a pattern until an object of a class is found, then stop and face it."""

from __future__ import annotations

import math
from typing import Annotated

from companion.guidance.behaviour import Behaviour, BehaviourContext, BehaviourOutput, Outcome, Requirement
from companion.guidance.behaviours.confirmation import DetectionConfirmer, YawAligner
from companion.guidance.behaviours.path_flight import PathFlight
from companion.guidance.behaviours.seek import BLIND_TIMEOUT_S, SeekBehaviour, found_text
from companion.guidance.command import (
    BuildContext,
    ClassName,
    Command,
    EnumArgument,
    GrammarError,
    Number,
    behaviour,
)
from companion.guidance.gimbal.pitch import LEAST_SWEEP_DEG, USUAL_RATE_DPS, GimbalSweep
from companion.guidance.motion import ground_speed, position_and_yaw, stay_at
from companion.guidance.objects.target import DOUBTED
from companion.guidance.path import Path
from companion.guidance.search_pattern import Footprint, expanding_square, field_of_view_rad, lawnmower
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import Vector3

STANDING_MPS = 0.4


@behaviour("seek", "turn, or search an area, until an object of the class is found; then face it")
class Seek(Command):
    class_name: Annotated[str, ClassName("class", "what to search for")]
    laps: Annotated[float, Number("laps", "", 0.25, 20.0, "turns before giving up")] = 2.0
    rate_radps: Annotated[float, Number("rate", "rad/s", 0.05, 1.0, "how fast to turn")] = 0.5
    confidence: Annotated[float, Number("confidence", "", 0.05, 1.0, "minimum confidence")] = 0.4
    direction: Annotated[
        str, EnumArgument("direction", ("clockwise", "counterclockwise"), "seen from above")
    ] = "clockwise"
    pattern: Annotated[
        str, EnumArgument("pattern", ("turn", "square", "lawnmower"), "on the spot, or over an area about it")
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
        float | None,
        Number("spacing", "m", 1.0, 200.0, "between strips; default: from the camera's footprint"),
    ] = None
    speed_mps: Annotated[float, Number("speed", "m/s", 0.2, 20.0, "over an area, at most")] = 2.0
    sweep_deg: Annotated[
        float | None,
        Number("sweep", "deg", -90.0, 90.0, "gimbal sweep between level and this pitch; below is negative"),
    ] = None
    sweep_rate_dps: Annotated[
        float, Number("sweep_rate", "deg/s", 2.0, 60.0, "of the gimbal; slower also slows the turn")
    ] = USUAL_RATE_DPS

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.sweep_deg is not None and abs(self.sweep_deg) < LEAST_SWEEP_DEG:
            raise GrammarError(
                f"seek: sweep must be {LEAST_SWEEP_DEG:g} deg or more from level, got {self.sweep_deg:g}"
            )
        if self.sweep_deg is not None and self.pattern != "turn":
            raise GrammarError(f"seek: pattern={self.pattern} does not use sweep")
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
                raise GrammarError(f"seek: pattern={self.pattern} does not use {key}")

    def build(self, context: BuildContext) -> Behaviour:
        if self.pattern != "turn":
            return SearchBehaviour(
                self.class_name,
                radius_m=self.radius_m,
                size_m=None
                if self.width_m is None or self.height_m is None
                else (self.width_m, self.height_m),
                spacing_m=self.spacing_m,
                footprint=context.footprint,
                speed_mps=self.speed_mps,
                confidence=self.confidence,
            )
        sweep = None
        if self.sweep_deg is not None:
            sweep_rad, rate_radps = math.radians(self.sweep_deg), math.radians(self.sweep_rate_dps)
            sweep = GimbalSweep(sweep_rad, rate_radps, field_of_view_rad(context.footprint))
        return SeekBehaviour(
            self.class_name,
            laps=self.laps,
            rate_radps=self.rate_radps,
            confidence=self.confidence,
            clockwise=self.direction == "clockwise",
            whole_turn=True,
            sweep=sweep,
        )


class SearchBehaviour(PathFlight):
    """Flies an expanding square or a lawnmower pattern about its start, nose along the path.

    Args:
        radius_m: half a side of the expanding square. size_m: (west to east, south to north) of the
            lawnmower's area. Exactly one of them.
        spacing_m: between strips; None: from `footprint` at the current height.
    """

    name = "seek"
    requirements = frozenset({Requirement.POSITION, Requirement.IN_AIR, Requirement.PERCEPTION})

    def __init__(
        self,
        class_name: str,
        *,
        radius_m: float | None = None,
        size_m: tuple[float, float] | None = None,
        spacing_m: float | None = None,
        footprint: Footprint | None = None,
        speed_mps: float = 2.0,
        confidence: float = 0.4,
    ) -> None:
        super().__init__(speed_mps)
        if (radius_m is None) == (size_m is None):
            raise ValueError("a search needs exactly one of radius_m and size_m")
        self.class_names = (class_name,)
        self._class_name = class_name
        self._radius_m, self._size_m = radius_m, size_m
        self._spacing_m, self._footprint = spacing_m, footprint
        self._confirmer = DetectionConfirmer((class_name,), confidence)
        self._aligner: YawAligner | None = None
        self._stop: Vector3 | None = None
        self._blind_since_ns: int | None = None

    def on_activate(self, context: BehaviourContext) -> None:
        super().on_activate(context)
        self._confirmer.reset(context.now_ns)
        self._aligner = self._stop = self._blind_since_ns = None

    def update(self, dt_s: float, context: BehaviourContext) -> BehaviourOutput:
        now_ns = context.now_ns
        position, yaw_rad = position_and_yaw(context.state)
        if not context.perception_fresh:
            self._blind_since_ns = now_ns if self._blind_since_ns is None else self._blind_since_ns
            if now_ns - self._blind_since_ns > BLIND_TIMEOUT_S * 1e9:
                why = context.perception_fault("no detections received")
                return Outcome(False, f"{why} for {BLIND_TIMEOUT_S:g} s")
            return self._stand(context, position, yaw_rad)
        self._blind_since_ns = None
        if self._aligner is not None:
            self._aligner.follow(self._confirmer.fresh(context))
            if self._aligner.faced(yaw_rad, now_ns):
                return Outcome(True, found_text(self._aligner.target))
            if not self._aligner.lost(now_ns):
                return self._stand(context, position, self._aligner.target.bearing_rad)
            self._aligner = None
            self._confirmer.forget()
        elif (found := self._confirmer.update(context)) is not None:
            self._aligner, self._stop = YawAligner(found, now_ns), None
            return self._stand(context, position, found.bearing_rad)
        if self._stop is not None:
            self._stop = None
            self.resume(context)
        step = super().update(dt_s, context)
        if isinstance(step, Outcome) and step.success:
            why = f": {DOUBTED}" if self._confirmer.doubted else ""
            return Outcome(False, f"no {self._class_name} found in the area{why}")
        return step

    @property
    def status(self) -> str:
        if self._aligner is not None:
            return f"facing the {self._class_name}"
        return f"searching an area for a {self._class_name}{super().status.removeprefix(self.name)}"

    def _stand(self, context: BehaviourContext, position: Vector3, bearing_rad: float) -> Setpoint:
        if self._stop is None and ground_speed(context.state) < STANDING_MPS:
            self._stop = position
        velocity = (0.0, 0.0, 0.0) if self._stop is None else stay_at(self._stop, position)
        return Setpoint.velocity(velocity, context.now_ns, yaw_rad=bearing_rad)

    def _path(self, context: BehaviourContext) -> Path:
        position, _ = position_and_yaw(context.state)
        spacing_m = self._spacing_m
        if spacing_m is None:
            if self._footprint is None:
                raise ValueError("camera footprint unknown: set spacing")
            spacing_m = self._footprint.spacing_m(context.state.altitude_m or 0.0)
        if self._radius_m is not None:
            points = expanding_square(self._radius_m, spacing_m)
        else:
            assert self._size_m is not None
            points = lawnmower(*self._size_m, spacing_m)
        path = [(position[0] + north, position[1] + east, position[2]) for north, east in points]
        if self._radius_m is not None and len(points) == 1:
            raise ValueError(f"one strip of {spacing_m:.0f} m covers the area: use pattern=turn")
        return Path([position, *path], self._speed_mps)

    def _success_text(self) -> str:
        return "whole area searched"
