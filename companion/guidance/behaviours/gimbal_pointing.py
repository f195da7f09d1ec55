"""Point the gimbal as a step of a mission: the vehicle holds until the gimbal has turned.

An operator's `gimbal` command does not use this behaviour (see `gimbal.controller`).
"""

from __future__ import annotations

import math
from typing import Annotated

from companion.guidance.behaviour import Behaviour, BehaviourContext, BehaviourOutput, Outcome, Requirement
from companion.guidance.behaviours.hold import HoldBehaviour
from companion.guidance.command import (
    SUBJECT_KEYS,
    BuildContext,
    Command,
    GrammarError,
    Number,
    behaviour,
    both_of,
)
from companion.guidance.gimbal.controller import POINT_TIMEOUT_S, POINTED_RAD, direction_text
from companion.guidance.gimbal.pointing import Pointing
from companion.guidance.objects.tracked_object import GimbalGoal, GlobalPoint, Subject
from companion.vehicle.gimbal import GimbalAim


@behaviour(
    "gimbal",
    "point the gimbal during any behaviour, or keep it on an object or a place; default: level and ahead",
)
class Gimbal(Command):
    pitch_deg: Annotated[
        float, Number("pitch", "deg", -90.0, 90.0, "above the horizon; below is negative")
    ] = 0.0
    yaw_deg: Annotated[float, Number("yaw", "deg", -180.0, 180.0, "clockwise from the nose")] = 0.0
    subject: Subject | None = None
    latitude_deg: Annotated[
        float | None,
        Number("latitude", "deg", -90.0, 90.0, "of a place to keep it on, WGS 84; needs longitude"),
    ] = None
    longitude_deg: Annotated[
        float | None, Number("longitude", "deg", -180.0, 180.0, "WGS 84; needs latitude")
    ] = None
    altitude_m: Annotated[
        float | None, Number("altitude", "m", -500.0, 5000.0, "of the place above home; default: 0")
    ] = None

    def __post_init__(self) -> None:
        super().__post_init__()
        place = (self.latitude_deg, self.longitude_deg, self.altitude_m)
        given = {
            "pitch and yaw": bool(self.pitch_deg or self.yaw_deg),
            SUBJECT_KEYS: self.subject is not None,
            "latitude and longitude": place != (None, None, None),
        }
        if sum(given.values()) > 1:
            got = both_of([name for name, is_given in given.items() if is_given])
            raise GrammarError(f"gimbal: give only one of {', '.join(given)}; got {got}")
        if given["latitude and longitude"] and None in place[:2]:
            raise GrammarError("gimbal: give both latitude and longitude; one is missing")

    @property
    def aim(self) -> GimbalGoal:
        """Where to point it."""
        if self.subject is not None:
            return self.subject
        if self.latitude_deg is not None and self.longitude_deg is not None:
            return GlobalPoint(self.latitude_deg, self.longitude_deg, self.altitude_m or 0.0)
        return GimbalAim(math.radians(self.pitch_deg), math.radians(self.yaw_deg))

    def build(self, context: BuildContext) -> Behaviour:
        return PointGimbalBehaviour(self.aim)


class PointGimbalBehaviour(HoldBehaviour):
    """Holds, and ends when the gimbal points at the goal."""

    name = "gimbal"
    requirements = frozenset({Requirement.POSITION, Requirement.IN_AIR, Requirement.GIMBAL})

    def __init__(self, goal: GimbalGoal) -> None:
        super().__init__()
        self._goal, self._pointing = goal, Pointing(goal)
        self._problem: str | None = None
        if isinstance(goal, Subject):
            self.subject = goal
        elif isinstance(goal, GimbalAim):
            self.gimbal_pitches_rad = (goal.pitch_rad,)

    @property
    def needs(self) -> frozenset[Requirement]:
        return self.requirements  # a direction is enough

    def on_activate(self, context: BehaviourContext) -> None:
        super().on_activate(context)
        self._pointing = Pointing(self._goal)
        self._problem = self._pointing.begin(context)

    def update(self, dt_s: float, context: BehaviourContext) -> BehaviourOutput:
        # The first update still shows the previous owner's problem.
        if context.gimbal.problem and context.now_ns > self._since_ns:
            return Outcome(False, f"gimbal: {context.gimbal.problem}")
        if (why := self._problem or self._pointing.update(context)) is not None:
            return Outcome(False, f"gimbal: {why}")
        state, gimbal, aim = context.state, context.state.gimbal, self._pointing.aim
        assert aim is not None
        off_rad = None if gimbal is None else gimbal.off_rad(aim, state.yaw_rad or 0.0)
        known = gimbal is not None and gimbal.attitude_fresh(context.now_ns)
        if known and off_rad is not None and off_rad <= POINTED_RAD:
            return Outcome(True, f"gimbal points {direction_text(aim)}")
        if context.now_ns - self._since_ns > POINT_TIMEOUT_S * 1e9:
            return Outcome(False, f"gimbal: not pointing {direction_text(aim)} after {POINT_TIMEOUT_S:g} s")
        return super().update(dt_s, context)

    @property
    def gimbal_aim(self) -> GimbalAim | None:
        return self._pointing.aim

    @property
    def status(self) -> str:
        aim = self._pointing.aim
        return "pointing the gimbal" if aim is None else f"pointing the gimbal {direction_text(aim)}"
