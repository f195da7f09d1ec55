"""Stay where you are: the position and the heading of the moment it was asked for."""

from __future__ import annotations

import math

from companion.guidance.behaviour import Behaviour, Outcome, Requirement, Situation, Step
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import Vector3

# Above this a vehicle brakes first: held at once, it would fly back to where the command reached it.
STANDING_MPS = 0.5


class HoldBehaviour(Behaviour):
    """Holds until `duration_s` is over; 0: until another command comes."""

    name = "hold"
    requirements = frozenset({Requirement.POSITION, Requirement.IN_AIR})

    def __init__(self, duration_s: float = 0.0) -> None:
        self._duration_s = duration_s
        self._place: Vector3 | None = None
        self._yaw_rad: float | None = None
        self._since_ns = 0

    def on_activate(self, situation: Situation) -> None:
        self._since_ns = situation.now_ns
        self._place = None
        self._yaw_rad = situation.state.yaw_rad

    def update(self, dt_s: float, situation: Situation) -> Step:
        now_ns, state = situation.now_ns, situation.state
        if self._duration_s and now_ns - self._since_ns >= self._duration_s * 1e9:
            return Outcome(True, f"held for {self._duration_s:g} s")
        if self._place is None and math.hypot(*(state.velocity_ned_mps or (0.0, 0.0, 0.0))) < STANDING_MPS:
            self._place = state.position_ned_m
        if self._place is None:
            return Setpoint.velocity((0.0, 0.0, 0.0), now_ns, yaw_rad=self._yaw_rad)
        return Setpoint.position(self._place, now_ns, yaw_rad=self._yaw_rad)

    @property
    def status(self) -> str:
        return "braking" if self._place is None else "holding"
