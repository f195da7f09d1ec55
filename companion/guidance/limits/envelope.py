"""Flight envelope: the limits every setpoint passes before it is sent.

The envelope only reduces. A limited velocity is never faster than the input, neither horizontally nor
vertically; braking is never delayed. The one exception: before an obstacle or inside its margin the sent
velocity may lead away from it, against a drift too, at most as fast as the horizontal limit. A setpoint
inside every limit passes unchanged.

The feed-forward acceleration may turn the velocity and compensate drag. It never makes the vehicle faster
than the sent velocity, nor brings it nearer to a fence.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

from companion.geometry.fence import Fence
from companion.guidance.formation.neighbours import Neighbour
from companion.guidance.formation.separation import (
    BRAKING,
    SpeedConstraint,
    apply_separation,
    constraints_at,
    level_constraints,
)
from companion.vehicle.autopilot_parameters import AutopilotParameters
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import Vector3, VehicleState, with_fields
from vision.attitude import wrap_angle

# PX4 flies towards a position setpoint with about this speed per metre of distance (MPC_XY_P 0.95, MPC_Z_P
# 1.0), so a position limit/gain ahead is flown to no faster than the limit.
POSITION_GAIN_PER_S = 1.0
# Bounds the step after a pause of the loop.
LONGEST_STEP_S = 0.2
# A feed-forward acceleration acts for this long before its effect is measured.
FEED_FORWARD_S = 0.3
# A velocity controller deviates from its setpoint by the feed-forward over its gain (PX4: MPC_XY_VEL_P_ACC
# 1.8), so it is limited in proportion to the speed. An orbit needs less than this.
FEED_FORWARD_PER_S = 1.0
FEED_FORWARD_FADES_MPS = 0.3
# Heights that differ by less count as equal.
SAME_HEIGHT_M = 0.05
# Begins the reasons of the limits of height.
_ALTITUDE = "altitude"
# Part of the maximum acceleration that is planned for stopping at a fence; the rest covers delay.
FENCE_BRAKING = 0.5
# Delay of a multirotor's velocity response.
FENCE_DELAY_S = 0.4
# Maximum speed per metre left: critically damped for a velocity time constant of 0.3 s.
FENCE_GAIN_PER_S = 0.8
NO_FENCE = Fence()
_PX4_LIMITS = {
    "max_horizontal_speed_mps": "MPC_XY_VEL_MAX",
    "max_climb_mps": "MPC_Z_VEL_MAX_UP",
    "max_descend_mps": "MPC_Z_VEL_MAX_DN",
}


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of setpoints.

    Attributes:
        max_horizontal_speed_mps: horizontal speed.
        max_climb_mps, max_descend_mps: upwards, downwards.
        max_yaw_rate_radps: either way.
        max_acceleration_mps2: of a commanded velocity.
        min_altitude_m, max_altitude_m: band above home.
        max_distance_m: horizontally from home.
        fence: inclusion and exclusion polygons about home.
        min_separation_m: to every other vehicle that publishes its pose.

    Raises:
        ValueError: a limit is not finite and positive, or the band of altitudes is empty.
    """

    max_horizontal_speed_mps: float = 5.0
    max_climb_mps: float = 2.0
    max_descend_mps: float = 1.0
    max_yaw_rate_radps: float = 1.0
    max_acceleration_mps2: float = 3.0
    min_altitude_m: float = 1.0
    max_altitude_m: float = 50.0
    max_distance_m: float = 200.0
    fence: Fence = NO_FENCE
    min_separation_m: float = 3.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name != "fence" and not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{field.name} must be a finite number above 0, got {value}")
        if self.min_altitude_m >= self.max_altitude_m:
            raise ValueError(
                f"min_altitude_m must be below max_altitude_m, got {self.min_altitude_m} "
                f"and {self.max_altitude_m}"
            )


