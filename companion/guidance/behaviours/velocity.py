"""Velocity: fly the velocities that a program, or a person at keys or a gamepad, sends."""

from __future__ import annotations

import math
from typing import Annotated

from companion.guidance.behaviour import (
    Behaviour,
    BehaviourContext,
    BehaviourOutput,
    Requirement,
    VelocityInput,
)
from companion.guidance.command import BuildContext, Command, Word, behaviour
from companion.guidance.formation.pose import turn_rate
from companion.guidance.motion import (
    HOLD_VELOCITY_GAIN,
    MAX_CORRECTION_MPS,
    Standing,
    add_velocity_error,
    correction,
    position_and_yaw,
    stopping_point,
)
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import Vector3, VehicleState

# Silence of this length is an event.
SILENT_S = 1.0
# Slower turns have ended: the heading of that moment is held.
TURNED_RADPS = 0.1
# Other senders that are reported.
MAX_REPORTED = 8


@behaviour("velocity", "fly the velocities sent on the topic `velocity`; without one, brake and hold")
class Velocity(Command):
    source: Annotated[
        str | None, Word("source", "the sender to obey; default: the first one that is received")
    ] = None

    @property
    def endless(self) -> bool:
        return True

    def build(self, context: BuildContext) -> Behaviour:
        return VelocityBehaviour(self.source)


class VelocityBehaviour(Behaviour):
    """Flies the messages of one sender. Without a valid one, or with one that is zero, it brakes and holds.

    Args:
        source: the sender; None: the first one that is received keeps it.
    """

    name = "velocity"
    requirements = frozenset({Requirement.POSITION, Requirement.IN_AIR})

    def __init__(self, source: str | None = None) -> None:
        self._source = source
        self._others: set[str] = set()
        self._standing: Standing | None = None
        self._down_m: float | None = None
        self._yaw_rad: float | None = None
        self._received_ns: int | None = None
        self._silent = False

    def blocked_by(self, active: Behaviour, context: BehaviourContext) -> str | None:
        """See Behaviour: a sender whose message is active keeps the vehicle."""
        if not isinstance(active, VelocityBehaviour):
            return None
        sources = [one.source for one in _valid(context)]
        if active._source not in sources or (self._source or sources[0]) == active._source:
            return None
        return f"velocity: {active._source} steers; end that by stop or hold first"

    def update(self, dt_s: float, context: BehaviourContext) -> BehaviourOutput:
        message = self._message(context)
        turn_radps = 0.0 if message is None else message.turn_radps
        if message is None or not (message.forward_mps or message.right_mps or message.up_mps):
            if self._standing is None:
                self._standing, self._down_m = Standing(), None
            velocity = self._standing.velocity(context.state, dt_s)
        else:
            self._standing = None
            velocity = self._velocity(message, context.state)
        # After a turn the heading is held where the turn ends.
        if turn_radps or (self._yaw_rad is None and abs(turn_rate(context.state)) > TURNED_RADPS):
            self._yaw_rad = None
            return Setpoint.velocity(velocity, context.now_ns, yaw_rate_radps=turn_radps)
        if self._yaw_rad is None:
            _, self._yaw_rad = position_and_yaw(context.state)
        return Setpoint.velocity(velocity, context.now_ns, yaw_rad=self._yaw_rad)

    def _message(self, context: BehaviourContext) -> VelocityInput | None:
        """The message to fly; None: there is no valid one."""
        valid = _valid(context)
        if self._source is None and valid:
            self._source = valid[0].source
        for other in valid:
            if other.source not in (self._source, *self._others) and len(self._others) < MAX_REPORTED:
                self._others.add(other.source)
                self.add_notes(f"velocities of {other.source} ignored: {self._source} steers")
        own = next((one for one in valid if one.source == self._source), None)
        if own is not None:
            if self._received_ns is None or self._silent:
                self.add_notes(f"{own.source} steers")
            self._received_ns, self._silent = own.received_ns, False
        elif self._received_ns is not None and not self._silent:
            self._silent = context.now_ns - self._received_ns > SILENT_S * 1e9
            if self._silent:
                self.add_notes(f"{self._source} is silent: holding")
        return own

    def _velocity(self, message: VelocityInput, state: VehicleState) -> Vector3:
        """In local NED; without a vertical part the height is held.

        The velocity error is added because of wind: in 3 m/s, 1.5 m/s was flown as 0.9 to 1.2 without it.
        """
        position, yaw_rad = position_and_yaw(state)
        cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
        down_mps = -message.up_mps
        if message.up_mps:
            self._down_m = None
        else:
            if self._down_m is None:
                self._down_m = stopping_point(state)[2]
            down_mps = correction(self._down_m - position[2])
        wanted = (
            message.forward_mps * cos - message.right_mps * sin,
            message.forward_mps * sin + message.right_mps * cos,
        )
        most_mps = math.hypot(*wanted) + MAX_CORRECTION_MPS
        over_ground = add_velocity_error(wanted, state, most_mps, HOLD_VELOCITY_GAIN)
        return (*over_ground, down_mps)

    @property
    def status(self) -> str:
        of = "" if self._source is None else f" of {self._source}"
        if self._received_ns is None:
            return f"velocity{of}, no message yet"
        return f"velocity{of}" + (", silent" if self._silent else "")


def _valid(context: BehaviourContext) -> list[VelocityInput]:
    return [one for one in context.velocities if context.now_ns <= one.expires_ns]
