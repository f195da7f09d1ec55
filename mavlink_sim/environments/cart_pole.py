"""The cart with a pole of Barto, Sutton, Anderson, "Neuronlike Adaptive Elements That Can Solve Difficult
Learning Control Problems", IEEE Transactions on Systems, Man, and Cybernetics 13 (1983), without friction.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mavlink_sim.environments import drawing
from mavlink_sim.environments.spaces import CART_POLE_ACTION, CART_POLE_OBSERVATION, Array
from mavlink_sim.environments.task import STEP_S, Task

# The paper's numbers; its step is 0.02 s with one Euler step, here five of 0.01 s for each action.
GRAVITY_MPS2 = 9.8
CART_KG = 1.0
POLE_KG = 0.1
HALF_POLE_M = 0.5
TRACK_M = 2.4
MAX_ANGLE_RAD = math.radians(12.0)
SUBSTEPS = 5
START = 0.05  # each entry of the state begins within ± this


class CartPole(Task):
    """Keep a pole on a cart upright by a horizontal force.

    Reward: 1 for each step. End: the pole is more than 12 degrees from upright, or the cart has left the
    track (± 2.4 m). Truncated after 25 s.
    """

    observation = CART_POLE_OBSERVATION
    action = CART_POLE_ACTION
    max_steps = 500

    def __init__(self, count: int) -> None:
        super().__init__(count)
        self._state = np.zeros((4, count))

    def begin(self, which: NDArray[np.intp], rng: np.random.Generator) -> None:
        self._state[:, which] = rng.uniform(-START, START, (4, len(which)))

    def step(self, action: Array, rng: np.random.Generator) -> tuple[Array, NDArray[np.bool_]]:
        x, speed, angle, rate = self._state
        total_kg = CART_KG + POLE_KG
        dt = STEP_S / SUBSTEPS
        for _ in range(SUBSTEPS):
            cosine, sine = np.cos(angle), np.sin(angle)
            push = (action[0] + POLE_KG * HALF_POLE_M * rate**2 * sine) / total_kg
            turn = (GRAVITY_MPS2 * sine - cosine * push) / (
                HALF_POLE_M * (4.0 / 3.0 - POLE_KG * cosine**2 / total_kg)
            )
            acceleration = push - POLE_KG * HALF_POLE_M * turn * cosine / total_kg
            speed = speed + acceleration * dt
            rate = rate + turn * dt
            x, angle = x + speed * dt, angle + rate * dt
        self._state = np.stack([x, speed, angle, rate])
        ended = (np.abs(x) > TRACK_M) | (np.abs(angle) > MAX_ANGLE_RAD)
        return np.ones(self.count), ended

    def observe(self) -> Array:
        return self._state.copy()

    def measures(self) -> dict[str, Array]:
        return {"angle_error_rad": np.abs(self._state[2])}

    def draw(self) -> NDArray[np.uint8]:
        x, _, angle, _ = (float(value) for value in self._state[:, 0])
        top = (0.0, x + 2 * HALF_POLE_M * math.sin(angle), -2 * HALF_POLE_M * math.cos(angle))
        canvas = drawing.Canvas(2.2 * TRACK_M, (0.0, 0.0, -0.6), (drawing.SIDE,))
        canvas.line((0.0, -TRACK_M, 0.0), (0.0, TRACK_M, 0.0), drawing.GREY)
        canvas.line((0.0, x - 0.2, 0.0), (0.0, x + 0.2, 0.0), drawing.VEHICLE, thickness=14)
        canvas.line((0.0, x, 0.0), top, drawing.TARGET, thickness=5)
        return canvas.image
