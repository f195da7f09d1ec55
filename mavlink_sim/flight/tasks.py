"""The flight tasks: the setpoints of each mode.

A task is created when its mode begins and returns a `TrajectorySetpoint` at every step. Positions: local NED.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

from mavlink_sim.flight.attitude_control import RatesSetpoint
from mavlink_sim.flight.position_control import NAN, NOTHING, Demand, TrajectorySetpoint
from mavlink_sim.physics.airframe import Multirotor
from mavlink_sim.physics.rotations import Vector
from mavlink_sim.px4.parameters import Parameters

# MPC_YAW_MODE
TOWARDS_HOME = 1
AWAY_FROM_HOME = 2
ALONG_TRAJECTORY = 3
YAW_FIXED = 5

MIN_COURSE_SPEED_MPS = 0.5  # below this speed the direction of flight is undefined


Setpoint = TrajectorySetpoint | RatesSetpoint

# Share of the acceleration limit that the planned braking uses, so that the vehicle can follow it.
BRAKING_SHARE = 0.6
# Measured on PX4 after the ramp of a take-off: the delay of the climb, and the factor by which it accelerates
# faster than the ramp (MPC_TKO_SPEED in MPC_TKO_RAMP_T), at which it decelerates again.
CLIMB_LAG_S = 0.75
CLIMB_GAIN = 2.2
SLOWEST_CLIMB_MPS = 0.25  # so that a take-off ends
# Measured: a take-off to 2.5 m ends at 1.8-2.2 m, a little inside NAV_MC_ALT_RAD.
TAKEOFF_ACCEPTANCE = 0.82


class Trajectory:
    """A point that moves to a goal within speed and acceleration limits, and waits for the vehicle."""

    def __init__(self, airframe: Multirotor, parameters: Parameters) -> None:
        self._airframe = airframe
        self._parameters = parameters
        self.position = airframe.position
        self.velocity = airframe.velocity
        self.yaw_rad = airframe.yaw_rad
        self.cruise_mps = NAN  # instead of MPC_XY_CRUISE, if above zero

    def keep_height(self) -> None:
        """Plan from the vehicle's height: on the ramp of a take-off it does not follow yet."""
        x, y, _ = self.position
        self.position = (x, y, self._airframe.position[2])

    def stopping_point(self) -> Vector:
        """The position where the vehicle comes to rest if it brakes now."""
        braking = BRAKING_SHARE * self._parameters.positive("MPC_ACC_HOR")
        x, y, z = self.position
        vx, vy, vz = self.velocity
        path_s = math.hypot(vx, vy) / (2.0 * braking)
        return (x + vx * path_s, y + vy * path_s, z + vz * abs(vz) / (2.0 * braking))

    def towards(
        self,
        goal: Vector,
        dt_s: float,
        yaw_rad: float = NAN,
        max_up_mps: float = math.inf,
        max_down_mps: float = math.inf,
        max_horizontal_mps: float = math.inf,
    ) -> TrajectorySetpoint:
        """Advance by `dt_s` and return the setpoint."""
        value = self._parameters.number
        lag = math.dist(self.position, self._airframe.position)
        pace = max(0.0, 1.0 - lag / self._parameters.positive("MPC_XY_ERR_MAX"))
        braking = BRAKING_SHARE * self._parameters.positive("MPC_ACC_HOR")
        x, y, z = self.position
        dx, dy, dz = goal[0] - x, goal[1] - y, goal[2] - z
        far = math.hypot(dx, dy)
        cruise = self.cruise_mps if self.cruise_mps > 0.0 else value("MPC_XY_CRUISE")
        cruise = min(cruise, value("MPC_XY_VEL_MAX"))
        speed = min(cruise, max_horizontal_mps, math.sqrt(2.0 * braking * far), 1.2 * far)
        wanted_x, wanted_y = (dx / far * speed, dy / far * speed) if far > 0.0 else (0.0, 0.0)
        limit = (
            min(value("MPC_Z_V_AUTO_UP"), max_up_mps)
            if dz < 0.0
            else min(value("MPC_Z_V_AUTO_DN"), max_down_mps)
        )
        wanted_z = math.copysign(min(limit, abs(dz)), dz)
        vx, vy, vz = self.velocity
        change_x, change_y = wanted_x - vx, wanted_y - vy
        change = math.hypot(change_x, change_y)
        allowed = self._parameters.positive("MPC_ACC_HOR") * dt_s
        if change > allowed:
            change_x, change_y = change_x / change * allowed, change_y / change * allowed
        allowed_z = value("MPC_ACC_DOWN_MAX") * dt_s
        vx, vy, vz = vx + change_x, vy + change_y, vz + min(max(wanted_z - vz, -allowed_z), allowed_z)
        self.velocity = (vx, vy, vz)
        x, y, z = self.position
        # a point that waits must not feed forward its velocity, or the vehicle never reaches it
        moved_mps = (vx * pace, vy * pace, vz * pace)
        self.position = (x + moved_mps[0] * dt_s, y + moved_mps[1] * dt_s, z + moved_mps[2] * dt_s)
        if yaw_rad == yaw_rad:
            turn = math.radians(value("MPC_YAWRAUTO_MAX")) * dt_s
            error = math.remainder(yaw_rad - self.yaw_rad, math.tau)
            self.yaw_rad = math.remainder(self.yaw_rad + min(max(error, -turn), turn), math.tau)
        return TrajectorySetpoint(self.position, moved_mps, NOTHING, self.yaw_rad)


