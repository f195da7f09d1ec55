"""The tasks as Gymnasium environments: one episode (`TaskEnv`) or many side by side (`TaskVectorEnv`)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from mavlink_sim.environments.approach import Approach, Orbit
from mavlink_sim.environments.cart_pole import CartPole
from mavlink_sim.environments.landing import Landing
from mavlink_sim.environments.obstacles import Obstacles
from mavlink_sim.environments.rotors import Rotors
from mavlink_sim.environments.spaces import Array, Entry, high, low
from mavlink_sim.environments.task import STEP_S, Task

TASKS: dict[str, Callable[..., Task]] = {
    task.__name__: task for task in (CartPole, Approach, Orbit, Landing, Obstacles, Rotors)
}
"""By the name in `companion/NAME-v0`."""

Numbers = NDArray[np.float32]


def _box(entries: tuple[Entry, ...]) -> gymnasium.spaces.Box[np.float32]:
    least, most = low(entries).astype(np.float32), high(entries).astype(np.float32)
    return gymnasium.spaces.Box(least, most, dtype=np.float32)


def _observed(task: Task, space: gymnasium.spaces.Box[np.float32]) -> Numbers:
    """(count, entries), within the space."""
    return np.clip(task.observe().T.astype(np.float32), space.low, space.high)


def _acted(task: Task, actions: Any, space: gymnasium.spaces.Box[np.float32]) -> Array:
    """(entries, count), clipped to the space.

    Raises:
        ValueError: another shape, or a number that is not finite.
    """
    array = np.asarray(actions, np.float64)
    expected = (task.count, len(task.action))
    if array.shape not in (expected, expected[1:] if task.count == 1 else expected):
        raise ValueError(f"action: expected shape {expected}, got {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError("action: expected finite numbers, got NaN or infinity")
    return np.clip(array.reshape(expected), space.low, space.high).T


class TaskEnv(gymnasium.Env[Numbers, Numbers]):
    """One episode of a task. `unwrapped.task` has its entries: names, units and ranges.

    Args:
        task: a name of TASKS.
        render_mode: None or "rgb_array".
        options: the task's.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": round(1.0 / STEP_S)}  # noqa: RUF012

    def __init__(self, task: str, render_mode: str | None = None, **options: Any) -> None:
        self.task = TASKS[task](1, **options)
        self._observations, self._actions = _box(self.task.observation), _box(self.task.action)
        self.observation_space, self.action_space = self._observations, self._actions
        self.render_mode = render_mode
        self._steps = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Numbers, dict[str, Any]]:
        super().reset(seed=seed)
        self._steps = 0
        self.task.begin(np.arange(1), self.np_random)
        return self._observe(), self._measures()

    def step(self, action: Numbers) -> tuple[Numbers, float, bool, bool, dict[str, Any]]:
        reward, ended = self.task.step(_acted(self.task, action, self._actions), self.np_random)
        self._steps += 1
        truncated = self._steps >= self.task.max_steps
        return self._observe(), float(reward[0]), bool(ended[0]), truncated, self._measures()

    def render(self) -> Any:
        """(height, width, 3) RGB: the episode from above and from the side."""
        return self.task.draw() if self.render_mode == "rgb_array" else None

    def _observe(self) -> Numbers:
        only: Numbers = _observed(self.task, self._observations)[0]
        return only

    def _measures(self) -> dict[str, Any]:
        return {name: float(values[0]) for name, values in self.task.measures().items()}


class TaskVectorEnv(VectorEnv[Numbers, Numbers, NDArray[Any]]):
    """`num_envs` episodes of a task; one that ends is replaced by a new one in the same step.

    `infos["final_obs"]` are then the last observations and `infos["_final_obs"]` marks whose they are.

    Args:
        num_envs, task, options: as `TaskEnv`'s.
    """

    metadata = {**TaskEnv.metadata, "autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(self, num_envs: int, task: str, render_mode: str | None = None, **options: Any) -> None:
        self.num_envs = num_envs
        self.task = TASKS[task](num_envs, **options)
        self.render_mode = render_mode
        self._observations, self._actions = _box(self.task.observation), _box(self.task.action)
        self.single_observation_space, self.single_action_space = self._observations, self._actions
        self.observation_space = batch_space(self._observations, num_envs)
        self.action_space = batch_space(self._actions, num_envs)
        self._steps = np.zeros(num_envs, np.intp)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Numbers, dict[str, Any]]:
        if seed is not None:
            self.np_random = np.random.default_rng(seed)  # type: ignore[arg-type]
        self._steps[:] = 0
        self.task.begin(np.arange(self.num_envs), self.np_random)
        return _observed(self.task, self._observations), dict(self.task.measures())

    def step(
        self, actions: Numbers
    ) -> tuple[Numbers, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        reward, ended = self.task.step(_acted(self.task, actions, self._actions), self.np_random)
        self._steps += 1
        truncated = (self._steps >= self.task.max_steps) & ~ended
        observed = _observed(self.task, self._observations)
        infos: dict[str, Any] = dict(self.task.measures())
        over = ended | truncated
        if over.any():
            infos |= {"final_obs": observed, "_final_obs": over}
            which = np.flatnonzero(over)
            self._steps[which] = 0
            self.task.begin(which, self.np_random)
            observed = _observed(self.task, self._observations)
        return observed, reward, ended, truncated, infos

    def render(self) -> Any:
        """As `TaskEnv.render`, of the first episode."""
        return (self.task.draw(),) if self.render_mode == "rgb_array" else None
