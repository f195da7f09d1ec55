"""Fly to a place between obstacles, with a range sensor."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mavlink_sim.environments import drawing
from mavlink_sim.environments.flight_task import FlightTask
from mavlink_sim.environments.spaces import MAX_RANGE_M, OBSTACLES_OBSERVATION, SECTORS_DEG, Array

TREES = 6
TREE_RADIUS_M = (0.2, 0.6)
ACROSS_M = 5.0
CLEAR_M = 4.0  # along the course, at both ends
START_M = (16.0, 25.0)
REACHED_M = 1.0
VEHICLE_RADIUS_M = 0.35
HIGHEST_M = 8.0
FARTHEST_M = 40.0
_CENTRES = np.radians(SECTORS_DEG)[:, None, None]
_HALF_RAD = math.pi / len(SECTORS_DEG)


class Obstacles(FlightTask):
    """Fly to a given place around the trunks in between.

    The trunks are vertical cylinders without an end. The sensor measures the distance to the nearest one in
    each of 12 sectors; latency, noise and misses are its.

    Reward of a step: the metres by which the place has come nearer, less 0.02 and 0.05 times the squared
    change of the action. End: +10 within 1 m of the place; -10 at a trunk (0.35 m from the centre), below
    0.5 m, above 8 m, or farther than 40 m. Truncated after 30 s.
    """

    observation = OBSTACLES_OBSERVATION
    rows = len(SECTORS_DEG)

    def __init__(self, count: int, model: str = "fast", **conditions: object) -> None:
        self._trunks = np.zeros((2, TREES, count))
        self._radius_m = np.zeros((TREES, count))
        self._before_m = np.zeros(count)
        super().__init__(count, model, **conditions)

    def place(self, which: NDArray[np.intp], yaw_rad: Array, rng: np.random.Generator) -> None:
        size = len(which)
        distance = rng.uniform(*START_M, size)
        bearing = rng.uniform(-math.pi, math.pi, size)
        course = np.stack([np.cos(bearing), np.sin(bearing)])
        self.target[:2, which] = distance * course
        self.target[2, which] = -rng.uniform(*self.height_m, size)
        along = CLEAR_M + (distance - 2.0 * CLEAR_M) * rng.random((TREES, size))
        across = rng.uniform(-ACROSS_M, ACROSS_M, (TREES, size))
        north, east = course
        self._trunks[:, :, which] = np.stack([along * north - across * east, along * east + across * north])
        self._radius_m[:, which] = rng.uniform(*TREE_RADIUS_M, (TREES, size))
        self._before_m[which] = self.distance_m[which]

    def _lines(self) -> Array:
        """(2, TREES, count) from the vehicles to the trunks' axes, north and east."""
        lines: Array = self._trunks - self.model.position[:2, None]
        return lines

    def measure(self, rng: np.random.Generator) -> Array:
        """(12, count) ranges."""
        north, east = self._lines()
        distance = np.maximum(np.hypot(north, east), self._radius_m)
        bearing = np.arctan2(east, north) - self.model.yaw_rad
        off = np.abs((bearing - _CENTRES + math.pi) % math.tau - math.pi)
        inside = off < _HALF_RAD + np.arcsin(self._radius_m / distance)
        ranges = np.where(inside, distance - self._radius_m, MAX_RANGE_M).min(1)
        ranges *= 1.0 + self.noise * rng.standard_normal(ranges.shape)
        return np.asarray(np.minimum(ranges, MAX_RANGE_M))

    def visible(self) -> NDArray[np.bool_]:
        return np.ones(self.count, bool)

    def observe(self) -> Array:
        model = self.model
        target = self.level(self.target - model.estimated_position)
        return np.stack([*target, *self.level(model.estimated_velocity), *self.seen, self.age_s])

    def clearance_m(self) -> Array:
        """(count,) true distance to the nearest trunk."""
        return np.asarray((np.hypot(*self._lines()) - self._radius_m).min(0))

    def judge(self) -> tuple[Array, NDArray[np.bool_]]:
        distance, height = self.distance_m, -self.model.position[2]
        reached = distance < REACHED_M
        out = self.lost | (height > HIGHEST_M) | (distance > FARTHEST_M)
        failed = out | (self.clearance_m() < VEHICLE_RADIUS_M)
        reward = self._before_m - distance - 0.02 - 0.05 * self.change + 10.0 * reached - 10.0 * failed
        self._before_m = distance
        return reward, reached | failed

    def measures(self) -> dict[str, Array]:
        return {"target_distance_m": self.distance_m, "clearance_m": self.clearance_m()}

    def sketch(self, canvas: drawing.Canvas) -> None:
        canvas.circle(self.target[:, 0], REACHED_M, drawing.TARGET)
        for (north, east), radius in zip(self._trunks[:, :, 0].T, self._radius_m[:, 0], strict=True):
            canvas.circle((north, east, 0.0), radius, drawing.GREY, -1)
            canvas.line((north, east, 0.0), (north, east, -2.0 * HIGHEST_M), drawing.GREY)
