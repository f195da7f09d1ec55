"""Point the gimbal as a step of a mission: the vehicle holds until it looks there.

An operator's `gimbal` does not pass here: it changes nothing about what flies (`gimbal_controller`).
"""

from __future__ import annotations

import math
from typing import Annotated

from companion.guidance.arguments import Number
from companion.guidance.behaviour import Behaviour, BehaviourContext, BehaviourOutput, Outcome, Requirement
from companion.guidance.behaviours.hold import HoldBehaviour
from companion.guidance.command import BuildContext, Command
from companion.guidance.gimbal.controller import POINT_TIMEOUT_S, POINTED_RAD, direction_text
from companion.guidance.registry import behaviour
from companion.vehicle.gimbal import GimbalAim


@behaviour("gimbal", "point the gimbal, whatever flies; alone: level and ahead")
class Gimbal(Command):
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

    def build(self, context: BuildContext) -> Behaviour:
        return PointGimbalBehaviour(self.aim)


class PointGimbalBehaviour(HoldBehaviour):
    """Holds, and ends when the gimbal looks where it is to look."""

    name = "gimbal"
    requirements = frozenset({Requirement.POSITION, Requirement.IN_AIR, Requirement.GIMBAL})

    def __init__(self, aim: GimbalAim) -> None:
        super().__init__()
        self._aim = aim
        self.gimbal_pitches_rad = (aim.pitch_rad,)

    def update(self, dt_s: float, context: BehaviourContext) -> BehaviourOutput:
        # At the first turn it is still told of what came before.
        if context.gimbal.problem and context.now_ns > self._since_ns:
            return Outcome(False, f"gimbal: {context.gimbal.problem}")
        state, gimbal = context.state, context.state.gimbal
        off_rad = None if gimbal is None else gimbal.off_rad(self._aim, state.yaw_rad or 0.0)
        known = gimbal is not None and gimbal.attitude_fresh(context.now_ns)
        if known and off_rad is not None and off_rad <= POINTED_RAD:
            return Outcome(True, f"the gimbal looks {direction_text(self._aim)}")
        if context.now_ns - self._since_ns > POINT_TIMEOUT_S * 1e9:
            return Outcome(False, f"gimbal: it does not look {direction_text(self._aim)} after all")
        return super().update(dt_s, context)

    @property
    def gimbal_aim(self) -> GimbalAim | None:
        return self._aim

    @property
    def status(self) -> str:
        return f"pointing the gimbal {direction_text(self._aim)}"
