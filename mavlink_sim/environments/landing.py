"""Land on a marker, by sight."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mavlink_sim.environments.flight_task import FlightTask
from mavlink_sim.environments.spaces import LANDING_OBSERVATION, Array

START_SLOPE = 0.5  # horizontal distance at the start, at most, per metre of height
TOUCH_M = 0.15
FARTHEST_M = 10.0
GENTLE_M_S = 0.7


class Landing(FlightTask):
    """Descend onto a marker on the ground, seen by a camera that looks down; its image ends with the episode.

    Reward of a step, with the true horizontal distance e and the height h (m): -0.02 e - 0.01 h - 0.05 times
    the squared change of the action. At 0.15 m the episode ends: 10 - 20 min(e, 1) - 10 for each m/s of
    descent beyond 0.7. It also ends, with -20, when the marker is lost for 5 s or farther than 10 m.
    Truncated after 30 s.
    """

    observation = LANDING_OBSERVATION
    height_m = (4.0, 10.0)
    lowest_m = -1.0
    camera_pitch_rad = math.radians(-90.0)

    def place(self, which: NDArray[np.intp], yaw_rad: Array, rng: np.random.Generator) -> None:
        place = self.model.position[:, which]
        distance = -place[2] * START_SLOPE * np.sqrt(rng.random(len(which)))
        bearing = rng.uniform(-math.pi, math.pi, len(which))
        self.target[:2, which] = place[:2] + distance * np.stack([np.cos(bearing), np.sin(bearing)])
        self.target[2, which] = 0.0

    def observe(self) -> Array:
        return np.stack(self.sight())

    def judge(self) -> tuple[Array, NDArray[np.bool_]]:
        error, height, sink = self._distance(), -self.model.position[2], self.model.velocity[2]
        touched = height < TOUCH_M
        failed = ~touched & (self.lost | (error > FARTHEST_M))
        landing = 10.0 - 20.0 * np.minimum(error, 1.0) - 10.0 * np.maximum(0.0, sink - GENTLE_M_S)
        reward = touched * landing - 20.0 * failed - 0.02 * error - 0.01 * height - 0.05 * self.change
        return reward, touched | failed

    def _distance(self) -> Array:
        north, east, _ = self.target - self.model.position
        return np.asarray(np.hypot(north, east))

    def measures(self) -> dict[str, Array]:
        return {
            "marker_distance_m": self._distance(),
            "height_m": -self.model.position[2],
            "descent_m_s": self.model.velocity[2].copy(),
        }
