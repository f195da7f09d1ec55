"""Command the rotors themselves: hold a place without any controller between."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from mavlink_sim.environments import drawing
from mavlink_sim.environments.fast_model import FastModel
from mavlink_sim.environments.flight_task import FlightTask, Range
from mavlink_sim.environments.spaces import ROTORS_ACTION, ROTORS_OBSERVATION, Array, high

START_M = 2.0
FARTHEST_M = 10.0
_FULL = high(ROTORS_OBSERVATION)[:-1, None]


class Rotors(FlightTask):
    """Fly to a place within 2 m on each axis and hold there, by the commands of the four rotors.

    Latency, noise (of each entry, as a fraction of its range) and misses are those of the observed state;
    wind and mass are not observed.
    Only on the fast model: PX4 takes no rotor commands in OFFBOARD.

    Reward of a step, with the true distance e (m): 1 - e / 10 + exp(-2 e) - 0.05 |body rates, rad/s| - 0.05
    times the squared change of the action, and -10 at an early end. End: tilted beyond 90 degrees, farther
    than 10 m, or below 0.5 m. Truncated after 15 s.
    """

    observation = ROTORS_OBSERVATION
    action = ROTORS_ACTION
    max_steps = 300
    rows = len(ROTORS_OBSERVATION) - 1
    defaults: ClassVar[dict[str, Range]] = {
        "wind_m_s": (0.0, 1.0),
        "mass": (0.95, 1.05),
        "latency_s": (0.0, 0.0),
        "noise": (0.0, 0.005),
        "misses": (0.0, 0.0),
    }
    height_m = (5.0, 10.0)

    def __init__(self, count: int, model: str = "fast", **conditions: object) -> None:
        if model != "fast":
            raise ValueError(f"model {model!r}: the rotor task has only 'fast'")
        super().__init__(count, model, **conditions)
        self.model = self._fast = FastModel(count)

    def place(self, which: NDArray[np.intp], yaw_rad: Array, rng: np.random.Generator) -> None:
        offset = rng.uniform(-START_M, START_M, (3, len(which)))
        self.target[:, which] = self.model.position[:, which] + offset

    def fly(self, action: Array, rng: np.random.Generator) -> None:
        self._fast.fly_rotors(action, rng)

    def measure(self, rng: np.random.Generator) -> Array:
        """(rows, count) the whole state."""
        model = self._fast
        place, speed = self.level(self.target - model.position), self.level(model.velocity)
        state = np.concatenate([place, speed, model.rotation[2], model.rates, model.thrusts])
        return np.asarray(state + self.noise * _FULL * rng.standard_normal(state.shape))

    def visible(self) -> NDArray[np.bool_]:
        return np.ones(self.count, bool)

    def observe(self) -> Array:
        return np.concatenate([self.seen, self.age_s[None]])

    def judge(self) -> tuple[Array, NDArray[np.bool_]]:
        distance = self.distance_m
        ended = self.lost | (self.model.rotation[2, 2] < 0.0) | (distance > FARTHEST_M)
        reward = 1.0 - distance / FARTHEST_M + np.exp(-2.0 * distance)
        reward -= 0.05 * np.linalg.norm(self._fast.rates, axis=0) + 0.05 * self.change
        return reward - 10.0 * ended, ended

    def measures(self) -> dict[str, Array]:
        return {"distance_m": self.distance_m}

    def sketch(self, canvas: drawing.Canvas) -> None:
        canvas.circle(self.target[:, 0], 0.4, drawing.TARGET, -1)