def within_autopilot(limits: Limits, read: AutopilotParameters) -> tuple[Limits, str]:
    """The limits as far as the autopilot flies our velocities, and what it reduces, in words; empty: nothing.

    PX4 limits them by its own parameters (v1.14 to v1.18). Copter's WPNAV_SPEED and WP_SPD do not limit
    velocities in GUIDED (4.7, from source).
    """
    changes: dict[str, Any] = {}
    words = []
    for field, name in _PX4_LIMITS.items():
        value = read.get(name)
        if value is not None and 0.0 < value < getattr(limits, field):
            changes[field] = value
            words.append(f"{name} {value:g} m/s is below guidance.{field} = {getattr(limits, field):g}")
    if not changes:
        return limits, ""
    return replace(limits, **changes), f"speed limited by the autopilot: {', '.join(words)}"


def is_of_height(reason: str) -> bool:
    """Return whether a reason of `Limited` is a limit of height."""
    return reason.startswith(_ALTITUDE)


class Limited(NamedTuple):
    """The limited setpoint, and the limits that acted, in words."""

    sent: Setpoint
    reasons: tuple[str, ...]


class Envelope:
    """Applies `limits` to a stream of setpoints; keeps the last one for acceleration and yaw rate.

    Attributes:
        obstacle_constraints: (north, east) unit direction, and the speed allowed in it.
    """

    def __init__(self, limits: Limits | None = None) -> None:
        self.limits = limits or Limits()
        self._velocity: Vector3 | None = None
        self._home: Vector3 | None = None
        self._yaw_rad: float | None = None
        self._neighbours: Sequence[Neighbour] = ()
        self._landing = False
        self.obstacle_constraints: tuple[tuple[float, float, float], ...] = ()
        self._easing = False

    def change_limits(self, limits: Limits) -> None:
        """Use other limits. A sent velocity outside them is reduced with the maximum acceleration."""
        self.limits, self._easing = limits, True

    def reset(self) -> None:
        """Forget the last setpoint: the next one starts from the measured velocity."""
        self._velocity = self._yaw_rad = None

    def check_goal(self, goal: Vector3, state: VehicleState) -> str | None:
        """Why a goal (local NED metres) violates the limits; None: it is allowed.

        The vehicle's current height is always allowed.
        """
        home = state.home_position_ned_m or self._home or (0.0, 0.0, 0.0)
        away = (goal[0] - home[0], goal[1] - home[1])
        where = f"{away[0]:.1f} m north and {away[1]:.1f} m east of home"
        if math.hypot(*away) > self.limits.max_distance_m:
            return f"{where} exceeds guidance.max_distance_m = {self.limits.max_distance_m:g}"
        if not self.limits.fence.contains(away):
            return f"{where} is outside the fence (guidance.fence_include, fence_exclude)"
        here = state.position_ned_m
        if here is not None and abs(goal[2] - here[2]) <= SAME_HEIGHT_M:
            return None
        height_m, low_m, high_m = home[2] - goal[2], self.limits.min_altitude_m, self.limits.max_altitude_m
        if height_m > high_m + SAME_HEIGHT_M:
            return f"{height_m:.1f} m above home exceeds guidance.max_altitude_m = {high_m:g}"
        if height_m < low_m - SAME_HEIGHT_M:
            return f"{height_m:.1f} m above home is below guidance.min_altitude_m = {low_m:g}"
        return None

    def apply(
        self,
        setpoint: Setpoint,
        state: VehicleState,
        now_ns: int,
        dt_s: float,
        neighbours: Sequence[Neighbour] = (),
        *,
        landing: bool = False,
    ) -> Limited:
        """Limit a setpoint.

        Args:
            setpoint: from the behaviour.
            state: position, velocity and home of the vehicle.
            now_ns: CLOCK_MONOTONIC nanoseconds.
            dt_s: since the last call; at most 0.2 s is used.
            neighbours: other vehicles to keep separation from.
            landing: the minimum altitude does not apply.

        Without a known position a position setpoint is replaced by a brake.
        """
        dt_s = max(0.0, min(dt_s, LONGEST_STEP_S))
        self._neighbours, self._landing = neighbours, landing
        reasons: list[str] = []
        if state.home_position_ned_m is not None:
            self._home = state.home_position_ned_m
        elif self._home is not None:
            # An autopilot may send it again only later; until then the last one is used.
            state = with_fields(state, home_position_ned_m=self._home)
        elif self.limits.fence != NO_FENCE:
            self.reset()
            return Limited(Setpoint.brake(now_ns), ("home position not received: no fence without it",))
        if setpoint.position_ned_m is not None and state.position_ned_m is None:
            self.reset()
            return Limited(Setpoint.brake(now_ns), ("position unknown",))
        sent = setpoint
        if setpoint.velocity_ned_mps is not None:
            velocity = self._limit_velocity(setpoint.velocity_ned_mps, state, dt_s, reasons)
            self._velocity = velocity
            if velocity != setpoint.velocity_ned_mps:
                sent = replace(sent, velocity_ned_mps=velocity)
            if setpoint.acceleration_ned_mps2 is not None:
                forward = self._limit_feed_forward(setpoint.acceleration_ned_mps2, velocity, state, reasons)
                sent = replace(sent, acceleration_ned_mps2=forward)
        elif setpoint.position_ned_m is not None and state.position_ned_m is not None:
            position = self._limit_position(setpoint.position_ned_m, state.position_ned_m, state, reasons)
            self._velocity = None
            if position != setpoint.position_ned_m:
                sent = replace(sent, position_ned_m=position)
        return Limited(self._limit_yaw(sent, state, dt_s, reasons), tuple(reasons))

    def _limit_velocity(
        self, asked: Vector3, state: VehicleState, dt_s: float, reasons: list[str]
    ) -> Vector3:
        before = self._velocity if self._easing else None
        least = _Least(before, self.limits.max_acceleration_mps2 * dt_s)
        limits = self._eased(least)
        parts = (
            (limits.max_horizontal_speed_mps, math.hypot(asked[0], asked[1]), "horizontal speed"),
            (limits.max_climb_mps, -asked[2], "climb"),
            (limits.max_descend_mps, asked[2], "descent"),
        )
        scale = 1.0
        for limit, value, what in parts:
            if value > limit * (1.0 + 1e-12):
                # All axes are scaled alike, to keep the direction.
                scale = min(scale, limit / value)
                reasons.append(f"{what} limited to {limit:g} m/s")
        north, east, down = (value * scale for value in asked) if scale < 1.0 else asked
        velocity = self._slew((north, east, down), state, dt_s, reasons)
        # Last, so that the acceleration limit does not delay braking at a fence.
        north, east, down = self._slow_at_fences(velocity, state, reasons, least)
        self._easing = least.acted
        return (*_shorten((north, east, 0.0), limits.max_horizontal_speed_mps)[:2], down)

    def _eased(self, least: _Least) -> Limits:
        """The limits of speed, above the changed ones where the sent velocity is still being reduced."""
        limits = self.limits
        if least.sent is None:
            return limits
        north, east, down = least.sent
        return replace(
            limits,
            max_horizontal_speed_mps=least.of(limits.max_horizontal_speed_mps, math.hypot(north, east)),
            max_climb_mps=least.of(limits.max_climb_mps, -down),
            max_descend_mps=least.of(limits.max_descend_mps, down),
        )

    def _limit_feed_forward(
        self, asked: Vector3, sent: Vector3, state: VehicleState, reasons: list[str]
    ) -> Vector3 | None:
        """Limit the feed-forward acceleration: horizontal, and only to turn or keep the sent velocity.

        It is at most the maximum acceleration, and FEED_FORWARD_PER_S times the sent speed. Along the
        velocity it fades out as the vehicle reaches the sent speed. It is dropped where it would lead nearer
        to a fence, an obstacle or a neighbour than the limits allow.
        """
        speed, velocity = math.hypot(sent[0], sent[1]), state.velocity_ned_mps
        if velocity is None or state.position_ned_m is None:
            reasons.append("position or velocity unknown: no feed-forward")
            return None
        if speed < 1e-6:
            return None
        most = min(self.limits.max_acceleration_mps2, FEED_FORWARD_PER_S * speed)
        north, east, _ = _shorten(asked, most)
        direction = (sent[0] / speed, sent[1] / speed)
        along = north * direction[0] + east * direction[1]
        if along > 0.0:
            missing = speed - (velocity[0] * direction[0] + velocity[1] * direction[1])
            taken = along * (1.0 - max(0.0, min(1.0, missing / FEED_FORWARD_FADES_MPS)))
            north, east = north - taken * direction[0], east - taken * direction[1]
        ahead = (velocity[0] + north * FEED_FORWARD_S, velocity[1] + east * FEED_FORWARD_S, velocity[2])
        if self._cut_mps(ahead, state) > self._cut_mps(velocity, state) + 1e-6:
            reasons.append("no feed-forward towards a limit")
            return None
        return (north, east, 0.0)

    def _cut_mps(self, velocity: Vector3, state: VehicleState) -> float:
        """How much of a velocity fences, obstacles and neighbours remove, m/s."""
        return math.dist(velocity, self._slow_at_fences(velocity, state, []))

    def _slow_at_fences(
        self, velocity: Vector3, state: VehicleState, reasons: list[str], least: _Least | None = None
    ) -> Vector3:
        """Limit the velocity so that the vehicle stops before fences, altitude limits and neighbours.

        `least`: what a changed limit of altitude or distance leaves of the sent velocity.
        """
        limits, altitude_m, least = self.limits, state.altitude_m, least or _Least(None, 0.0)
        if state.position_ned_m is None or altitude_m is None:
            return velocity
        constraints = self._separation_constraints(state.position_ned_m)
        velocity = self._keep_separation(velocity, constraints, reasons)
        north, east, down = velocity
        sent_north, sent_east, sent_down = least.sent or (0.0, 0.0, 0.0)
        climb_mps = least.of(self._towards_fence(limits.max_altitude_m - altitude_m), -sent_down)
        descend_mps = self._towards_fence(altitude_m - limits.min_altitude_m)
        if not self._landing:
            descend_mps = least.of(descend_mps, sent_down)
        if down < -climb_mps:
            down = -climb_mps
            reasons.append(f"{_ALTITUDE} limited to {limits.max_altitude_m:g} m")
        elif not self._landing and down > descend_mps:
            down = descend_mps
            reasons.append(f"{_ALTITUDE} kept above {limits.min_altitude_m:g} m")
        home = state.home_position_ned_m or (0.0, 0.0, 0.0)
        away = (state.position_ned_m[0] - home[0], state.position_ned_m[1] - home[1])
        distance_m = math.hypot(*away)
        # Distance from home is one more constraint of the same projection.
        circle: list[tuple[float, float, float]] = list(self.obstacle_constraints)
        if distance_m > 0.0:
            outwards = (away[0] / distance_m, away[1] / distance_m)
            allowed_mps = self._towards_fence(limits.max_distance_m - distance_m)
            allowed_mps = least.of(allowed_mps, sent_north * outwards[0] + sent_east * outwards[1])
            circle.append((*outwards, allowed_mps))
            if north * circle[-1][0] + east * circle[-1][1] > allowed_mps + 1e-9:
                reasons.append(f"distance from home limited to {limits.max_distance_m:g} m")
        circle += level_constraints(constraints, down)
        over_ground = limits.fence.limit_velocity((north, east), away, self._towards_fence, also=circle)
        if math.dist(over_ground, (north, east)) > 1e-9:
            if not reasons or not reasons[-1].startswith("distance from home"):
                reasons.append(self._what_slows((north, east)))
            north, east = over_ground
        return (north, east, down)

    def _separation_constraints(self, position: Vector3) -> list[SpeedConstraint]:
        limits = self.limits
        return constraints_at(
            position, self._neighbours, limits.min_separation_m, BRAKING * limits.max_acceleration_mps2
        )

    def _keep_separation(
        self, velocity: Vector3, constraints: Sequence[SpeedConstraint], reasons: list[str]
    ) -> Vector3:
        """Limit the velocity to keep separation from the neighbours."""
        left, because_of = apply_separation(velocity, constraints)
        if because_of:
            names = ", ".join(repr(name) for name in because_of)
            reasons.append(f"separation limit: {self.limits.min_separation_m:g} m to {names}")
        return left

    def _what_slows(self, velocity: tuple[float, float]) -> str:
        by_obstacle = any(
            velocity[0] * one[0] + velocity[1] * one[1] > one[2] + 1e-9 for one in self.obstacle_constraints
        )
        return "speed limited by an obstacle" if by_obstacle else "speed limited by the fence"

    def _towards_fence(self, left_m: float) -> float:
        """The speed from which the vehicle stops within a distance, including its delay."""
        braking = FENCE_BRAKING * self.limits.max_acceleration_mps2
        late = braking * FENCE_DELAY_S
        left_m = max(0.0, left_m)
        return min(math.sqrt(late**2 + 2.0 * braking * left_m) - late, FENCE_GAIN_PER_S * left_m)

    def _slew(self, asked: Vector3, state: VehicleState, dt_s: float, reasons: list[str]) -> Vector3:
        """Limit the change of the velocity to the maximum acceleration; never exceed the requested one."""
        previous = self._velocity or state.velocity_ned_mps or (0.0, 0.0, 0.0)
        step = (asked[0] - previous[0], asked[1] - previous[1], asked[2] - previous[2])
        size, allowed = math.hypot(*step), self.limits.max_acceleration_mps2 * dt_s
        if size <= allowed + 1e-9:
            return asked
        part = allowed / size
        north, east, down = (p + s * part for p, s in zip(previous, step, strict=True))
        north, east, _ = _shorten((north, east, 0.0), math.hypot(asked[0], asked[1]))
        down = max(min(asked[2], 0.0), min(max(asked[2], 0.0), down))
        if (north, east, down) != asked and math.dist((north, east, down), asked) > 1e-9:
            reasons.append(f"acceleration limited to {self.limits.max_acceleration_mps2:g} m/s²")
            return (north, east, down)
        return asked

    def _limit_position(
        self, asked: Vector3, here: Vector3, state: VehicleState, reasons: list[str]
    ) -> Vector3:
        limits = self.limits
        home = state.home_position_ned_m or (0.0, 0.0, 0.0)
        lowest_down = math.inf if self._landing else home[2] - limits.min_altitude_m
        down = max(home[2] - limits.max_altitude_m, min(lowest_down, asked[2]))
        if down != asked[2]:
            reasons.append(f"altitude kept within {limits.min_altitude_m:g} to {limits.max_altitude_m:g} m")
        away = _shorten((asked[0] - home[0], asked[1] - home[1], 0.0), limits.max_distance_m)
        position = (home[0] + away[0], home[1] + away[1], down)
        if math.dist(position[:2], asked[:2]) > 1e-9:
            reasons.append(f"distance from home limited to {limits.max_distance_m:g} m")
        else:
            position = (asked[0], asked[1], down)

        goal = (position[0] - home[0], position[1] - home[1])
        inside = limits.fence.clip((here[0] - home[0], here[1] - home[1]), goal)
        if inside != goal:
            position = (home[0] + inside[0], home[1] + inside[1], down)
            reasons.append("position limited by the fence")
        path = (position[0] - here[0], position[1] - here[1])
        active = (path[0] * POSITION_GAIN_PER_S, path[1] * POSITION_GAIN_PER_S)
        freed = NO_FENCE.limit_velocity(active, here[:2], abs, self.obstacle_constraints)
        if math.dist(freed, active) > 1e-9:
            reach_s = 1.0 / POSITION_GAIN_PER_S
            position = (here[0] + freed[0] * reach_s, here[1] + freed[1] * reach_s, position[2])
            reasons.append("speed limited by an obstacle")
        offset = (position[0] - here[0], position[1] - here[1], 0.0)
        carrot = _shorten(offset, limits.max_horizontal_speed_mps / POSITION_GAIN_PER_S)
        if carrot != offset:
            position = (here[0] + carrot[0], here[1] + carrot[1], position[2])
            reasons.append(f"horizontal speed limited to {limits.max_horizontal_speed_mps:g} m/s")
        highest = here[2] - limits.max_climb_mps / POSITION_GAIN_PER_S
        lowest = here[2] + limits.max_descend_mps / POSITION_GAIN_PER_S
        if position[2] < highest:
            position = (position[0], position[1], highest)
            reasons.append(f"climb limited to {limits.max_climb_mps:g} m/s")
        elif position[2] > lowest:
            position = (position[0], position[1], lowest)
            reasons.append(f"descent limited to {limits.max_descend_mps:g} m/s")
        # The speed towards a position is proportional to the distance, so the same law applies.
        north, east, down = (POSITION_GAIN_PER_S * (p - h) for p, h in zip(position, here, strict=True))
        left = self._keep_separation((north, east, down), self._separation_constraints(here), reasons)
        if left != (north, east, down):
            north, east, down = (h + v / POSITION_GAIN_PER_S for h, v in zip(here, left, strict=True))
            return (north, east, down)
        return position

    def _limit_yaw(
        self, setpoint: Setpoint, state: VehicleState, dt_s: float, reasons: list[str]
    ) -> Setpoint:
        """Limit a yaw rate, or the rate of change of a yaw setpoint."""
        limit = self.limits.max_yaw_rate_radps
        if setpoint.yaw_rate_radps is not None:
            self._yaw_rad = None
            rate = max(-limit, min(limit, setpoint.yaw_rate_radps))
            if rate == setpoint.yaw_rate_radps:
                return setpoint
            reasons.append(f"yaw rate limited to {limit:g} rad/s")
            return replace(setpoint, yaw_rate_radps=rate)
        previous = self._yaw_rad if self._yaw_rad is not None else state.yaw_rad
        self._yaw_rad = setpoint.yaw_rad
        if setpoint.yaw_rad is None or previous is None:
            return setpoint
        turn = wrap_angle(setpoint.yaw_rad - previous)
        if abs(turn) <= limit * dt_s + 1e-9:
            return setpoint
        self._yaw_rad = wrap_angle(previous + math.copysign(limit * dt_s, turn))
        reasons.append(f"yaw rate limited to {limit:g} rad/s")
        return replace(setpoint, yaw_rad=self._yaw_rad)


class _Least:
    """What changed limits leave of a speed: that of the last setpoint, less the maximum acceleration's share.

    Attributes:
        sent: the last setpoint's velocity; None: no limit was changed, or nothing is sent.
        acted: a speed is above its limit.
    """

    def __init__(self, sent: Vector3 | None, step_mps: float) -> None:
        self.sent, self._step_mps, self.acted = sent, step_mps, False

    def of(self, allowed_mps: float, sent_mps: float) -> float:
        """The allowed speed, or a larger one that the sent speed may be reduced to in this step."""
        if self.sent is None or sent_mps - self._step_mps <= allowed_mps:
            return allowed_mps
        self.acted = True
        return sent_mps - self._step_mps


def _shorten(vector: Vector3, longest: float) -> Vector3:
    """Limit the horizontal length to `longest`; down is unchanged."""
    length = math.hypot(vector[0], vector[1])
    if length <= longest * (1.0 + 1e-12):
        return vector
    scale = longest / length
    return (vector[0] * scale, vector[1] * scale, vector[2])
