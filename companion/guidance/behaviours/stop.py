"""Stop: hand the vehicle over to the autopilot's hold mode."""

from __future__ import annotations

from companion.guidance.behaviour import Behaviour, BehaviourContext, BehaviourOutput, ModeRequest, Outcome
from companion.guidance.command import BuildContext, Command, behaviour
from companion.vehicle.state import FlightMode

TIMEOUT_S = 5.0


@behaviour("stop", "end offboard control; the autopilot holds the position")
class Stop(Command):
    def build(self, context: BuildContext) -> Behaviour:
        return StopBehaviour()


class StopBehaviour(Behaviour):
    """Requests HOLD and ends when the autopilot shows it."""

    name = "stop"

    def __init__(self) -> None:
        self._until_ns: float = 0
        self._asked = False

    def on_activate(self, context: BehaviourContext) -> None:
        self._until_ns = context.now_ns + TIMEOUT_S * 1e9
        self._asked = False

    def update(self, dt_s: float, context: BehaviourContext) -> BehaviourOutput:
        mode = context.state.mode
        if self._asked and mode is FlightMode.HOLD:
            return Outcome(True, "stopped: the autopilot holds")
        if context.now_ns > self._until_ns:
            return Outcome(False, f"hold mode not reached in {TIMEOUT_S:g} s: {mode.value} mode")
        self._asked = True
        return ModeRequest(FlightMode.HOLD)
