"""Flies the planned path around obstacles instead of a behaviour's straight route (`guidance.avoid`).

The perception worker plans; here its newest path is an input. Without a fresh path, or where there is no way,
the vehicle stops and stays, and after `NO_WAY_S` the behaviour ends. The obstacle limits act on the result.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from companion.guidance.behaviour import BehaviourContext, Outcome, RoutedSetpoint
from companion.guidance.limits.obstacles import Constraint
from companion.guidance.motion import (
    HOLD_VELOCITY_GAIN,
    VELOCITY_GAIN,
    PositionController,
    ground_speed,
    position_and_yaw,
    stopping_point,
)
from companion.guidance.path import ACCELERATION_MPS2, Path, PathFollower
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import Vector3, VehicleState
from vision.attitude import wrap_angle
from vision.occupancy_grid import Point
from vision.path_planner import PathRequest, PlannedPath

# Beyond the obstacle limits' margin: cells of 0.2 m, and the deviation from the path.
EXTRA_CLEARANCE_M = 0.2
# Planned five times a second or more; so old, the worker is late or has ended.
MAX_AGE_S = 1.0
NO_WAY_S = 8.0
# The vehicle can stop this far before the end of what was observed.
UNSEEN_GAP_M = 0.5
# A camera with a field of 80 degrees keeps an object in view while it also sees where the vehicle flies.
FACING_RAD = math.radians(25.0)
# Slower than this the vehicle does not fly along the path but holds its position, until it may be so fast.
HOLD_MPS, LEAVE_MPS = 0.25, 0.5
# The obstacle limits remove the velocity towards an obstacle, not that beside it, and so bend the way flown:
# a command is at most so many times as fast as they allow in its direction, and may always be SLOW_MPS fast.
BENT_FACTOR, SLOW_MPS = 2.0, 0.3
# Out of the clearance of an obstacle, wherever the camera looks.
ESCAPE_MPS = 0.5
MOST_STEP_S = 0.1
# Nearer than this to the route's end, its bearing says nothing.
NEAR_M = 0.5
SPEED_MARGIN = 1.25


class Avoidance:
    """Steers along planned paths.

    Args:
        margin_m: of the obstacle limits.

    Attributes:
        path: (north, east) points of the path of the newest step; empty: none is active.
    """

    def __init__(self, margin_m: float) -> None:
        self._clearance_m = margin_m + EXTRA_CLEARANCE_M
        self._request: PathRequest | None = None
        self._notes: list[tuple[str, bool]] = []
        self._number = 0
        self.reset()

    def reset(self) -> None:
        """A new behaviour begins: only a path that is planned for it becomes active."""
        self._number += 1
        self.path: tuple[Point, ...] = ()
        self._planned: PlannedPath | None = None
        self._follower: PathFollower | None = None
        self._no_way_ns: int | None = None
        self._said = ""
        self._stop_at: Vector3 | None = None
        self._held_ns = 0
        self._controller = PositionController()

    def take_request(self) -> PathRequest | None:
        """The request of this step; None: no path is needed."""
        request, self._request = self._request, None
        return request

    def take_notes(self) -> Sequence[tuple[str, bool]]:
        """Notes since the last call, each with whether it is a warning."""
        notes, self._notes = self._notes, []
        return notes

    def steer(
        self,
        routed: RoutedSetpoint,
        context: BehaviourContext,
        constraints: Sequence[Constraint],
        *,
        flying: bool,
    ) -> Setpoint | Outcome:
        """The setpoint along the planned path; the end of the behaviour after `NO_WAY_S` without a way.

        Args:
            constraints: the obstacle limits, which are applied to the setpoint afterwards.
            flying: the vehicle flies our setpoints; before, only the path is requested.
        """
        route = tuple((north, east) for north, east, _ in routed.route)
        self._request = PathRequest(route, self._clearance_m, self._number)
        asked, self.path = routed.setpoint, ()
        if not flying:
            return asked
        why = self._no_way(context)
        if why:
            return self._stay(routed, context, why)
        assert context.planned is not None
        if self._no_way_ns is not None:
            if self._said:
                self._notes.append(("a way was found", False))
            self._no_way_ns, self._said = None, ""
        if context.planned is not self._planned:
            self._planned = context.planned
            self._follower = PathFollower(_path(context.planned, asked))
        assert self._follower is not None
        self.path = context.planned.points
        return self._along(self._follower, context.planned, routed, context, constraints)

    def _no_way(self, context: BehaviourContext) -> str:
        """Why the newest path cannot be flown; empty: it can."""
        planned = context.planned
        if planned is None or planned.number != self._number:
            return "no path from the perception worker: it needs depth, attitude and position"
        age_s = (context.now_ns - planned.captured_ns) / 1e9
        if age_s > MAX_AGE_S:
            return f"the newest path is {age_s:.1f} s old"
        return planned.reason

    def _along(
        self,
        follower: PathFollower,
        planned: PlannedPath,
        routed: RoutedSetpoint,
        context: BehaviourContext,
        constraints: Sequence[Constraint],
    ) -> Setpoint:
        """Fly along the path, no faster than what was observed allows, and look where it leads."""
        asked, state = routed.setpoint, context.state
        position, yaw_rad = position_and_yaw(state)
        north, east, _ = follower.velocity((position[0], position[1], 0.0), ground_speed(state))
        bearing = follower.bearing()
        bearing_rad = math.atan2(east, north) if bearing is None else bearing
        nose_rad = bearing_rad
        if routed.facing and asked.yaw_rad is not None:
            off = wrap_angle(bearing_rad - asked.yaw_rad)
            nose_rad = asked.yaw_rad + max(-FACING_RAD, min(FACING_RAD, off))
        left_m = max(0.0, planned.free_m - follower.along_m - UNSEEN_GAP_M)
        most_mps = min(_level_speed(asked), math.sqrt(2.0 * ACCELERATION_MPS2 * left_m))
        gain = VELOCITY_GAIN
        if planned.inside:  # a gust pushes: straight out, and the camera stays on the obstacle
            most_mps, gain, nose_rad = _level_speed(asked), HOLD_VELOCITY_GAIN, yaw_rad
            north, east = (b - a for a, b in zip(*planned.points[:2], strict=True))
        else:  # slower while the camera does not look there yet
            most_mps *= max(0.0, math.cos(wrap_angle(bearing_rad - yaw_rad))) ** 2
        if most_mps < (HOLD_MPS if self._stop_at is None else LEAVE_MPS):
            level = self._hold(context)[:2]
        else:
            self._stop_at = None
            speed = max(math.hypot(north, east), 1e-6)
            direction = (north / speed, east / speed)
            if planned.inside:
                speed = ESCAPE_MPS
            allowed_mps = max(SLOW_MPS, BENT_FACTOR * _allowed_mps(direction, constraints))
            along_mps = min(most_mps, allowed_mps, speed)
            level = _corrected(direction, along_mps, SPEED_MARGIN * _level_speed(asked), state, gain)
        return Setpoint.velocity((*level, _down_mps(asked)), context.now_ns, yaw_rad=wrap_angle(nose_rad))

    def _hold(self, context: BehaviourContext) -> Vector3:
        """The velocity that keeps the vehicle where it comes to rest: in gusts a zero velocity drifts."""
        if self._stop_at is None:
            self._stop_at, self._controller = stopping_point(context.state), PositionController()
        dt_s = max(0.0, min(MOST_STEP_S, (context.now_ns - self._held_ns) / 1e9))
        self._held_ns = context.now_ns
        return self._controller.velocity(self._stop_at, context.state, dt_s)

    def _stay(self, routed: RoutedSetpoint, context: BehaviourContext, why: str) -> Setpoint | Outcome:
        """Brake, hold where the vehicle comes to rest, look to the route's end; end after `NO_WAY_S`."""
        now_ns, state = context.now_ns, context.state
        if self._no_way_ns is None:
            self._no_way_ns = now_ns
        waited_s = (now_ns - self._no_way_ns) / 1e9
        if waited_s > NO_WAY_S:
            return Outcome(False, f"no way for {NO_WAY_S:g} s: {why}")
        # The first path takes a moment, and a single image may show a gap as closed.
        if waited_s > MAX_AGE_S and not self._said:
            self._said = why
            self._notes.append((f"holding: no way ({why})", True))
        velocity = self._hold(context)
        yaw_rad = routed.setpoint.yaw_rad
        (north, east, _), (here_north, here_east, _) = routed.route[-1], position_and_yaw(state)[0]
        if not routed.facing and math.hypot(north - here_north, east - here_east) > NEAR_M:
            yaw_rad = math.atan2(east - here_east, north - here_north)  # an obstacle there may have gone
        return Setpoint.velocity((velocity[0], velocity[1], 0.0), now_ns, yaw_rad=yaw_rad)


