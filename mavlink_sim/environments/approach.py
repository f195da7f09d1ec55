"""Approach an object and hold a distance from it, or circle it, by sight."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mavlink_sim.environments.flight_task import FlightTask, Range
from mavlink_sim.environments.spaces import APPROACH_OBSERVATION, ORBIT_OBSERVATION, Array

START_BEARING_RAD = math.radians(30.0)
WANTED_M = (4.5, 10.0)
TARGET_HEIGHT_M = (0.3, 3.0)
FARTHEST_M = 40.0
NEAREST_M = 1.0
SCALE_M = 30.0


class Approach(FlightTask):
    """Fly to a wanted horizontal distance from an object, face it and hold there.

    Reward of a step, with the error of the true distance e (m), the bearing b of the object (rad, 0 ahead):
    max(0, 1 - e / 30) + exp(-2 e) - 0.3 |b| - 0.1 |climb rate, m/s| - 0.05 times the squared change of the
    action (each entry by its range), and -10 at an early end. End: the object is lost for 5 s, nearer than
    1 m or farther than 40 m, or the vehicle is below 0.5 m. Truncated after 30 s.
    """

    observation = APPROACH_OBSERVATION
    start_m: Range = (6.0, 30.0)
    height_m = (1.5, 4.5)

    def __init__(self, count: int, model: str = "fast", **conditions: object) -> None:
        super().__init__(count, model, **conditions)
        self._wanted_m = np.zeros(count)

    def place(self, which: NDArray[np.intp], yaw_rad: Array, rng: np.random.Generator) -> None:
        size = len(which)
        distance = rng.uniform(*self.start_m, size)
        bearing = yaw_rad + rng.uniform(-START_BEARING_RAD, START_BEARING_RAD, size)
        place = [distance * np.cos(bearing), distance * np.sin(bearing), -rng.uniform(*TARGET_HEIGHT_M, size)]
        self.target[:, which] = np.stack(place)
        self._wanted_m[which] = rng.uniform(*WANTED_M, size)

    def observe(self) -> Array:
        return np.stack([*self.sight(), self._wanted_m])

    def judge(self) -> tuple[Array, NDArray[np.bool_]]:
        error, cost, ended = self.errors()
        return np.maximum(0.0, 1.0 - error / SCALE_M) + np.exp(-2.0 * error) - cost, ended

    def errors(self) -> tuple[Array, Array, NDArray[np.bool_]]:
        """(count,) errors of the distance, costs of bearing, climb, change and end, and ends."""
        forward, right, _ = self.level(self.target - self.model.position)
        distance = np.hypot(forward, right)
        ended = self.lost | (distance < NEAREST_M) | (distance > FARTHEST_M)
        cost = 0.3 * np.abs(np.arctan2(right, forward)) + 0.1 * np.abs(self.model.velocity[2])
        return np.abs(distance - self._wanted_m), cost + 0.05 * self.change + 10.0 * ended, ended

    def measures(self) -> dict[str, Array]:
        line = self.target - self.model.position
        return {"range_error_m": np.hypot(line[0], line[1]) - self._wanted_m}


class Orbit(Approach):
    """Circle an object at a wanted distance and speed, facing it.

    Reward of a step, with s the error of the speed along the circle (m/s) and e, the costs and the end as in
    `Approach`: exp(-e) (1 + exp(-2 s)), less those costs.
    """

    observation = ORBIT_OBSERVATION
    start_m = (4.0, 15.0)

    def __init__(self, count: int, model: str = "fast", **conditions: object) -> None:
        super().__init__(count, model, **conditions)
        self._speed_m_s = np.zeros(count)

    def place(self, which: NDArray[np.intp], yaw_rad: Array, rng: np.random.Generator) -> None:
        super().place(which, yaw_rad, rng)
        size = len(which)
        self._speed_m_s[which] = rng.uniform(0.5, 1.5, size) * rng.choice([-1.0, 1.0], size)

    def observe(self) -> Array:
        return np.concatenate([super().observe(), self._speed_m_s[None]])

    def judge(self) -> tuple[Array, NDArray[np.bool_]]:
        error, cost, ended = self.errors()
        off = np.abs(self.measures()["speed_error_m_s"])
        return np.exp(-error) * (1.0 + np.exp(-2.0 * off)) - cost, ended

    def measures(self) -> dict[str, Array]:
        north, east, _ = self.target - self.model.position
        speed = (east * self.model.velocity[0] - north * self.model.velocity[1]) / np.hypot(north, east)
        return {**super().measures(), "speed_error_m_s": speed - self._speed_m_s}
