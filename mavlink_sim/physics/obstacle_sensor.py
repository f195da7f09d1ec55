"""A horizontal 360° range sensor, as a rotating lidar."""

from __future__ import annotations

import random

from mavlink_sim.physics.gaussian import BITS, NORMAL
from mavlink_sim.world.obstacles import Obstacles
from mavlink_sim.world.world import Vector

SECTOR_DEG = 5.0
MINIMUM_M, MAXIMUM_M = 0.2, 12.0
NOISE_M = 0.02  # standard deviation of each sector's range
MINIMUM_CM, MAXIMUM_CM = round(100 * MINIMUM_M), round(100 * MAXIMUM_M)
NOTHING_CM = MAXIMUM_CM + 1  # OBSTACLE_DISTANCE: nothing in range


class ObstacleSensor:
    """Measures the distance to the nearest obstacle in each of 72 sectors of 5°, at its own height.

    Args:
        seed: of its noise. noise: False for true ranges.
    """

    def __init__(self, obstacles: Obstacles, seed: int, noise: bool) -> None:
        self._obstacles = obstacles
        self._random = random.Random(f"obstacle sensor {seed}") if noise else None

    def measure(self, position_ned_m: Vector, yaw_rad: float, time_s: float) -> list[int]:
        """Centimetres, sector 0 around the nose, clockwise; NOTHING_CM where nothing is in range.

        Args:
            position_ned_m: of the sensor, in the world's frame. yaw_rad: of the nose, true.
        """
        ranges = self._obstacles.ranges_around(position_ned_m, yaw_rad, MAXIMUM_M, time_s)
        if self._random is not None:
            bits = self._random.getrandbits
            ranges = [value + NOISE_M * NORMAL[bits(BITS)] for value in ranges]
        return [NOTHING_CM if value > MAXIMUM_M else max(round(100 * value), MINIMUM_CM) for value in ranges]