class Task(ABC):
    """Base of the flight tasks. `landing`, `finished` and `demand` are read after each `update`."""

    landing = False  # on the final descent
    finished = False
    taking_off = False  # climbing from the ground in a mode other than TAKEOFF
    goal: Vector | None = None  # the goal of an auto mode, for POSITION_TARGET_GLOBAL_INT
    demand: Demand | None = None  # goes to the airframe instead of the setpoint

    @abstractmethod
    def update(self, dt_s: float) -> Setpoint:
        """The setpoint after another `dt_s` seconds."""

    def cruise_at(self, speed_mps: float) -> None:  # noqa: B027 - a task without a route has no cruise speed
        """Fly the rest of the route at this horizontal speed (DO_CHANGE_SPEED, DO_REPOSITION)."""


class TrajectoryTask(Task):
    """A task with position and velocity setpoints, never attitudes."""

    def __init__(self, airframe: Multirotor, parameters: Parameters) -> None:
        self._airframe = airframe
        self._parameters = parameters
        self._trajectory = Trajectory(airframe, parameters)

    @abstractmethod
    def update(self, dt_s: float) -> TrajectorySetpoint:
        """The setpoint after another `dt_s` seconds."""


class RouteTask(TrajectoryTask):
    """A trajectory whose cruise speed can be set."""

    def cruise_at(self, speed_mps: float) -> None:
        self._trajectory.cruise_mps = speed_mps


class Hold(RouteTask):
    """Brake and hold, or fly to a goal and hold there (DO_REPOSITION, the end of a take-off)."""

    def __init__(
        self, airframe: Multirotor, parameters: Parameters, goal: Vector | None = None, yaw_rad: float = NAN
    ) -> None:
        super().__init__(airframe, parameters)
        self.goal = self._trajectory.stopping_point() if goal is None else goal
        self._yaw_rad = yaw_rad

    def update(self, dt_s: float) -> TrajectorySetpoint:
        assert self.goal is not None
        return self._trajectory.towards(self.goal, dt_s, self._yaw_rad)


class Takeoff(TrajectoryTask):
    """Climb straight up to an altitude (NED z of `down_m`); finished within NAV_MC_ALT_RAD of it."""

    def __init__(self, airframe: Multirotor, parameters: Parameters, down_m: float) -> None:
        super().__init__(airframe, parameters)
        self._climb_mps = -airframe.velocity[2]
        if airframe.on_ground:
            value = parameters.number
            waits_s = value("COM_SPOOLUP_TIME") + value("MPC_TKO_RAMP_T") + CLIMB_LAG_S
            self._climb_mps = -CLIMB_GAIN * self._ramp_mps2() * waits_s
        x, y, z = airframe.position
        self.goal = (x, y, min(down_m, z))

    def update(self, dt_s: float) -> TrajectorySetpoint:
        assert self.goal is not None
        left = self._airframe.position[2] - self.goal[2]
        self.finished = abs(left) < TAKEOFF_ACCEPTANCE * self._parameters.number("NAV_MC_ALT_RAD")
        self._trajectory.keep_height()
        return self._trajectory.towards(self.goal, dt_s, max_up_mps=self._climb(dt_s, max(left, 0.0)))

    def _ramp_mps2(self) -> float:
        return self._parameters.positive("MPC_TKO_SPEED") / self._parameters.positive("MPC_TKO_RAMP_T")

    def _climb(self, dt_s: float, left_m: float) -> float:
        """The climb rate, m/s, for the remaining height; braking as PX4 does below MPC_LAND_ALT1."""
        ramp = self._ramp_mps2()
        # PX4's greatest speed from which it can stop within a distance, at a limited jerk
        lag = 4.0 * ramp * ramp / self._parameters.positive("MPC_JERK_AUTO")
        braking = 0.5 * (math.sqrt(lag * lag + 8.0 * ramp * left_m) - lag)
        top = self._parameters.number("MPC_TKO_SPEED")
        self._climb_mps = min(top, braking, self._climb_mps + CLIMB_GAIN * ramp * dt_s)
        return max(self._climb_mps, SLOWEST_CLIMB_MPS)


