"""Take off with the autopilot's own take-off mode, and finish the climb if it stops short."""

from __future__ import annotations

from companion.guidance.behaviour import Behaviour, ModeRequest, Outcome, Requirement, Situation, Step
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import FlightMode, LandedState, Vector3

# PX4 counts a take-off as done inside its altitude acceptance radius (NAV_MC_ALT_RAD, 0.8 m) and holds there:
# measured 1.8-2.2 m of 2.5 m. What is left beyond this tolerance is climbed by setpoint.
ALTITUDE_TOLERANCE_M = 0.4
# Time for the autopilot's hold to come to rest before the height is judged.
SETTLE_S = 1.0
# Arming, spooling up and a climb at half a metre a second.
BASE_TIMEOUT_S = 25.0
SLOWEST_CLIMB_MPS = 0.5


class TakeoffBehaviour(Behaviour):
    """Arms, takes off to `altitude_m` above home and ends when that height is reached."""

    name = "takeoff"
    requirements = frozenset({Requirement.ON_GROUND})

    def __init__(self, altitude_m: float = 2.5) -> None:
        self._altitude_m = altitude_m
        self._until_ns: float = 0
        self._held_since_ns: int | None = None
        self._top: Vector3 | None = None
        self._yaw_rad: float | None = None
        self._altitude_now_m = 0.0

    def on_activate(self, situation: Situation) -> None:
        limit_s = BASE_TIMEOUT_S + self._altitude_m / SLOWEST_CLIMB_MPS
        self._until_ns = situation.now_ns + limit_s * 1e9
        self._held_since_ns, self._top = None, None

    def update(self, dt_s: float, situation: Situation) -> Step:
        now_ns, state = situation.now_ns, situation.state
        altitude_m = state.altitude_m
        self._altitude_now_m = altitude_m or 0.0
        missing_m = self._altitude_m - self._altitude_now_m
        airborne = state.armed and state.landed is LandedState.IN_AIR and altitude_m is not None
        holding = state.mode in (FlightMode.HOLD, FlightMode.OFFBOARD)
        if airborne and holding and abs(missing_m) <= ALTITUDE_TOLERANCE_M:
            return Outcome(True, f"in the air at {self._altitude_now_m:.1f} m")
        if now_ns > self._until_ns:
            return Outcome(
                False, f"take-off timed out: {self._altitude_now_m:.1f} m of {self._altitude_m:g} m reached"
            )
        if self._top is not None:
            return Setpoint.position(self._top, now_ns, yaw_rad=self._yaw_rad)
        if not (airborne and state.mode is FlightMode.HOLD):
            self._held_since_ns = None
        elif self._held_since_ns is None:
            self._held_since_ns = now_ns
        elif now_ns - self._held_since_ns >= SETTLE_S * 1e9 and state.position_fresh(now_ns):
            north, east, down = state.position_ned_m or (0.0, 0.0, 0.0)
            self._top, self._yaw_rad = (north, east, down - missing_m), state.yaw_rad
            return Setpoint.position(self._top, now_ns, yaw_rad=self._yaw_rad)
        return ModeRequest(FlightMode.TAKEOFF, self._altitude_m, arm=True)

    @property
    def status(self) -> str:
        return f"taking off, {self._altitude_now_m:.1f} of {self._altitude_m:g} m"
