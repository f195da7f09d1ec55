"""Hold: at the goal of the previous behaviour, else where the vehicle comes to rest."""

from __future__ import annotations

import math
from typing import Annotated

from companion.guidance.behaviour import Behaviour, BehaviourContext, BehaviourOutput, Outcome, Requirement
from companion.guidance.command import BuildContext, Command, Number, behaviour
from companion.guidance.motion import (
    HOLD_VELOCITY_GAIN,
    PositionController,
    add_velocity_error,
    ground_speed,
    speed_of,
    stopping_point,
)
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import Vector3

# Above this speed the vehicle brakes before it holds, else it would fly back.
STANDING_MPS = 0.5
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
        self._point: Vector3 | None = None
        self._yaw_rad: float | None = None
        self._since_ns = 0
        self._controller = PositionController()

    def on_activate(self, context: BehaviourContext) -> None:
        self._since_ns = context.now_ns
        self._controller = PositionController()
        self._yaw_rad = context.state.yaw_rad
        goal, position = context.goal_ned_m, context.state.position_ned_m
        near = goal is not None and position is not None and math.dist(goal, position) <= GOAL_NEAR_M
        self._point = goal if near else None

    def update(self, dt_s: float, context: BehaviourContext) -> BehaviourOutput:
        now_ns, state = context.now_ns, context.state
        if self._duration_s and now_ns - self._since_ns >= self._duration_s * 1e9:
            return Outcome(True, f"held for {self._duration_s:g} s", self._point)
        if self._point is None and speed_of(state) < STANDING_MPS:
            self._point = stopping_point(state)
        if self._point is None:
            # Opposes the motion: PX4's integral would carry the vehicle on for seconds.
            braking = add_velocity_error((0.0, 0.0), state, ground_speed(state), HOLD_VELOCITY_GAIN)
            return Setpoint.velocity((*braking, 0.0), now_ns, yaw_rad=self._yaw_rad)
        velocity = self._controller.velocity(self._point, state, dt_s)
        return Setpoint.velocity(velocity, now_ns, yaw_rad=self._yaw_rad)

    @property
    def status(self) -> str:
        return "braking" if self._point is None else "holding"
