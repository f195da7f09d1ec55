"""Ground contact: the ramp of a take-off and the land detector.

Times are seconds since boot. MPC_TKO_* are parameters.
"""

from __future__ import annotations

import math

from mavlink_sim.flight import tasks as flight
from mavlink_sim.flight.position_control import TrajectorySetpoint
from mavlink_sim.physics.airframe import GRAVITY_MPS2, Multirotor
from mavlink_sim.px4.parameters import Parameters

TAKEOFF_DETECTION_HEIGHT_M = 0.12
# As recorded: the vehicle rises slowly while the ramp raises the thrust to hover, then climbs.
RAMP_THRUST_SHARE = 0.9
RAMP_CREEP_MPS = 0.2


class GroundContact:
    """The land detector of an autopilot.

    Args:
        detection_s: time of ground contact until it is landed.

    Attributes:
        landed: from `touch_down` to `leave`.
        has_flown: it has been in the air since it was armed. left_s: when it last left the ground.
    """

    def __init__(self, airframe: Multirotor, parameters: Parameters, detection_s: float) -> None:
        self._airframe = airframe
        self._parameters = parameters
        self._detection_s = detection_s
        self.landed = airframe.on_ground  # it may boot in the air
        self.has_flown = False
        self.left_s: float | None = None
        self._armed_since_s = self._landed_since_s = 0.0
        self._touching_since_s: float | None = None
        self._lifting_since_s: float | None = None

    def arm(self, now_s: float) -> None:
        """The motors start."""
        self.has_flown = False
        self._armed_since_s = now_s
        self._lifting_since_s = None

    def armed_for_s(self, now_s: float) -> float:
        """Seconds since it was armed."""
        return now_s - self._armed_since_s

    def landed_for_s(self, now_s: float) -> float:
        """Seconds since it landed; before that since boot."""
        return now_s - self._landed_since_s

    def rests(self, now_s: float, *, rises: bool) -> bool:
        """Whether it stays on the ground, with idling motors; if not, the ramp begins.

        Args:
            rises: a take-off is allowed and demanded.
        """
        if not self.landed:
            return False
        if not rises:
            self._lifting_since_s = None
            return True
        if self._lifting_since_s is None:
            self._lifting_since_s = now_s
        return False

    def climb_limit_mps(self, now_s: float) -> float:
        """PX4's take-off ramp: almost no climb while thrust builds up, then MPC_TKO_SPEED, then no limit."""
        if self._lifting_since_s is None:
            return math.inf
        ramp = max(self._parameters.number("MPC_TKO_RAMP_T"), 0.01)
        progress = (now_s - self._lifting_since_s) / ramp
        if progress >= 1.0 and not self.landed:
            self._lifting_since_s = None
            return math.inf
        speed = self._parameters.number("MPC_TKO_SPEED")
        rise = (progress - RAMP_THRUST_SHARE) / (1.0 - RAMP_THRUST_SHARE)
        return min(max(speed * rise, RAMP_CREEP_MPS), speed)

    def leave(self, now_s: float) -> None:
        """It has left the ground."""
        self.landed = False
        self.left_s = now_s
        self.has_flown = True

    def presses(self, now_s: float, wanted_down_mps: float) -> bool:
        """Whether it has been on the ground with a setpoint that does not climb for the detection time.

        Args:
            wanted_down_mps: the downward speed setpoint; NaN without one.
        """
        airframe = self._airframe
        if not airframe.on_ground or not (
            wanted_down_mps > 0.05 or airframe.thrust_mps2 < 0.5 * GRAVITY_MPS2
        ):
            self._touching_since_s = None
            return False
        if self._touching_since_s is None:
            self._touching_since_s = now_s
        return now_s - self._touching_since_s >= self._detection_s

    def touch_down(self, now_s: float) -> None:
        """It has landed."""
        self._touching_since_s = None
        self.landed = True
        self._landed_since_s = now_s


def asks_to_rise(task: flight.Task | None, setpoint: TrajectorySetpoint, down_m: float) -> bool:
    """Whether a vehicle on the ground at `down_m` (NED) is to take off."""
    if isinstance(task, flight.Takeoff):
        return True
    if isinstance(task, flight.Hold | flight.Land | flight.Return):
        return False
    # without a setpoint (NaN) every comparison is False
    return (
        setpoint.velocity[2] < -0.05 or setpoint.position[2] < down_m - 0.1 or setpoint.acceleration[2] < -0.3
    )
