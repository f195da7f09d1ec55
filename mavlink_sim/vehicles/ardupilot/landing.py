"""LAND, at one point or on the target of LANDING_TARGET (PLND_ENABLED, PLND_TYPE 1), and RTL.

Of LANDING_TARGET ArduPilot uses, with `position_valid` 0, the angles `angle_x` (to the right) and `angle_y`
(downwards in the image: backwards on the vehicle) of a camera that looks straight down, and `distance` along
that line; with `position_valid` 1 a position in MAV_FRAME_BODY_FRD with a `distance`. PX4's frame is refused.
RTL: climb to RTL_ALT, fly home, wait RTL_LOIT_TIME above it, then land (or stay at RTL_ALT_FINAL).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from mavlink_sim.flight import tasks as flight
from mavlink_sim.flight.position_control import NAN, NOTHING, TrajectorySetpoint
from mavlink_sim.flight.precision_landing import LandingTarget
from mavlink_sim.physics.airframe import Multirotor
from mavlink_sim.physics.rotations import Vector
from mavlink_sim.px4.parameters import Parameters
from vision.attitude import Quaternion, quaternion_inverse, quaternion_product

ALTITUDE_REACHED_M = 0.5
LOWEST_RETURN_M = 2.0  # RTL_ALT_MIN: the least height in the cone


class ReturnToLaunch(flight.RouteTask):
    """The task of RTL. `landing_task` creates the descent at a point."""

    def __init__(
        self,
        airframe: Multirotor,
        parameters: Parameters,
        home: Vector,
        landing_task: Callable[[Vector], flight.TrajectoryTask],
    ) -> None:
        super().__init__(airframe, parameters)
        self._home = home
        self._landing_task = landing_task
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


BODY_FRD = 12  # MAV_FRAME_BODY_FRD
COMPANION_TYPE = 1  # PLND_TYPE: MAVLink messages
MEASUREMENT_LIFETIME_S = 1.0  # timeout of a line of sight
ACCEPTABLE_ERROR_M = 0.15
SLOWEST_DESCENT_MPS = 0.1
SLOW_ABOVE_M, SLOW_BELOW_M = 0.35, 2.0  # height at which a landing on a target waits until the error is small
MAX_DISTANCE_M = 1000.0


class UnsupportedTargetError(ValueError):
    """ArduPilot refuses this LANDING_TARGET; the text is the STATUSTEXT it sends."""


def line_of_sight(message: Any) -> Vector | None:
    """From the vehicle to the target in body FRD: metres, or of length 1 without a distance.

    None for a position without a distance, or for non-finite values: ArduPilot ignores them.

    Raises UnsupportedTargetError for a position in another frame than MAV_FRAME_BODY_FRD.
    """
    distance = float(message.distance) if message.distance > 0.0 else 0.0
    if message.position_valid:
        if message.frame != BODY_FRD:
            raise UnsupportedTargetError("Plnd: Frame not supported ")
        sight = (float(message.x), float(message.y), float(message.z))
        if not distance:
            return None
    else:
        sight = (-math.tan(message.angle_y), math.tan(message.angle_x), 1.0)
    length = math.hypot(*sight)
    if not (0.0 < length < math.inf and math.isfinite(distance)):
        return None
    scale = (distance or 1.0) / length
    return (sight[0] * scale, sight[1] * scale, sight[2] * scale)


def target_position(message: Any, position: Vector, quaternion: Quaternion, height_m: float) -> Vector | None:
    """The position of the target, local NED; None where the line of sight does not point down.

    Without a distance it is the intersection of the line with the ground, `height_m` below by the
    rangefinder.
    """
    sight = line_of_sight(message)
    if sight is None:
        return None
    north, east, down = quaternion_product(
        quaternion_product(quaternion, (0.0, *sight)), quaternion_inverse(quaternion)
    )[1:]
    if down <= 0.0:
        return None
    scale = 1.0 if message.distance > 0.0 else max(height_m, 0.0) / down
    if scale * math.hypot(north, east, down) > MAX_DISTANCE_M:
        return None
    x, y, z = position
    return (x + north * scale, y + east * scale, z + down * scale)


class Land(flight.TrajectoryTask):
    """Descend: WPNAV_SPEED_DN (or LAND_SPEED_HIGH) down to LAND_ALT_LOW, then LAND_SPEED, to the ground.

    `newest` gives the newest landing target, `now_s` the time since boot.
    """

    landing = True

    def __init__(
        self,
        airframe: Multirotor,
        parameters: Parameters,
        newest: Callable[[], LandingTarget | None],
        now_s: Callable[[], float],
        point: Vector | None = None,
    ) -> None:
        super().__init__(airframe, parameters)
        self._newest = newest
        self._now_s = now_s
        self.goal: Vector = self._trajectory.stopping_point() if point is None else point
        self.on_target = False

    def update(self, dt_s: float) -> TrajectorySetpoint:
        self._look()
        z = self._airframe.position[2]
        level = self._trajectory.towards((self.goal[0], self.goal[1], z), dt_s)
        return TrajectorySetpoint(
            (level.position[0], level.position[1], NAN),
            (level.velocity[0], level.velocity[1], self._descent(-z)),
            NOTHING,
            level.yaw_rad,
        )

    def _look(self) -> None:
        """Aim at the target while it is in sight; out of sight, descend at its last position."""
        value = self._parameters.number
        self.on_target = False
        if not value("PLND_ENABLED") or value("PLND_TYPE") != COMPANION_TYPE:
            return
        newest = self._newest()
        if newest is None or self._now_s() - newest.stamp_s > MEASUREMENT_LIFETIME_S:
            return
        self.on_target = True
        self.goal = newest.position

    def _descent(self, height_m: float) -> float:
        value = self._parameters.number
        slow, low = abs(value("LAND_SPEED")) / 100.0, max(value("LAND_ALT_LOW") / 100.0, 1.0)
        fast = max((value("LAND_SPEED_HIGH") or value("WPNAV_SPEED_DN")) / 100.0, slow)
        speed = min(max(height_m - low + slow, slow), fast)
        if self.on_target:
            away = math.dist(self.goal[:2], self._airframe.position[:2])
            if away > value("PLND_XY_DIST_MAX") > 0.0:
                return 0.0  # horizontal error too large: no descent
            if SLOW_ABOVE_M < height_m < SLOW_BELOW_M:
                half = slow / 2.0
                speed = max(half - away * half / ACCEPTABLE_ERROR_M, SLOWEST_DESCENT_MPS)
        return speed
