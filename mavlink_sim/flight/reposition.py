"""DO_REPOSITION: flight to a point in mode HOLD."""

from __future__ import annotations

import math

from mavlink_sim.flight.position_control import NAN, TrajectorySetpoint
from mavlink_sim.flight.tasks import Task, Trajectory
from mavlink_sim.physics.airframe import Multirotor, Vector
from mavlink_sim.px4.parameters import Parameters

# MPC_YAW_MODE
TOWARDS_HOME = 1
AWAY_FROM_HOME = 2
ALONG_TRAJECTORY = 3
YAW_FIXED = 5

MIN_COURSE_SPEED_MPS = 0.5  # below this speed the direction of flight is undefined


class Reposition(Task):
    """To a goal in local NED at a cruise speed, nose first (MPC_YAW_MODE) unless a yaw is given.

    Unlike a plain hold it takes off when the armed vehicle is on the ground, as in PX4.
    """

    def __init__(
        self,
        airframe: Multirotor,
        parameters: Parameters,
        goal: Vector,
        yaw_rad: float,
        home: Vector,
    ) -> None:
        self._airframe = airframe
        self._parameters = parameters
        self._trajectory = Trajectory(airframe, parameters)
        self.goal: Vector = goal
        self._yaw_rad = yaw_rad
        self._home = home
        self._heading_rad = NAN

    def cruise_at(self, speed_mps: float) -> None:
        self._trajectory.cruise_mps = speed_mps

    def update(self, dt_s: float) -> TrajectorySetpoint:
        yaw = self._yaw_rad if math.isfinite(self._yaw_rad) else self._facing()
        return self._trajectory.towards(self.goal, dt_s, yaw)

    def _facing(self) -> float:
        """The heading of MPC_YAW_MODE; kept where that is undefined."""
        mode = int(self._parameters.number("MPC_YAW_MODE"))
        x, y, _ = self._airframe.position
        least = self._parameters.number("NAV_ACC_RAD")
        if mode == TOWARDS_HOME:
            towards = (self._home[0] - x, self._home[1] - y)
        elif mode == AWAY_FROM_HOME:
            towards = (x - self._home[0], y - self._home[1])
        elif mode == ALONG_TRAJECTORY:
            towards, least = self._airframe.velocity[:2], MIN_COURSE_SPEED_MPS
        elif mode == YAW_FIXED:
            return NAN
        else:
            towards = (self.goal[0] - x, self.goal[1] - y)
        if math.hypot(*towards) > least:
            self._heading_rad = math.atan2(towards[1], towards[0])
        return self._heading_rad


def reposition_goal(
    wanted: Vector, yaw_rad: float, airframe: Multirotor, parameters: Parameters, former_goal: Vector | None
) -> Vector:
    """The goal of DO_REPOSITION, local NED; NaN components of `wanted` are filled in as PX4 does.

    With a horizontal position but no altitude, the current altitude is kept. With an altitude or a yaw only,
    the horizontal goal is kept. Without any it stops: the goal is where it comes to rest.
    """
    north, east, down = wanted
    here = airframe.position
    has_position = math.isfinite(north) and math.isfinite(east)
    height = down if math.isfinite(down) else here[2]
    if has_position:
        return (north, east, height)
    if math.isfinite(down) or math.isfinite(yaw_rad):
        point = here if former_goal is None else former_goal
        return (point[0], point[1], height)
    rest = Trajectory(airframe, parameters).stopping_point()
    return (rest[0], rest[1], height)