class Land(TrajectoryTask):
    """Descend at one point to the ground: MPC_LAND_SPEED near the ground, MPC_LAND_CRWL in the last metre."""

    landing = True

    def __init__(
        self, airframe: Multirotor, parameters: Parameters, point: Vector | None = None, yaw_rad: float = NAN
    ) -> None:
        super().__init__(airframe, parameters)
        self.goal = self._trajectory.stopping_point() if point is None else point
        self._yaw_rad = yaw_rad

    def update(self, dt_s: float) -> TrajectorySetpoint:
        assert self.goal is not None
        value = self._parameters.number
        height = -self._airframe.position[2]
        slow, fast = value("MPC_LAND_SPEED"), value("MPC_Z_V_AUTO_DN")
        upper, lower = value("MPC_LAND_ALT1"), value("MPC_LAND_ALT2")
        share = min(max((height - lower) / max(upper - lower, 0.1), 0.0), 1.0)
        speed = slow + (fast - slow) * share
        if height < value("MPC_LAND_ALT3"):
            speed = value("MPC_LAND_CRWL")
        point = (self.goal[0], self.goal[1], self._airframe.position[2])
        level = self._trajectory.towards(point, dt_s, self._yaw_rad)
        return TrajectorySetpoint(
            (level.position[0], level.position[1], NAN),
            (level.velocity[0], level.velocity[1], speed),
            NOTHING,
            level.yaw_rad,
        )


class Return(RouteTask):
    """RTL of type 0: climb to the return altitude, fly home, land from there.

    With RTL_LAND_DELAY it descends to RTL_DESCEND_ALT before it lands. It flies nose first and turns to
    `yaw_rad` there, or at once within RTL_MIN_DIST; with WV_EN, or to NaN, it does not turn.
    """

    def __init__(
        self, airframe: Multirotor, parameters: Parameters, home: Vector, yaw_rad: float = NAN
    ) -> None:
        super().__init__(airframe, parameters)
        self._home = home
        self._land: TrajectoryTask | None = None
        self._phase = "climb"
        self._yaw_rad = NAN if parameters.number("WV_EN") else yaw_rad
        x, y, z = self._trajectory.stopping_point()
        distance = math.hypot(x - home[0], y - home[1])
        self._is_close = distance < parameters.number("RTL_MIN_DIST")
        self.return_height_m = self._return_height(distance, home[2] - z)
        self.goal = (x, y, home[2] - self.return_height_m)

    def _return_height(self, distance_m: float, height_m: float) -> float:
        """Metres above home. Within RTL_MIN_DIST of home a cone (RTL_CONE_ANG) allows a lower height."""
        value = self._parameters.number
        height = value("RTL_RETURN_ALT")
        cone = value("RTL_CONE_ANG")
        if distance_m < value("RTL_MIN_DIST") and 0.0 < cone < 90.0:
            height = min(height, distance_m / math.tan(math.radians(cone)))
        return max(height, height_m)

    def update(self, dt_s: float) -> TrajectorySetpoint:
        if self._land is not None:
            return self._land.update(dt_s)
        assert self.goal is not None
        value = self._parameters.number
        home_x, home_y, home_z = self._home
        x, y, z = self._airframe.position
        yaw = NAN
        if self._phase == "climb" and z - self.goal[2] < value("NAV_MC_ALT_RAD"):
            self._phase = "return"
            self.goal = (home_x, home_y, self.goal[2])
        if self._phase == "return":
            distance = math.hypot(home_x - x, home_y - y)
            if self._is_close:
                yaw = self._yaw_rad
            elif distance > value("NAV_ACC_RAD"):
                yaw = math.atan2(home_y - y, home_x - x)
            if distance < 1.0:
                self._phase = "descend"
                if value("RTL_LAND_DELAY"):
                    descend = min(value("RTL_DESCEND_ALT"), home_z - self.goal[2])
                    self.goal = (home_x, home_y, home_z - descend)
        if self._phase == "descend":
            yaw = self._yaw_rad
        if self._phase == "descend" and self.goal[2] - z < value("NAV_MC_ALT_RAD"):
            self._land = self.landing_task((home_x, home_y, home_z), self._yaw_rad)
            self.goal = self._land.goal
            self.landing = True
            return self._land.update(dt_s)
        return self._trajectory.towards(self.goal, dt_s, yaw)

    def landing_task(self, point: Vector, yaw_rad: float) -> TrajectoryTask:
        """The descent at a point, with a heading; NaN: unchanged."""
        return Land(self._airframe, self._parameters, point, yaw_rad)


class Offboard(Task):
    """Follow the newest setpoint; before the first one in this mode, stay at rest."""

    def __init__(self) -> None:
        self.setpoint = TrajectorySetpoint(velocity=(0.0, 0.0, 0.0))

    def update(self, dt_s: float) -> TrajectorySetpoint:
        return self.setpoint


class Reposition(RouteTask):
    """To a goal in local NED at a cruise speed, nose first (MPC_YAW_MODE) unless a yaw is given.

    Unlike a plain hold it takes off when the armed vehicle is on the ground, as in PX4.
    """

    def __init__(
        self, airframe: Multirotor, parameters: Parameters, goal: Vector, yaw_rad: float, home: Vector
    ) -> None:
        super().__init__(airframe, parameters)
        self.goal: Vector = goal
        self._yaw_rad = yaw_rad
        self._home = home
        self._heading_rad = NAN

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