def _path(planned: PlannedPath, asked: Setpoint) -> Path:
    points = [(north, east, 0.0) for north, east in planned.points]
    if math.dist(points[0], points[-1]) < 0.05:
        points.append((points[-1][0] + 0.05, points[-1][1], 0.0))  # a path needs a length
    return Path(points, max(0.2, _level_speed(asked)))


def _allowed_mps(direction: tuple[float, float], constraints: Sequence[Constraint]) -> float:
    """The speed in a direction that the constraints leave as it is."""
    towards = (
        (north * direction[0] + east * direction[1], most_mps) for north, east, most_mps in constraints
    )
    return min((most_mps / share for share, most_mps in towards if share > 1e-3), default=math.inf)


def _corrected(
    direction: tuple[float, float], along_mps: float, top_mps: float, state: VehicleState, gain: float
) -> tuple[float, float]:
    """The velocity command for a speed in a direction, at most `top_mps`, against the velocity beside it.

    Args:
        gain: of the error of the velocity in the direction.
    """
    planned = (along_mps * direction[0], along_mps * direction[1])
    north, east, _ = state.velocity_ned_mps or (*planned, 0.0)
    is_mps = north * direction[0] + east * direction[1]
    wanted_mps = min(top_mps, along_mps + gain * (along_mps - is_mps))
    beside = (north - is_mps * direction[0], east - is_mps * direction[1])
    return (
        wanted_mps * direction[0] - HOLD_VELOCITY_GAIN * beside[0],
        wanted_mps * direction[1] - HOLD_VELOCITY_GAIN * beside[1],
    )


def _level_speed(asked: Setpoint) -> float:
    north, east, _ = asked.velocity_ned_mps or (0.0, 0.0, 0.0)
    return math.hypot(north, east)


def _down_mps(asked: Setpoint) -> float:
    return 0.0 if asked.velocity_ned_mps is None else asked.velocity_ned_mps[2]
