"""Take off with the autopilot's own take-off mode, and finish the climb if it stops short.

PX4 ends its take-off as soon as it is within its acceptance radius (NAV_MC_ALT_RAD) of the height. Of a low
one that is near the ground, and by the drift of the height on it (v1.16.2 and v1.18.0-beta1). So a low
take-off arms in HOLD and climbs in OFFBOARD from the ground; there every other mode is a pilot's.
"""

from __future__ import annotations

from typing import Annotated

from companion.guidance.behaviour import (
    Behaviour,
    BehaviourContext,
    BehaviourOutput,
    ModeRequest,
    Outcome,
    Requirement,
)
from companion.guidance.command import BuildContext, Command, Number, behaviour
from companion.guidance.motion import (
    ARRIVED_M,
    ARRIVED_MPS,
    AT_LIMIT_M,
    POSITION_GAIN,
    Lasting,
    PositionController,
    towards,
)
from companion.vehicle.autopilot_parameters import DEFAULT_ACCEPTANCE_M
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import FlightMode, LandedState, Vector3, VehicleState

# PX4 ends a take-off inside its altitude acceptance radius (NAV_MC_ALT_RAD, 0.8 m) and holds there: measured
# 1.8-2.2 m of 2.5 m. An error beyond this tolerance is climbed by setpoint.
ALTITUDE_TOLERANCE_M = ARRIVED_M
# Time for the autopilot's hold to settle before the height is checked.
SETTLE_S = 1.0
# Arrival needs this long within the tolerance.
THERE_S = 0.5
# Arming and spooling up, plus a climb at 0.5 m/s.
BASE_TIMEOUT_S = 25.0
SLOWEST_CLIMB_MPS = 0.5
CLIMB_MPS = 1.0
# Horizontal correction in a climb by setpoint. The estimate may move by a metre as a vehicle lifts off: a
# position hold commanded 2 m/s, of which PX4 v1.18.0-beta1 flew 0.6 m/s, and the take-off ended.
SIDEWAYS_MPS = 0.5
# PX4's own take-off is used from this far above its acceptance radius: its height may drift by 0.5 m, and it
# still climbs more than 1 m.
LOW_MARGIN_M = 1.5


@behaviour("takeoff", "arm, climb to a height above home and stay there")
class Takeoff(Command):
    altitude_m: Annotated[float, Number("altitude", "m", 1.0, 50.0, "height above home")] = 2.5

    def build(self, context: BuildContext) -> Behaviour:
        return TakeoffBehaviour(self.altitude_m)


class TakeoffBehaviour(Behaviour):
    """Arms, takes off to `altitude_m` above home and ends at that height."""

    name = "takeoff"

    def __init__(self, altitude_m: float = 2.5) -> None:
        self._altitude_m = altitude_m
        self._until_ns: float = 0
        self._still, self._there = Lasting(), Lasting()
        self._top: Vector3 | None = None
        self._yaw_rad: float | None = None
        self._controller = PositionController()
        self._altitude_now_m = 0.0
        self._low = False

    @property
    def requirements(self) -> frozenset[Requirement]:  # type: ignore[override]
        """A position and home before it arms; a fresh position again at the end, flown by setpoints."""
        if self._until_ns == 0:
            return frozenset({Requirement.ON_GROUND, Requirement.POSITION, Requirement.HOME})
        climbing = set() if self._top is None else {Requirement.POSITION}
        return frozenset({Requirement.ON_GROUND} | climbing)

    def goals(self, context: BehaviourContext) -> tuple[Vector3, ...]:
        """See Behaviour: checked in advance, because the envelope does not limit the autopilot's climb."""
        state = context.state
        home = state.home_position_ned_m or (0.0, 0.0, 0.0)
        north, east, _ = state.position_ned_m or home
        return ((north, east, home[2] - self._altitude_m),)

    def on_activate(self, context: BehaviourContext) -> None:
        limit_s = BASE_TIMEOUT_S + self._altitude_m / SLOWEST_CLIMB_MPS
        self._until_ns = context.now_ns + limit_s * 1e9
        self._still, self._there, self._top = Lasting(), Lasting(), None
        self._controller = PositionController()
        acceptance_m = context.parameters.altitude_acceptance_m
        reach_m = (DEFAULT_ACCEPTANCE_M if acceptance_m is None else acceptance_m) + LOW_MARGIN_M
        self._low = context.state.autopilot == "PX4" and self._altitude_m < reach_m

    def update(self, dt_s: float, context: BehaviourContext) -> BehaviourOutput:
        now_ns, state = context.now_ns, context.state
        altitude_m = state.altitude_m
        self._altitude_now_m = altitude_m or 0.0
        missing_m = self._altitude_m - self._altitude_now_m
        airborne = state.armed and state.landed is LandedState.IN_AIR and altitude_m is not None
        # ArduPilot takes off in GUIDED, which is OFFBOARD here.
        holding = airborne and state.mode in (FlightMode.HOLD, FlightMode.OFFBOARD)
        still = holding and abs((state.velocity_ned_mps or (0.0, 0.0, 0.0))[2]) <= ARRIVED_MPS
        there = still and abs(missing_m) <= ALTITUDE_TOLERANCE_M
        still_s = self._still.held_s(still, now_ns)
        if self._there.held_s(there, now_ns) >= THERE_S:
            return self._success(state, missing_m)
        if now_ns > self._until_ns:
            if still and abs(missing_m) <= AT_LIMIT_M and context.held_at_height:
                return self._success(state, missing_m)
            return Outcome(
                False, f"take-off timed out: {self._altitude_now_m:.1f} m of {self._altitude_m:g} m reached"
            )
        if self._top is None:
            if self._low:
                begins = state.armed and state.mode in (FlightMode.HOLD, FlightMode.OFFBOARD)
            else:
                begins = not there and still_s >= SETTLE_S
            if not begins or state.position_fault(now_ns) is not None:
                if self._low:
                    return ModeRequest(FlightMode.HOLD, arm=True)
                return ModeRequest(FlightMode.TAKEOFF, self._altitude_m, arm=True)
            self._yaw_rad = state.yaw_rad
        standing = state.landed is LandedState.ON_GROUND  # what moves then is the estimate
        self._top = self._above(state, missing_m, None if standing else self._top)
        *_, down_mps = self._controller.velocity(self._top, state, dt_s, CLIMB_MPS)
        sideways_mps = towards(self._top, state.position_ned_m or self._top, POSITION_GAIN, SIDEWAYS_MPS)
        return Setpoint.velocity((*sideways_mps, down_mps), now_ns, yaw_rad=self._yaw_rad)

    def _success(self, state: VehicleState, missing_m: float) -> Outcome:
        text = f"took off, {self._altitude_now_m:.1f} m above home"
        return Outcome(True, text, self._above(state, missing_m, self._top))

    @staticmethod
    def _above(state: VehicleState, missing_m: float, top: Vector3 | None) -> Vector3:
        """The point at the wanted height above home, which arming moves, and above `top` or the vehicle."""
        here = state.position_ned_m or (0.0, 0.0, 0.0)
        north, east, _ = top or here
        return (north, east, here[2] - missing_m)

    @property
    def status(self) -> str:
        return f"taking off, {self._altitude_now_m:.1f} of {self._altitude_m:g} m"
