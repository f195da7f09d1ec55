"""Whether a vehicle stands or flies: the ramp of a take-off, and what counts as a landing.

Times are seconds since boot. MPC_TKO_* are parameters.
"""

from __future__ import annotations

import math

from mavlink_sim.flight import tasks as flight
from mavlink_sim.flight.position_control import TrajectorySetpoint
from mavlink_sim.physics.airframe import GRAVITY_MPS2, Multirotor
from mavlink_sim.px4.parameters import Parameters

TAKEOFF_DETECTION_HEIGHT_M = 0.12
# As recorded: the vehicle creeps up while the ramp is still raising the thrust to hover, then climbs.
RAMP_THRUST_SHARE = 0.9
RAMP_CREEP_MPS = 0.2


class GroundContact:
    """What an autopilot knows of the ground beneath it.

    Args:
        detection_s: so long it must press on the ground to have landed.

    Attributes:
        landed: it stands, as far as it can tell: from `touch_down` to `leave`.
        has_flown: it has been in the air since it was armed. left_s: when it left the ground last.
    """

    def __init__(self, airframe: Multirotor, parameters: Parameters, detection_s: float) -> None:
        self._airframe = airframe
        self._parameters = parameters
        self._detection_s = detection_s
        self.landed = airframe.on_ground  # it may boot while it falls
        self.has_flown = False
        self.left_s: float | None = None
        self._armed_since_s = self._landed_since_s = 0.0
        self._touching_since_s: float | None = None
        self._lifting_since_s: float | None = None

    def arm(self, now_s: float) -> None:
        """The motors turn from now on."""
        self.has_flown = False
        self._armed_since_s = now_s
        self._lifting_since_s = None

    def armed_for_s(self, now_s: float) -> float:
        """Since it was armed last."""
        return now_s - self._armed_since_s

    def landed_for_s(self, now_s: float) -> float:
        """Since it landed last; before that since boot."""
        return now_s - self._landed_since_s

    def rests(self, now_s: float, *, rises: bool) -> bool:
        """Whether it stays where it stands, with idling motors; if it is to leave that, the ramp begins.

        Args:
            rises: it may leave the ground, and is to.
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
        """PX4's take-off ramp: hardly any climb while thrust builds up, up to MPC_TKO_SPEED, then free."""
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
        """It is in the air."""
        self.landed = False
        self.left_s = now_s
        self.has_flown = True

    def presses(self, now_s: float, wanted_down_mps: float) -> bool:
        """Whether it has been on the ground, and been meant to be, for as long as a landing takes.

        Args:
            wanted_down_mps: the speed downwards that it is to have; NaN where none is wanted.
        """
        airframe = self._airframe
        sinking = wanted_down_mps > 0.05 or airframe.thrust_mps2 < 0.5 * GRAVITY_MPS2
        if not airframe.on_ground or not sinking:
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
    """Whether a vehicle that stands at `down_m` (NED) is to leave the ground."""
    if isinstance(task, flight.Takeoff):
        return True
    if isinstance(task, flight.Hold | flight.Land | flight.Return):
        return False
    # where nothing is wanted (NaN) every comparison is False
    return (
        setpoint.velocity[2] < -0.05 or setpoint.position[2] < down_m - 0.1 or setpoint.acceleration[2] < -0.3
    )
