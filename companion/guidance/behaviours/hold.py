"""Stay in place: at the goal of what was flown before, else where the vehicle comes to rest."""

from __future__ import annotations

import math
from typing import Annotated

from companion.guidance.arguments import Number
from companion.guidance.behaviour import Behaviour, BehaviourContext, BehaviourOutput, Outcome, Requirement
from companion.guidance.command import BuildContext, Command
from companion.guidance.motion import (
    HOLD_VELOCITY_GAIN,
    PositionController,
    ground_speed,
    pressed,
    speed_of,
    stopping_point,
)
from companion.guidance.registry import behaviour
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import Vector3

# Above this a vehicle brakes first: held at once, it would fly back to where the command reached it.
STANDING_MPS = 0.5
# The goal of the behaviour before is held where the vehicle is so near. An arrival is said within 0.3 m; a
# gust, or the second in which a mode changes, moves a vehicle by less than this. Farther away something else
# holds it back (a limit, an obstacle, a neighbour), and nobody asked to fly there now.
GOAL_NEAR_M = 1.0


@behaviour("hold", "stay here, under our command")
class Hold(Command):
    duration_s: Annotated[
        float, Number("duration", "s", 0.0, 3600.0, "how long; 0: until another command")
    ] = 0.0

    @property
    def endless(self) -> bool:
        return self.duration_s == 0.0

    def build(self, context: BuildContext) -> Behaviour:
        return HoldBehaviour(self.duration_s)


class HoldBehaviour(Behaviour):
    """Holds until `duration_s` is over; 0: until another command comes.

    The heading is that of the moment it begins.
    """

    name = "hold"
    requirements = frozenset({Requirement.POSITION, Requirement.IN_AIR})

    def __init__(self, duration_s: float = 0.0) -> None:
        self._duration_s = duration_s
        self._place: Vector3 | None = None
        self._yaw_rad: float | None = None
        self._since_ns = 0
        self._controller = PositionController()

    def on_activate(self, context: BehaviourContext) -> None:
        self._since_ns = context.now_ns
        self._controller = PositionController()
        self._yaw_rad = context.state.yaw_rad
        goal, position = context.goal_ned_m, context.state.position_ned_m
        near = goal is not None and position is not None and math.dist(goal, position) <= GOAL_NEAR_M
        self._place = goal if near else None

    def update(self, dt_s: float, context: BehaviourContext) -> BehaviourOutput:
        now_ns, state = context.now_ns, context.state
        if self._duration_s and now_ns - self._since_ns >= self._duration_s * 1e9:
            return Outcome(True, f"held for {self._duration_s:g} s", self._place)
        if self._place is None and speed_of(state) < STANDING_MPS:
            self._place = stopping_point(state)
        if self._place is None:
            # The other way: PX4's integral would carry the vehicle on for seconds.
            braking = pressed((0.0, 0.0), state, ground_speed(state), HOLD_VELOCITY_GAIN)
            return Setpoint.velocity((*braking, 0.0), now_ns, yaw_rad=self._yaw_rad)
        velocity = self._controller.velocity(self._place, state, dt_s)
        return Setpoint.velocity(velocity, now_ns, yaw_rad=self._yaw_rad)

    @property
    def status(self) -> str:
        return "braking" if self._place is None else "holding"
