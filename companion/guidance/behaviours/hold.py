"""Hold: at the goal of the previous behaviour, else where the vehicle comes to rest."""

from __future__ import annotations

import math
from typing import Annotated

from companion.guidance.behaviour import Behaviour, BehaviourContext, BehaviourOutput, Outcome, Requirement
from companion.guidance.command import BuildContext, Command, Number, behaviour
from companion.guidance.motion import Standing

# The previous goal is held only within this distance. Arrival is reported within 0.3 m, and a gust or a mode
# change of 1 s moves a vehicle by less than this. Farther away something else holds it back (a limit, an
# obstacle, a neighbour), and the goal must not be flown to now.
GOAL_NEAR_M = 1.0


@behaviour("hold", "hold the current position by setpoints")
class Hold(Command):
    endless_without = "duration_s"
    duration_s: Annotated[
        float, Number("duration", "s", 0.0, 3600.0, "how long; 0: until another command")
    ] = 0.0

    def build(self, context: BuildContext) -> Behaviour:
        return HoldBehaviour(self.duration_s)


class HoldBehaviour(Behaviour):
    """Holds for `duration_s`; 0: until another command.

    The heading is the one at its start.
    """

    name = "hold"
    requirements = frozenset({Requirement.POSITION, Requirement.IN_AIR})

    def __init__(self, duration_s: float = 0.0) -> None:
        self._duration_s = duration_s
        self._standing = Standing()
        self._yaw_rad: float | None = None
        self._since_ns = 0

    def on_activate(self, context: BehaviourContext) -> None:
        self._since_ns = context.now_ns
        self._yaw_rad = context.state.yaw_rad
        goal, position = context.goal_ned_m, context.state.position_ned_m
        near = goal is not None and position is not None and math.dist(goal, position) <= GOAL_NEAR_M
        self._standing = Standing(goal if near else None)

    def update(self, dt_s: float, context: BehaviourContext) -> BehaviourOutput:
        if self._duration_s and context.now_ns - self._since_ns >= self._duration_s * 1e9:
            return Outcome(True, f"held for {self._duration_s:g} s", self._standing.point)
        return self._standing.setpoint(context.state, context.now_ns, dt_s, self._yaw_rad)

    @property
    def status(self) -> str:
        return "braking" if self._standing.point is None else "holding"
