"""The interface of a task: a number of episodes side by side, as arrays."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray

from mavlink_sim.environments.spaces import Array, Entry

STEP_S = 0.05
"""Time between two actions of every task: 20 Hz."""


class Task(ABC):
    """`count` independent episodes of one task; the last axis of its arrays is the episode.

    Attributes:
        observation, action: their entries.
        max_steps: an episode is truncated after this many steps.
    """

    observation: tuple[Entry, ...]
    action: tuple[Entry, ...]
    max_steps: int

    def __init__(self, count: int) -> None:
        self.count = count

    @abstractmethod
    def begin(self, which: NDArray[np.intp], rng: np.random.Generator) -> None:
        """Begin new episodes at these indices."""

    @abstractmethod
    def step(self, action: Array, rng: np.random.Generator) -> tuple[Array, NDArray[np.bool_]]:
        """Act for STEP_S. `action`: (entries, count), within its range.

        Returns: (count,) rewards, and whether each episode has ended.
        """

    @abstractmethod
    def observe(self) -> Array:
        """(entries, count) observations, not clipped."""

    @abstractmethod
    def measures(self) -> dict[str, Array]:
        """Of each episode, the true errors by name and unit: for the judgement, not for the policy."""

    @abstractmethod
    def draw(self) -> NDArray[np.uint8]:
        """(height, width, 3) RGB image of the first episode."""
