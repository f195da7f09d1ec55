"""Collision prevention in Position mode: limits the sticks' acceleration near obstacles (CP_DIST).

OBSTACLE_DISTANCE fills a map of sectors around the vehicle; `limited_acceleration` limits the pilot's
acceleration setpoint by it. PX4 uses it in Position mode only, never in OFFBOARD or an auto mode.
Vectors are (north, east).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from mavlink_sim.px4.parameters import Parameters

Plane = tuple[float, float]

SECTORS = 72
SECTOR_DEG = 5.0
UNKNOWN_CM = 65535
STALE_S = 0.5  # RANGE_STREAM_TIMEOUT_US
HOLD_AFTER_S = 5.0  # TIMEOUT_HOLD_US
STICK_THRESHOLD_MPS2 = 0.001
# MAV_FRAME
FRAME_GLOBAL = 0
FRAME_LOCAL_NED = 1
FRAME_BODY_FRD = 12
SUPPORTED_FRAMES = frozenset({FRAME_GLOBAL, FRAME_LOCAL_NED, FRAME_BODY_FRD})


@dataclass(frozen=True, slots=True)
class Limited:
    """A limited setpoint.

    Attributes:
        acceleration: m/s², (north, east).
        hold: no data for 5 s; PX4 changes from Position mode to HOLD.
    """

    acceleration: Plane
    hold: bool = False


class ObstacleMap:
    """The newest distance in each of 72 sectors of 5°, sector 0 around the nose, clockwise, in centimetres.

    Attributes:
        distances_cm: UNKNOWN_CM where unknown.
        stamp_s: time of the newest message, seconds since boot.
        used_s: when collision prevention last used it; PX4 publishes the map only then.
        min_distance_cm, max_distance_cm: the widest range of any sensor so far.
        activated_s: when collision prevention was first active.
    """

    def __init__(self) -> None:
        self.distances_cm = [UNKNOWN_CM] * SECTORS
        self.ranges_cm = [0] * SECTORS
        self.stamps_s = [-math.inf] * SECTORS
        self.covered = [False] * SECTORS
        self.min_distance_cm = UNKNOWN_CM
        self.max_distance_cm = 0
        self.stamp_s = -math.inf
        self.used_s = -math.inf
        self.activated_s: float | None = None

    def add(
        self,
        distances_cm: Sequence[int],
        increment_deg: float,
        offset_deg: float,
        min_distance_cm: int,
        max_distance_cm: int,
        frame: int,
        yaw_rad: float,
        now_s: float,
    ) -> None:
        """Add an OBSTACLE_DISTANCE message.

        Args:
            distances_cm: clockwise from the offset; UNKNOWN_CM where not measured, more than the maximum
                where nothing is in range.
            offset_deg: of the first sector from the nose (body frame) or from north.
            yaw_rad: the vehicle's heading now.

        Raises ValueError for a frame that PX4 does not support here.
        """
        if frame not in SUPPORTED_FRAMES:
            raise ValueError(f"Obstacle message received in unsupported frame {frame}")
        if not increment_deg > 0.0 or not math.isfinite(offset_deg):
            return
        self.stamp_s = now_s
        self.min_distance_cm = min(self.min_distance_cm, min_distance_cm)
        self.max_distance_cm = max(self.max_distance_cm, max_distance_cm)
        shift = offset_deg - (0.0 if frame == FRAME_BODY_FRD else math.degrees(yaw_rad))
        count = min(len(distances_cm), SECTORS, math.ceil(360.0 / increment_deg))
        for index in range(count):
            if distances_cm[index] == UNKNOWN_CM:
                continue
            lower = index * increment_deg + shift - increment_deg / 2.0
            # every sector that the measured one overlaps; a shared edge is no overlap
            first = math.floor((lower + SECTOR_DEG / 2.0) / SECTOR_DEG + 1e-6)
            last = math.ceil((lower + increment_deg + SECTOR_DEG / 2.0) / SECTOR_DEG - 1e-6) - 1
            for sector in range(first, min(last, first + SECTORS - 1) + 1):
                self._enter(sector % SECTORS, distances_cm[index], max_distance_cm, now_s)

    def _enter(self, sector: int, distance_cm: int, range_cm: int, now_s: float) -> None:
        """Store a measurement, unless another sensor measured a nearer object."""
        known, known_range = self.distances_cm[sector], self.ranges_cm[sector]
        seen = known < known_range  # an obstacle
        if distance_cm < range_cm:
            better = not seen or range_cm <= known_range
        else:
            better = range_cm == known_range if seen else range_cm >= known_range
        if better:
            self.distances_cm[sector], self.ranges_cm[sector] = distance_cm, range_cm
            self.stamps_s[sector], self.covered[sector] = now_s, True

    def forget_stale(self, now_s: float) -> None:
        """Drop what is older than half a second."""
        for sector, stamp in enumerate(self.stamps_s):
            if now_s - stamp > STALE_S:
                self.distances_cm[sector] = UNKNOWN_CM

    def has_data(self, now_s: float) -> bool:
        """Whether any sector is known."""
        return now_s - self.stamp_s < STALE_S and min(self.distances_cm) < UNKNOWN_CM


def limited_acceleration(
    acceleration: Plane,
    velocity: Plane,
    yaw_rad: float,
    obstacles: ObstacleMap,
    parameters: Parameters,
    now_s: float,
) -> Limited:
    """Limit the acceleration setpoint of the sticks in Position mode.

    Args:
        acceleration: the sticks' setpoint, m/s² (north, east).
        velocity: the velocity setpoint, m/s (north, east).
        yaw_rad: heading. now_s: seconds since boot.

    With CP_DIST not above zero there is no limit. Without data the result is zero. Otherwise the setpoint is
    turned by up to CP_GUIDE_ANG towards the freer side, reduced towards CP_DIST, and the vehicle brakes where
    it would not stop in time (CP_DELAY, MPC_JERK_MAX, MPC_ACC_HOR).
    """
    keep_m = parameters.number("CP_DIST")
    if not keep_m > 0.0:
        obstacles.activated_s = None
        return Limited(acceleration)
    if obstacles.activated_s is None:
        obstacles.activated_s = now_s
    obstacles.used_s = now_s
    obstacles.forget_stale(now_s)
    if not obstacles.has_data(now_s):
        silent_s = now_s - max(obstacles.stamp_s, obstacles.activated_s)
        return Limited((0.0, 0.0), hold=silent_s > HOLD_AFTER_S)
    size = math.hypot(*acceleration)
    if size <= STICK_THRESHOLD_MPS2:
        return Limited(acceleration)
    keep_m = max(obstacles.min_distance_cm / 100.0, keep_m)
    asked = (acceleration[0] / size, acceleration[1] / size)
    sector = math.floor(_bearing_deg(asked, yaw_rad) / SECTOR_DEG) % SECTORS
    guided = _guided_sector(sector, obstacles, parameters)
    direction = asked if guided == sector else _direction(guided, yaw_rad)
    north, east = 0.0, 0.0
    if _may_go(guided, obstacles, parameters):
        north, east = _slowed(direction, size, yaw_rad, keep_m, obstacles, parameters)
    brake_north, brake_east = _braking(velocity, yaw_rad, keep_m, obstacles, parameters, now_s)
    return Limited((north + brake_north, east + brake_east))


def _bearing_deg(direction: Plane, yaw_rad: float) -> float:
    return math.degrees(math.atan2(direction[1], direction[0]) - yaw_rad) % 360.0


def _direction(sector: int, yaw_rad: float) -> Plane:
    angle = yaw_rad + math.radians(sector * SECTOR_DEG)
    return math.cos(angle), math.sin(angle)


def _may_go(sector: int, obstacles: ObstacleMap, parameters: Parameters) -> bool:
    """Whether a sector without data may be flown into: with CP_GO_NO_DATA, and if no sensor covers it."""
    if obstacles.distances_cm[sector] < UNKNOWN_CM:
        return True
    return bool(parameters.number("CP_GO_NO_DATA")) and not obstacles.covered[sector]


def _guided_sector(asked: int, obstacles: ObstacleMap, parameters: Parameters) -> int:
    """The freest sector within CP_GUIDE_ANG of the demanded one, weighted by the detour."""
    keep_cm = parameters.number("CP_DIST") * 100.0
    reach = min(max(math.floor(parameters.number("CP_GUIDE_ANG") / SECTOR_DEG), 0), SECTORS // 2)
    distances = obstacles.distances_cm
    best, best_cost = asked, 9999.0  # PX4's start value: a higher cost is never worth a detour
    for sector in range(asked - reach, asked + reach + 1):
        known = distances[sector % SECTORS]
        if known == UNKNOWN_CM:
            continue
        around = (distances[(sector + side) % SECTORS] for side in (-1, 0, 1))
        mean = sum(keep_cm if value == UNKNOWN_CM else value for value in around) / 3.0
        cost = keep_cm / 2.0 * abs(sector - asked) - mean - known
        if cost < best_cost:
            best, best_cost = sector % SECTORS, cost
    return best


def _slowed(
    direction: Plane,
    size: float,
    yaw_rad: float,
    keep_m: float,
    obstacles: ObstacleMap,
    parameters: Parameters,
) -> Plane:
    """The setpoint with its components towards and along the nearest obstacle reduced."""
    nearest = min(range(SECTORS), key=obstacles.distances_cm.__getitem__)
    towards = _direction(nearest, yaw_rad)
    share = direction[0] * towards[0] + direction[1] * towards[1]
    if share <= 0.0:  # away from it: not limited
        return direction[0] * size, direction[1] * size
    normal = (towards[0] * share, towards[1] * share)
    along = (direction[0] - normal[0], direction[1] - normal[1])
    normal_scale = _scale(obstacles.distances_cm[nearest] / 100.0, keep_m, parameters)
    along_m = 0.0
    if math.hypot(*along) > 1e-6:
        sector = round(_bearing_deg(along, yaw_rad) / SECTOR_DEG) % SECTORS
        along_m = obstacles.distances_cm[sector] / 100.0
    along_scale = _scale(along_m, keep_m, parameters)
    return (
        (along[0] * along_scale + normal[0] * normal_scale) * size,
        (along[1] * along_scale + normal[1] * normal_scale) * size,
    )


def _scale(distance_m: float, keep_m: float, parameters: Parameters) -> float:
    """1 far away, falling with the square to 0 at the distance to keep; negative below it."""
    margin = distance_m - keep_m
    if margin <= 0.0:
        return margin
    full = max(keep_m, parameters.number("MPC_VEL_MANUAL") / parameters.positive("MPC_XY_P"))
    return min((margin / full) ** 2, 1.0)


def _braking(
    velocity: Plane,
    yaw_rad: float,
    keep_m: float,
    obstacles: ObstacleMap,
    parameters: Parameters,
    now_s: float,
) -> Plane:
    """The strongest braking of all sectors that stops the vehicle before the distance to keep."""
    gain = parameters.number("MPC_XY_VEL_P_ACC")
    strongest, brake = 0.0, (0.0, 0.0)
    for sector, distance_cm in enumerate(obstacles.distances_cm):
        if not obstacles.min_distance_cm < distance_cm < UNKNOWN_CM:
            continue
        towards = _direction(sector, yaw_rad)
        speed = max(velocity[0] * towards[0] + velocity[1] * towards[1], 0.0)
        delay_s = parameters.number("CP_DELAY")
        if distance_cm < obstacles.ranges_cm[sector]:
            delay_s += now_s - obstacles.stamps_s[sector]
        margin = distance_cm / 100.0 - keep_m - speed * delay_s
        allowed = _speed_to_stop_within(margin, parameters) if margin >= 0.0 else 0.0
        demanded = gain * min(allowed - speed, 0.0)
        if demanded < strongest:
            strongest, brake = demanded, (towards[0] * demanded, towards[1] * demanded)
    return brake


def _speed_to_stop_within(distance_m: float, parameters: Parameters) -> float:
    """The speed, m/s, from which the vehicle stops in this distance with MPC_ACC_HOR and MPC_JERK_MAX."""
    acceleration = parameters.positive("MPC_ACC_HOR")
    ramp = 4.0 * acceleration * acceleration / parameters.positive("MPC_JERK_MAX")
    return max(0.5 * (math.sqrt(ramp * ramp + 8.0 * acceleration * distance_m) - ramp), 0.0)
