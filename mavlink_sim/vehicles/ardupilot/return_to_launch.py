"""RTL: climb to RTL_ALT, fly home, wait RTL_LOIT_TIME above it, then land (or stay at RTL_ALT_FINAL)."""

from __future__ import annotations

import math
from collections.abc import Callable

from mavlink_sim.flight import tasks as flight
from mavlink_sim.flight.position_control import NAN, TrajectorySetpoint
from mavlink_sim.physics.airframe import Multirotor, Vector
from mavlink_sim.px4.parameters import Parameters

ALTITUDE_REACHED_M = 0.5
LOWEST_RETURN_M = 2.0  # RTL_ALT_MIN: the least height in the cone


class ReturnToLaunch(flight.TrajectoryTask):
    """The task of RTL. `landing_task` creates the descent at a point."""

    def __init__(
        self,
        airframe: Multirotor,
        parameters: Parameters,
        home: Vector,
        landing_task: Callable[[Vector], flight.TrajectoryTask],
    ) -> None:
        self._airframe = airframe
        self._parameters = parameters
        self._home = home
        self._landing_task = landing_task
        self._trajectory = flight.Trajectory(airframe, parameters)
        speed = parameters.number("RTL_SPEED") / 100.0
        if speed > 0.0:
            self._trajectory.cruise_mps = speed
        self._phase = "climb"
        self._loitered_s = 0.0
        self._land: flight.TrajectoryTask | None = None
        x, y, z = self._trajectory.stopping_point()
        away_m = math.hypot(x - home[0], y - home[1])
        self.goal = (x, y, home[2] - self._height(away_m, home[2] - z))

    def _height(self, away_m: float, height_m: float) -> float:
        """Return height, metres above home: RTL_ALT, lower inside the cone around home, never a descent."""
        value = self._parameters.number
        height = max(height_m + value("RTL_CLIMB_MIN") / 100.0, value("RTL_ALT") / 100.0)
        slope = value("RTL_CONE_SLOPE")
        if slope > 0.0:
            height = min(height, max(away_m * max(slope, 0.5), LOWEST_RETURN_M))
        return max(height, height_m + value("RTL_CLIMB_MIN") / 100.0)

    def cruise_at(self, speed_mps: float) -> None:
        self._trajectory.cruise_mps = speed_mps

    def update(self, dt_s: float) -> TrajectorySetpoint:
        if self._land is not None:
            return self._land.update(dt_s)
        assert self.goal is not None
        value = self._parameters.number
        x, y, z = self._airframe.position
        yaw = NAN
        if self._phase == "climb" and z - self.goal[2] < ALTITUDE_REACHED_M:
            self._phase = "return"
            self.goal = (self._home[0], self._home[1], self.goal[2])
        if self._phase == "return":
            away = math.hypot(self._home[0] - x, self._home[1] - y)
            radius = max(value("WPNAV_RADIUS") / 100.0, 0.1)
            if away > radius and value("WP_YAW_BEHAVIOR") == 1:
                yaw = math.atan2(self._home[1] - y, self._home[0] - x)
            elif away <= radius:
                self._phase = "loiter"
        if self._phase == "loiter":
            self._loitered_s += dt_s
            if self._loitered_s >= value("RTL_LOIT_TIME") / 1000.0:
                self._descend(value("RTL_ALT_FINAL") / 100.0)
        return self._trajectory.towards(self.goal, dt_s, yaw)

    def _descend(self, final_m: float) -> None:
        if final_m > 0.0:
            self._phase = "final"
            self.goal = (self._home[0], self._home[1], self._home[2] - final_m)
            return
        self._land = self._landing_task(self._home)
        self.goal = self._land.goal
        self.landing = True
