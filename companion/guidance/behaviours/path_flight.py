"""Base class of path behaviours: `goto`, `follow-path`, `figure-eight`, and area searches."""

from __future__ import annotations

import math
from abc import abstractmethod

from companion.guidance.behaviour import (
    Behaviour,
    BehaviourContext,
    BehaviourOutput,
    Outcome,
    Requirement,
    RoutedSetpoint,
)
from companion.guidance.motion import (
    ARRIVED_M,
    AT_LIMIT_M,
    Arrival,
    PositionController,
    Standing,
    add_velocity_error,
    ground_speed,
    in_degrees,
    position_and_yaw,
    speed_of,
)
from companion.guidance.path import Path, PathFollower
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import Vector3
from vision.attitude import wrap_angle

# Within this distance of its end, the end is flown to as a point, see `PositionController`.
END_M = 1.5
# Arrival with a commanded heading requires the yaw within this.
HEADING_RAD = math.radians(5.0)
# No progress of GAIN_M in this time: a limit or the wind holds the vehicle.
STUCK_S = 12.0
GAIN_M = 0.5
# A way around obstacles leads away from the path meanwhile.
AVOIDING_STUCK_S = 120.0
# How far ahead a way around obstacles is planned.
ROUTE_M = 15.0
# A vehicle that stays for so long within this distance of the end has succeeded, whatever speed its estimate
# shows: PX4's, in its own simulation on a busy computer, showed 0.5 m/s for 8 s at a constant position.
# Beyond ARRIVED_M the outcome states the distance.
STAYS_M = 0.5
SPEED_MARGIN = 1.25
# Nearer than this to the end the yaw no longer follows the path.
KEEP_NOSE_M = 2.0


class PathFlight(Behaviour):
    """Flies along the points that `_points` returns at the start.

    Args:
        speed_mps: along it, at most.
        closed: a loop through the points; else from the vehicle to the last one.
        laps: of a closed path; 0: until another command.
        heading_rad: constant yaw; None: along the path if `nose_along`, else unchanged.
    """

    requirements = frozenset({Requirement.POSITION, Requirement.IN_AIR})

    def __init__(
        self,
        speed_mps: float,
        *,
        closed: bool = False,
        laps: float = 1.0,
        nose_along: bool = True,
        heading_rad: float | None = None,
    ) -> None:
        self._speed_mps, self._closed, self._laps = speed_mps, closed, laps
        self._nose_along, self._heading_rad = nose_along, heading_rad
        self._follower: PathFollower | None = None
        self._problem = ""
        self._yaw_rad: float | None = None
        self._best_m = -math.inf
        self._best_ns = 0
        self._standing: Standing | None = None
        self._arrival, self._controller = Arrival(), PositionController()

    @abstractmethod
    def _points(self, context: BehaviourContext) -> list[Vector3]:
        """The points to fly along, local NED metres. Raises ValueError with the reason if there are none."""

    @abstractmethod
    def _success_text(self) -> str:
        """The reason of a successful outcome."""

    def goals(self, context: BehaviourContext) -> tuple[Vector3, ...]:
        """See Behaviour."""
        return tuple(self._points(context))

    def on_activate(self, context: BehaviourContext) -> None:
        position, self._yaw_rad = position_and_yaw(context.state)
        self._follower, self._problem = None, ""
        self.resume(context)
        try:
            points = self._points(context)
            points = points if self._closed else [position, *points]
            self._follower = PathFollower(Path(points, self._speed_mps, closed=self._closed), self._laps)
        except ValueError as error:
            self._problem = str(error)

    def resume(self, context: BehaviourContext) -> None:
        """The next `update` continues the path after an interruption."""
        self._standing = None
        self._best_m, self._best_ns = -math.inf, context.now_ns
        self._arrival, self._controller = Arrival(), PositionController()

    def stand(self, dt_s: float, context: BehaviourContext, yaw_rad: float | None = None) -> Setpoint:
        """Instead of an update: brake and hold. `yaw_rad`: of the nose; None: it does not turn."""
        self._standing = self._standing or Standing()
        return self._standing.setpoint(context.state, context.now_ns, dt_s, yaw_rad)

    def update(self, dt_s: float, context: BehaviourContext) -> BehaviourOutput:
        if self._standing is not None:
            self.resume(context)
        follower = self._follower
        if follower is None:
            return Outcome(False, f"{self.name}: {self._problem}")
        state, now_ns = context.state, context.now_ns
        position, yaw_rad = position_and_yaw(state)
        velocity = follower.velocity(position, ground_speed(state))
        end = follower.end_ned_m
        away_m = math.inf if end is None or follower.left_m > END_M else math.dist(end, position)
        aligned = self._heading_rad is None or abs(wrap_angle(self._heading_rad - yaw_rad)) <= HEADING_RAD
        arrived = self._arrival.update(away_m, speed_of(state), now_ns)
        stuck = self._stuck(follower, now_ns, AVOIDING_STUCK_S if context.avoiding else STUCK_S)
        if aligned and (arrived or (stuck and self._stays(position, away_m, context))):
            near = away_m <= ARRIVED_M
            text = self._success_text() if near else f"stopped {away_m:.2f} m from the goal"
            return Outcome(True, text, end)
        if stuck:
            return Outcome(False, stuck)
        bearing = follower.bearing()
        if self._heading_rad is not None:
            self._yaw_rad = self._heading_rad
        elif self._nose_along and bearing is not None and follower.left_m > KEEP_NOSE_M:
            self._yaw_rad = bearing
        if context.avoiding and away_m >= END_M:
            setpoint = Setpoint.velocity(velocity, now_ns, yaw_rad=self._yaw_rad)
            return RoutedSetpoint(setpoint, follower.ahead(ROUTE_M))
        if end is not None and away_m < END_M:
            velocity = self._controller.velocity(end, state, dt_s, self._speed_mps)
        else:
            over_ground = add_velocity_error(
                (velocity[0], velocity[1]), state, SPEED_MARGIN * self._speed_mps
            )
            velocity = (*over_ground, velocity[2])
        return Setpoint.velocity(velocity, now_ns, yaw_rad=self._yaw_rad)

    def _stays(self, position: Vector3, away_m: float, context: BehaviourContext) -> bool:
        """Whether it is as near to the end as it gets: nearly there, or below or above it at a limit."""
        if away_m <= STAYS_M:
            return True
        end = None if self._follower is None else self._follower.end_ned_m
        beside_m = math.inf if end is None else math.dist(end[:2], position[:2])
        return context.held_at_height and beside_m <= STAYS_M and away_m <= AT_LIMIT_M

    def _stuck(self, follower: PathFollower, now_ns: int, stuck_s: float) -> str | None:
        """The reason if there was no progress for so long; None: there was."""
        gained_m = follower.along_m - follower.off_m
        if gained_m > self._best_m + GAIN_M:
            self._best_m, self._best_ns = gained_m, now_ns
        if now_ns - self._best_ns < stuck_s * 1e9:
            return None
        left = f", {follower.left_m:.0f} m before its end" if math.isfinite(follower.left_m) else ""
        return (
            f"{self.name}: no progress for {stuck_s:g} s, {follower.off_m:.1f} m off the path{left}: "
            f"held by a limit of [guidance] or by wind"
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
