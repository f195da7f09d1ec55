"""Speed towards what is near: no more than the way to it allows to stop in, less a margin.

Each sector that a depth camera saw something in bounds the speed in its direction. With an answer that comes
after L seconds and a deceleration a, v may be flown towards what is d away where v·L + v²/(2a) + margin <= d.
The bounds join the fence's in one projection (`Fence.slowed`): a wall shortens what leads into it and leaves
what leads along it. Inside the margin the vehicle backs out, at 0.8 m/s at most.

What the camera cannot see is unknown, not free. By default its speed is not limited all the same: a camera
that looks forward sees a fifth of the circle, and a vehicle that could not fly aside or follow its path round
a bend would leave its pilot no good way out. `guidance.max_speed_unobserved_mps` sets a limit for vehicles
that fly where they look.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

from companion.guidance.behaviour import Behaviour, BehaviourContext
from companion.guidance.limits.battery import needs_charge
from vision.obstacle_sectors import SECTOR_RAD, SECTORS, ObstacleSectors

ObstacleUse = Literal["off", "auto", "required"]
# How late a multirotor's velocity follows and how it stops, below what the built-in vehicle does: PX4 has
# gathered against drag on the way (MPC_XY_VEL_I_ACC), and goes on with that for a second when it should stop.
LATENCY_S = 0.6
DECELERATION_MPS2 = 0.7
# Against the nearest obstacle it is braked by asking for less than nothing, and what drifts into the margin
# is backed out of it: a zero alone is left with the wind and what was gathered, and so is a slow way back
# that is only asked for (one flight of a hundred was blown into a wall so).
BRAKING_GAIN, MOST_BRAKING_MPS, MOST_RETREAT_MPS = 1.5, 2.0, 0.8
# So the last metres are flown with no more speed than this for each of them.
GAIN_PER_S = 0.4
MAX_AGE_S = 0.5
# A few seconds: what is remembered for longer than a person needs to step aside is not there any more.
REMEMBERED_S = 8.0
REMEMBERED_WITHIN_M = 8.0
Row = tuple[float, float, float]

DIRECTIONS = tuple((math.cos(i * SECTOR_RAD), math.sin(i * SECTOR_RAD)) for i in range(SECTORS))


@dataclass(frozen=True, slots=True)
class ObstacleRules:
    """What of the operator's wishes concerns obstacles.

    Attributes:
        use: "off"; "auto": depth is used where it comes, and once it came it is relied on; "required":
            nothing flies without it.
        margin_m: from the vehicle's middle to what is near, at least.
        max_speed_unobserved_mps: towards what is not seen; None: not limited.

    Raises:
        ValueError: a number is not positive.
    """

    use: ObstacleUse = "off"
    margin_m: float = 2.0
    max_speed_unobserved_mps: float | None = None

    def __post_init__(self) -> None:
        for name in ("margin_m", "max_speed_unobserved_mps"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} must be a finite number above 0, got {value}")

    def missing(self, behaviour: Behaviour, context: BehaviourContext) -> str | None:
        """What a behaviour that flies lacks, in words; None: nothing."""
        if self.use != "required" or not needs_charge(behaviour) or fresh(context):
            return None
        return f"depth ({_age(context.obstacles, context.now_ns)}; guidance.obstacles is required)"

    def blind(self, context: BehaviourContext) -> str | None:
        """Why the vehicle must brake for want of depth; None: it need not."""
        relied_on = self.use == "required" or (self.use == "auto" and context.obstacles is not None)
        if not relied_on or fresh(context):
            return None
        return f"no depth to fly by: {_age(context.obstacles, context.now_ns)}"

    def rows(self, context: BehaviourContext) -> tuple[Row, ...]:
        """(north, east) unit direction and the speed allowed in it, of every sector that bounds one."""
        seen = context.obstacles
        if self.use == "off" or seen is None or not fresh(context):
            return ()
        late_s = LATENCY_S + (context.now_ns - seen.captured_ns) / 1e9
        rows = []
        for (north, east), distance_m in zip(DIRECTIONS, seen.distance_m, strict=True):
            if math.isfinite(distance_m):
                rows.append((north, east, speed_towards(distance_m - self.margin_m, late_s)))
            elif math.isnan(distance_m) and self.max_speed_unobserved_mps is not None:
                rows.append((north, east, self.max_speed_unobserved_mps))
        nearest_m = min((value for value in seen.distance_m if math.isfinite(value)), default=math.inf)
        if math.isfinite(nearest_m):
            north, east = DIRECTIONS[seen.distance_m.index(nearest_m)]
            rows.insert(0, (north, east, self._braking(nearest_m, (north, east), late_s, context)))
        return tuple(rows)

    def _braking(
        self, distance_m: float, direction: tuple[float, float], late_s: float, context: BehaviourContext
    ) -> float:
        """The speed allowed towards the nearest: below zero where the vehicle is too fast or too near."""
        left_m = distance_m - self.margin_m
        allowed = speed_towards(left_m, late_s) if left_m >= 0.0 else max(-MOST_RETREAT_MPS, left_m)
        north_mps, east_mps, _ = context.state.velocity_ned_mps or (0.0, 0.0, 0.0)
        excess = north_mps * direction[0] + east_mps * direction[1] - allowed
        if excess > 0.0:
            allowed -= min(MOST_BRAKING_MPS, BRAKING_GAIN * excess)
        return allowed


NO_RULES = ObstacleRules()


class ObstacleMemory:
    """What was seen a moment ago and is out of the picture now is still there.

    Places of obstacles are kept, in local NED, for `REMEMBERED_S`, and fill the sectors that are not seen.
    A sector that is seen again is as it is seen.
    """

    def __init__(self) -> None:
        self._places: list[tuple[int, float, float]] = []
        self._newest_ns = 0

    def filled(self, context: BehaviourContext) -> BehaviourContext:
        """The context, with remembered obstacles in its unknown sectors."""
        seen, position = context.obstacles, context.state.position_ned_m
        if seen is None or position is None:
            return context
        oldest_ns = context.now_ns - REMEMBERED_S * 1e9
        kept, distances = [], list(seen.distance_m)
        for stamp_ns, north, east in self._places:
            away = (north - position[0], east - position[1])
            sector = round(math.atan2(away[1], away[0]) / SECTOR_RAD) % SECTORS
            if stamp_ns < oldest_ns or not math.isnan(seen.distance_m[sector]):
                continue
            kept.append((stamp_ns, north, east))
            known = distances[sector]
            distances[sector] = math.hypot(*away) if math.isnan(known) else min(known, math.hypot(*away))
        self._places = kept
        if seen.captured_ns != self._newest_ns:
            self._newest_ns = seen.captured_ns
            for (north, east), distance_m in zip(DIRECTIONS, seen.distance_m, strict=True):
                if distance_m <= REMEMBERED_WITHIN_M:
                    place = (position[0] + distance_m * north, position[1] + distance_m * east)
                    self._places.append((seen.captured_ns, *place))
        return replace(context, obstacles=replace(seen, distance_m=tuple(distances)))


def speed_towards(left_m: float, late_s: float, deceleration_mps2: float = DECELERATION_MPS2) -> float:
    """The speed from which the vehicle stops in so much way, which begins when it answers; 0 or more."""
    late = deceleration_mps2 * late_s
    left_m = max(0.0, left_m)
    return min(math.sqrt(late**2 + 2.0 * deceleration_mps2 * left_m) - late, GAIN_PER_S * left_m)


def fresh(context: BehaviourContext) -> bool:
    """There are sectors, no older than `MAX_AGE_S`."""
    seen = context.obstacles
    return seen is not None and context.now_ns - seen.captured_ns <= MAX_AGE_S * 1e9


def obstacles_message(seen: ObstacleSectors, vehicle: str) -> dict[str, object]:
    """As published: 72 distances of level sectors, clockwise from north; null: nothing there, or unknown."""
    return {
        "vehicle": vehicle,
        "captured_ns": seen.captured_ns,
        "frame": "north",
        "increment_deg": math.degrees(SECTOR_RAD),
        "distance_m": _finite(seen.distance_m),
        "known": [not math.isnan(value) for value in seen.distance_m],
    }


def _finite(values: Sequence[float]) -> list[float | None]:
    return [round(value, 2) if math.isfinite(value) else None for value in values]


def _age(seen: ObstacleSectors | None, now_ns: int) -> str:
    return "none came yet" if seen is None else f"the newest is {(now_ns - seen.captured_ns) / 1e9:.1f} s old"
