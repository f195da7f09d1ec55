"""Obstacle limits: the speed towards an obstacle allows the vehicle to stop before it, less a margin.

Each sector in which the depth camera sees an obstacle bounds the speed in its direction. With latency L and
deceleration a, the speed v towards an obstacle at distance d satisfies v·L + v²/(2a) + margin <= d. The
bounds join the fence's in one projection (`Fence.limit_velocity`): a wall limits velocity into it but not
along it. Inside the margin the vehicle backs out, at 0.8 m/s at most.

Unseen sectors are unknown, not free. By default the speed into them is not limited: a forward-looking camera
covers a fifth of the circle, and a vehicle unable to fly sideways or along a bend could not be flown out of
danger. `guidance.max_speed_unobserved_mps` sets a limit for vehicles that fly where they look.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

from companion.guidance.behaviour import Behaviour, BehaviourContext
from companion.guidance.limits.battery import needs_charge
from vision.obstacle_sectors import SECTOR_RAD, SECTORS, ObstacleSectors

ObstacleUse = Literal["off", "auto", "required"]
# A multirotor's velocity delay and deceleration, below those of the simulated vehicle: PX4's integral against
# drag (MPC_XY_VEL_I_ACC) persists for a second when the vehicle should stop.
LATENCY_S = 0.6
DECELERATION_MPS2 = 0.7
# Towards the nearest obstacle the allowed speed is negative, to brake harder and to back out of the margin: a
# zero command alone is exceeded by wind and the controller's integral (1 of 100 flights hit a wall that way).
BRAKING_GAIN, MOST_BRAKING_MPS, MOST_RETREAT_MPS = 1.5, 2.0, 0.8
# Maximum speed per metre left.
GAIN_PER_S = 0.4
# A few seconds: a person moves out of the way in less.
REMEMBERED_S = 8.0
REMEMBERED_WITHIN_M = 8.0
# Of the depth inside the margin, for an obstacle of the map: the nearest of them stays the nearest.
MAP_SHARE = 0.001
Constraint = tuple[float, float, float]

DIRECTIONS = tuple((math.cos(i * SECTOR_RAD), math.sin(i * SECTOR_RAD)) for i in range(SECTORS))


@dataclass(frozen=True, slots=True)
class ObstacleRules:
    """The operator's settings of obstacle limits.

    Attributes:
        use: "off"; "auto": depth is used if available, and required once it was received; "required":
            nothing flies without it.
        margin_m: minimum distance from the vehicle's centre to an obstacle.
        max_speed_unobserved_mps: into unseen sectors; None: not limited.
        max_age_s: of the depth image, since the capture.

    Raises:
        ValueError: a number is not positive.
    """

    use: ObstacleUse = "off"
    margin_m: float = 2.0
    max_speed_unobserved_mps: float | None = None
    max_age_s: float = 0.5

    def __post_init__(self) -> None:
        for name in ("margin_m", "max_speed_unobserved_mps", "max_age_s"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} must be a finite number above 0, got {value}")

    def fresh(self, context: BehaviourContext) -> bool:
        """Whether sectors no older than `max_age_s` are available."""
        seen = context.obstacles
        return seen is not None and context.now_ns - seen.captured_ns <= self.max_age_s * 1e9

    def missing(self, behaviour: Behaviour, context: BehaviourContext) -> str | None:
        """What is missing for a behaviour that flies, in words; None: nothing."""
        if self.use != "required" or not needs_charge(behaviour) or self.fresh(context):
            return None
        return f"depth ({_age(context.obstacles, context.now_ns)}; guidance.obstacles is required)"

    def blind(self, context: BehaviourContext) -> str | None:
        """Why the vehicle must brake without depth; None: it need not."""
        relied_on = self.use == "required" or (self.use == "auto" and context.obstacles is not None)
        if not relied_on or self.fresh(context):
            return None
        return f"no depth: {context.camera_fault or _age(context.obstacles, context.now_ns)}"

    def constraints(self, context: BehaviourContext) -> tuple[Constraint, ...]:
        """(north, east) unit direction and the speed allowed in it, for every limiting sector."""
        seen = context.obstacles
        if self.use == "off" or seen is None or not self.fresh(context):
            return ()
        late_s = LATENCY_S + (context.now_ns - seen.captured_ns) / 1e9
        constraints = []
        for (north, east), distance_m in zip(DIRECTIONS, seen.distance_m, strict=True):
            if math.isfinite(distance_m):
                constraints.append((north, east, speed_towards(distance_m - self.margin_m, late_s)))
            elif math.isnan(distance_m) and self.max_speed_unobserved_mps is not None:
                constraints.append((north, east, self.max_speed_unobserved_mps))
        nearest_m = min((value for value in seen.distance_m if math.isfinite(value)), default=math.inf)
        if math.isfinite(nearest_m):
            north, east = DIRECTIONS[seen.distance_m.index(nearest_m)]
            constraints.insert(0, (north, east, self._braking(nearest_m, (north, east), late_s, context)))
        return tuple(constraints)

    def _braking(
        self, distance_m: float, direction: tuple[float, float], late_s: float, context: BehaviourContext
    ) -> float:
        """Speed allowed towards the nearest obstacle; negative if the vehicle is too fast or too near."""
        left_m = distance_m - self.margin_m
        allowed = speed_towards(left_m, late_s) if left_m >= 0.0 else max(-MOST_RETREAT_MPS, left_m)
        north_mps, east_mps, _ = context.state.velocity_ned_mps or (0.0, 0.0, 0.0)
        excess = north_mps * direction[0] + east_mps * direction[1] - allowed
        if excess > 0.0:
            allowed -= min(MOST_BRAKING_MPS, BRAKING_GAIN * excess)
        return allowed


NO_RULES = ObstacleRules()


class ObstacleMemory:
    """Obstacles that were seen recently and have left the image, and those of the map (`guidance.avoid`).

    Their positions (local NED) are kept for `REMEMBERED_S` and fill unseen sectors. A sector that is seen
    again uses the measurement. A cell of the map may have been seen long ago, and the obstacle may have gone:
    it stops the vehicle at the margin, but does not move it away.
    """

    def __init__(self) -> None:
        self._points: list[tuple[int, float, float]] = []
        self._newest_ns = 0

    def filled(self, context: BehaviourContext, margin_m: float) -> BehaviourContext:
        """The context, with remembered obstacles in its unknown sectors; the map's not inside the margin."""
        seen, position = context.obstacles, context.state.position_ned_m
        if seen is None or position is None:
            return context
        distances = list(seen.distance_m)

        def fill(north: float, east: float, least_m: float = 0.0) -> bool:
            """Enter a point in its sector, if that is unseen."""
            away = (north - position[0], east - position[1])
            sector = round(math.atan2(away[1], away[0]) / SECTOR_RAD) % SECTORS
            if not math.isnan(seen.distance_m[sector]):
                return False
            known, away_m = distances[sector], math.hypot(*away)
            if away_m < least_m:
                away_m = least_m - MAP_SHARE * (least_m - away_m)
            distances[sector] = away_m if math.isnan(known) else min(known, away_m)
            return True

        oldest_ns = context.now_ns - REMEMBERED_S * 1e9
        self._points = [point for point in self._points if point[0] >= oldest_ns and fill(*point[1:])]
        if context.planned is not None and context.planned.captured_ns >= oldest_ns:
            for point in context.planned.near:
                fill(*point, least_m=margin_m)
        if seen.captured_ns != self._newest_ns:
            self._newest_ns = seen.captured_ns
            for (north, east), distance_m in zip(DIRECTIONS, seen.distance_m, strict=True):
                if distance_m <= REMEMBERED_WITHIN_M:
                    place = (position[0] + distance_m * north, position[1] + distance_m * east)
                    self._points.append((seen.captured_ns, *place))
        return replace(context, obstacles=replace(seen, distance_m=tuple(distances)))


def speed_towards(left_m: float, late_s: float, deceleration_mps2: float = DECELERATION_MPS2) -> float:
    """The speed from which the vehicle stops within a distance, including its latency; 0 or more."""
    late = deceleration_mps2 * late_s
    left_m = max(0.0, left_m)
    return min(math.sqrt(late**2 + 2.0 * deceleration_mps2 * left_m) - late, GAIN_PER_S * left_m)


def _age(seen: ObstacleSectors | None, now_ns: int) -> str:
    return "none received yet" if seen is None else f"newest {(now_ns - seen.captured_ns) / 1e9:.1f} s old"
