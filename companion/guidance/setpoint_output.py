"""The setpoint that is streamed: a behaviour's, after avoidance, obstacle limits and envelope; or a brake."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from companion.guidance.avoidance import Avoidance
from companion.guidance.behaviour import BehaviourContext, Outcome, RoutedSetpoint
from companion.guidance.interface import EventKind, OutputCollector
from companion.guidance.limits.envelope import Envelope, Limits, is_of_height, within_autopilot
from companion.guidance.limits.obstacles import Constraint, ObstacleMemory, ObstacleRules
from companion.guidance.motion import VelocityBias
from companion.vehicle.autopilot_parameters import NOTHING_READ, AutopilotParameters
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import Vector3, VehicleState
from vision.occupancy_grid import Point
from vision.path_planner import PathRequest


class SetpointOutput:
    """Applies avoidance, obstacle limits and envelope to a behaviour's setpoint, or brakes.

    Args:
        lifetime_s: of every setpoint; overrides the behaviour's.
        out: receives the events.

    Attributes:
        streaming: setpoints are sent.
        asked: the last setpoint of a behaviour; None: none is active.
        sent: the last setpoint after the envelope, its velocity corrected by `VelocityBias`, or the brake
            that is streamed while a mode is requested.
        limited_by: names of the limits that changed `sent`.
        path: (north, east) points of the active path around obstacles; empty: none.
        blind: the vehicle brakes because depth is missing, which was reported.
        altitude_acceptance_m: of the autopilot, how far below its goal it ends a climb; None: not known.
    """

    def __init__(
        self, limits: Limits, obstacles: ObstacleRules, lifetime_s: float, out: OutputCollector
    ) -> None:
        self.streaming = False
        self.asked: Setpoint | None = None
        self.sent: Setpoint | None = None
        self.limited_by: tuple[str, ...] = ()
        self.path: tuple[Point, ...] = ()
        self._obstacles = obstacles
        self._lifetime_s = lifetime_s
        self._out = out
        self._limits = limits
        self._read, self._reduced = NOTHING_READ, ""
        self.altitude_acceptance_m: float | None = None
        self._envelope = Envelope(limits)
        self._memory = ObstacleMemory()
        self._avoidance = Avoidance(obstacles.margin_m)
        self._constrained: tuple[BehaviourContext, tuple[Constraint, ...]] | None = None
        self.blind = False

    @property
    def limits(self) -> Limits:
        """The limits of setpoints: the operator's, within the autopilot's."""
        return self._envelope.limits

    @property
    def held_at_height(self) -> bool:
        """Whether a limit of height acts: the last setpoint was to climb or descend faster than sent."""
        return any(map(is_of_height, self.limited_by))

    def use_autopilot(self, read: AutopilotParameters) -> None:
        """Keep setpoints within the autopilot's own limits of speed; report once what they reduce."""
        if read == self._read:
            return
        self._read = read
        self.altitude_acceptance_m = read.altitude_acceptance_m
        self._envelope.limits, self._reduced = within_autopilot(self._limits, read)
        if self._reduced:
            self._out.event(EventKind.NOTED, "", self._reduced)

    def use_limits(self, limits: Limits) -> None:
        """Use the operator's changed limits; what is sent follows with the maximum acceleration."""
        self._limits, before = limits, self._reduced
        within, self._reduced = within_autopilot(limits, self._read)
        self._envelope.change_limits(within)
        if self._reduced and self._reduced != before:
            self._out.event(EventKind.NOTED, "", self._reduced)

    def activate(self) -> None:
        """The behaviour's first update follows."""
        self._avoidance.reset()

    def reset(self) -> None:
        """Our setpoints are active from now on: the envelope starts from the vehicle's own motion."""
        self._envelope.reset()

    def stop(self) -> None:
        """Send no setpoints any more."""
        self._envelope.reset()
        self.streaming = False
        self.asked = self.sent = None
        self.limited_by = self.path = ()

    def brake(self, context: BehaviourContext) -> None:
        """Brake in this step."""
        self.asked, self.limited_by = None, ()
        self.sent = Setpoint.brake(context.now_ns, self._lifetime_s)
        self._envelope.reset()

    def steer(
        self, routed: RoutedSetpoint, context: BehaviourContext, behaviour: str, *, offboard: bool
    ) -> Setpoint | Outcome:
        """A routed setpoint, led around obstacles. `behaviour`: its name. `offboard`: we are in OFFBOARD."""
        constraints = self._obstacle_constraints(context)
        step = self._avoidance.steer(routed, context, constraints, flying=offboard)
        for note, warning in self._avoidance.take_notes():
            self._out.event(EventKind.NOTED, behaviour, note, warning=warning)
        self.path = self._avoidance.path
        return step

    def limit(
        self,
        setpoint: Setpoint,
        context: BehaviourContext,
        dt_s: float,
        behaviour: str,
        bias: VelocityBias,
        *,
        landing: bool,
    ) -> None:
        """Send a setpoint after the envelope; a brake where required depth is missing.

        The envelope limits how the position changes: the command that the autopilot needs for it follows.
        """
        # The lifetime is the operator's setting, not the behaviour's.
        asked = replace(setpoint, deadline_ns=context.now_ns + round(self._lifetime_s * 1e9))
        blind = self._obstacles.blind(context) if self._uses_depth(context) else None
        self._report_perception_fault(behaviour, blind)
        if blind is not None:
            self.brake(context)
            self.asked, self.limited_by = asked, (blind,)
            return
        self._envelope.obstacle_constraints = self._obstacle_constraints(context)
        self.asked = asked
        limited, self.limited_by = self._envelope.apply(
            asked, context.state, context.now_ns, dt_s, context.neighbours, landing=landing
        )
        north_mps, east_mps, _ = limited.velocity_ned_mps or (0.0, 0.0, 0.0)
        # Above the limit after it was lowered, until the vehicle has slowed down.
        top_mps = max(self.limits.max_horizontal_speed_mps, math.hypot(north_mps, east_mps))
        self.sent = bias.command(limited, top_mps)

    def check_goals(self, goals: Sequence[Vector3], state: VehicleState) -> str | None:
        """Why a goal is outside the limits, in words; None: none is. One with a NaN is not checked."""
        found = (self._envelope.check_goal(goal, state) for goal in goals if all(map(math.isfinite, goal)))
        return next((why for why in found if why is not None), None)

    def take_path_request(self) -> PathRequest | None:
        """The path to plan around obstacles, once; None: none is needed."""
        return self._avoidance.take_request()

    def _obstacle_constraints(self, context: BehaviourContext) -> tuple[Constraint, ...]:
        """The obstacle limits of this step."""
        if not self._uses_depth(context):
            return ()
        if self._constrained is None or self._constrained[0] is not context:
            filled = self._memory.filled(context, self._obstacles.margin_m)
            self._constrained = (context, self._obstacles.constraints(filled))
        return self._constrained[1]

    def _uses_depth(self, context: BehaviourContext) -> bool:
        return context.obstacles is not None or self._obstacles.use == "required"

    def _report_perception_fault(self, behaviour: str, blind: str | None) -> None:
        """Log once that the vehicle brakes without depth, and once that depth is back."""
        if (blind is not None) is not self.blind:
            self.blind = blind is not None
            if blind is None:
                self._out.event(EventKind.NOTED, behaviour, "depth is back")
            else:
                self._out.event(EventKind.BLIND, behaviour, f"braking: {blind}", warning=True)
