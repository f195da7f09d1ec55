"""The autopilot's landing modes: land here, or return and land."""

from __future__ import annotations

import math

from companion.guidance.behaviour import (
    Behaviour,
    BehaviourContext,
    BehaviourOutput,
    ModeRequest,
    Outcome,
    Requirement,
)
from companion.guidance.command import BuildContext, Command, behaviour
from companion.vehicle.state import FlightMode, LandedState, VehicleState

# MPC_LAND_SPEED is 0.7 m/s by default, plus landing detection and PX4's delay to disarm (COM_DISARM_LAND).
SLOWEST_DESCENT_MPS = 0.4
GROUND_TIMEOUT_S = 30.0
# RTL climbs to RTL_RETURN_ALT (30 m) first, then cruises at 5 m/s; generous bounds of both.
RETURN_ALTITUDE_M = 60.0
SLOWEST_RETURN_MPS = 1.5


@behaviour("land", "land here and disarm")
class Land(Command):
    def build(self, context: BuildContext) -> Behaviour:
        return LandBehaviour()


@behaviour("rtl", "return to home, land and disarm")
class Rtl(Command):
    def build(self, context: BuildContext) -> Behaviour:
        return ReturnBehaviour()


class LandBehaviour(Behaviour):
    """Lands at the current position, and ends when the autopilot has disarmed."""

    name = "land"
    requirements: frozenset[Requirement] = frozenset()
    mode = FlightMode.LAND
    did = "landed"

    def __init__(self) -> None:
        self._until_ns: float = 0
        self._landed = LandedState.UNKNOWN
        self._flew = False

    def on_activate(self, context: BehaviourContext) -> None:
        self._until_ns = context.now_ns + self.timeout_s(context.state) * 1e9
        self._flew = context.state.armed

    def update(self, dt_s: float, context: BehaviourContext) -> BehaviourOutput:
        state = context.state
        self._landed = state.landed
        self._flew |= state.armed
        if not state.armed and state.landed is LandedState.ON_GROUND:
            return Outcome(
                True, f"{self.did} and disarmed" if self._flew else "already on the ground, disarmed"
            )
        if context.now_ns > self._until_ns:
            armed = "armed" if state.armed else "disarmed"
            return Outcome(
                False, f"{self.name} timed out: {state.landed.value.replace('_', ' ')} and {armed}"
            )
        return ModeRequest(self.mode)

    def timeout_s(self, state: VehicleState) -> float:
        """Time-out from this state, seconds."""
        return GROUND_TIMEOUT_S + max(0.0, state.altitude_m or 0.0) / SLOWEST_DESCENT_MPS

    @property
    def status(self) -> str:
        return "on the ground" if self._landed is LandedState.ON_GROUND else f"{self.mode.value} mode"


class ReturnBehaviour(LandBehaviour):
    """Returns to home, lands there, and ends when the autopilot has disarmed."""

    name = "rtl"
    mode = FlightMode.RETURN
    did = "returned, landed"

    def timeout_s(self, state: VehicleState) -> float:
        north, east, _ = state.position_ned_m or (0.0, 0.0, 0.0)
        home_north, home_east, _ = state.home_position_ned_m or (0.0, 0.0, 0.0)
        away_m = math.hypot(north - home_north, east - home_east)
        climbed_m = max(RETURN_ALTITUDE_M, state.altitude_m or 0.0)
        return GROUND_TIMEOUT_S + away_m / SLOWEST_RETURN_MPS + 2.0 * climbed_m / SLOWEST_DESCENT_MPS
