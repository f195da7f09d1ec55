"""Flying a path to its end, or round and round: what `goto`, `follow-path` and `figure-eight` share."""

from __future__ import annotations

import math
from abc import abstractmethod

from companion.guidance.behaviour import Behaviour, Outcome, Requirement, Situation, Step
from companion.guidance.motion import ground_speed, in_degrees, position_and_yaw, pressed
from companion.guidance.path import Path, PathFollower
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import Vector3

# There: so near, so slow, for so long. In gusts a vehicle never stands still: what lasts may be coarser.
ARRIVALS = ((0.5, 0.5, 0.5), (1.0, 1.0, 3.0))
# No metre of the way gained in so long, and it is not going to be: a limit, or the wind.
STUCK_S = 12.0
GAIN_M = 0.5
SPEED_MARGIN = 1.25
# Nearer than this to the end the nose no longer follows the way.
KEEP_NOSE_M = 2.0


class PathFlight(Behaviour):
    """Flies the path that `_path` makes when it begins.

    Args:
        speed_mps: along it, at most.
        laps: of a closed path; 0: until another command.
        heading_rad: of the nose throughout; None: along the way where `nose_along`, else as it is.
    """

    requirements = frozenset({Requirement.POSITION, Requirement.IN_AIR})

    def __init__(
        self,
        speed_mps: float,
        *,
        laps: float = 1.0,
        nose_along: bool = True,
        heading_rad: float | None = None,
    ) -> None:
        self._speed_mps, self._laps = speed_mps, laps
        self._nose_along, self._heading_rad = nose_along, heading_rad
        self._follower: PathFollower | None = None
        self._problem = ""
        self._yaw_rad: float | None = None
        self._best_m = -math.inf
        self._best_ns = 0
        self._arrived_since_ns: list[int | None] = [None] * len(ARRIVALS)

    @abstractmethod
    def _path(self, situation: Situation) -> Path:
        """The path, from where the vehicle is. Raises ValueError with a line that says why there is none."""

    @abstractmethod
    def _flown(self) -> str:
        """What to say when it was flown."""

    def on_activate(self, situation: Situation) -> None:
        _, self._yaw_rad = position_and_yaw(situation.state)
        self._follower, self._problem = None, ""
        self._arrived_since_ns = [None] * len(ARRIVALS)
        self._best_m, self._best_ns = -math.inf, situation.now_ns
        try:
            self._follower = PathFollower(self._path(situation))
        except ValueError as error:
            self._problem = str(error)

    def resume(self, situation: Situation) -> None:
        """Something else was flown in between: the way goes on where it was left."""
        self._best_m, self._best_ns = -math.inf, situation.now_ns
        self._arrived_since_ns = [None] * len(ARRIVALS)

    def update(self, dt_s: float, situation: Situation) -> Step:
        follower = self._follower
        if follower is None:
            return Outcome(False, f"{self.name}: {self._problem}")
        state, now_ns = situation.state, situation.now_ns
        position, _ = position_and_yaw(state)
        speed_mps = ground_speed(state)
        wanted = follower.velocity(position, speed_mps)
        if follower.path.closed:
            if self._laps and follower.along_m >= self._laps * follower.path.length_m:
                return Outcome(True, self._flown())
        elif self._arrived(follower, position, math.hypot(*(state.velocity_ned_mps or ())), now_ns):
            return Outcome(True, self._flown())
        if stuck := self._stuck(follower, now_ns):
            return Outcome(False, stuck)
        bearing = follower.bearing()
        if self._heading_rad is not None:
            self._yaw_rad = self._heading_rad
        elif (
            self._nose_along
            and bearing is not None
            and (follower.path.closed or follower.left_m > KEEP_NOSE_M)
        ):
            self._yaw_rad = bearing
        north_mps, east_mps = pressed((wanted[0], wanted[1]), state, SPEED_MARGIN * self._speed_mps)
        return Setpoint.velocity((north_mps, east_mps, wanted[2]), now_ns, yaw_rad=self._yaw_rad)

    def _arrived(self, follower: PathFollower, position: Vector3, speed_mps: float, now_ns: int) -> bool:
        away_m = math.dist(follower.path.point(follower.path.length_m).position_ned_m, position)
        if follower.left_m > ARRIVALS[-1][0]:
            away_m = math.inf
        for index, (tolerance_m, slow_mps, lasting_s) in enumerate(ARRIVALS):
            since_ns = self._arrived_since_ns[index]
            if away_m > tolerance_m or speed_mps > slow_mps:
                self._arrived_since_ns[index] = None
            elif since_ns is None:
                self._arrived_since_ns[index] = now_ns
            elif now_ns - since_ns >= lasting_s * 1e9:
                return True
        return False

    def _stuck(self, follower: PathFollower, now_ns: int) -> str | None:
        """No way was gained for long: how far it came, and what may hold it."""
        gained_m = follower.along_m - follower.off_m
        if gained_m > self._best_m + GAIN_M:
            self._best_m, self._best_ns = gained_m, now_ns
        if now_ns - self._best_ns < STUCK_S * 1e9:
            return None
        left = "" if follower.path.closed else f", {follower.left_m:.0f} m before its end"
        return (
            f"{self.name} came no further for {STUCK_S:g} s, {follower.off_m:.1f} m beside the path{left}: "
            f"a limit of [guidance] or the wind holds the vehicle"
        )

    @property
    def status(self) -> str:
        follower = self._follower
        if follower is None:
            return self.name
        nose = "" if self._yaw_rad is None else f", heading {in_degrees(self._yaw_rad)}°"
        if follower.path.closed:
            return f"{self.name}, lap {follower.along_m / follower.path.length_m:.1f}{nose}"
        return f"{self.name}, {follower.left_m:.0f} m to go{nose}"
