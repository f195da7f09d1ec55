"""Environments of Gymnasium for learning to fly; importing this package registers them.

>>> import gymnasium, mavlink_sim.environments
>>> env = gymnasium.make("companion/Approach-v0", model="autopilot", wind_m_s=(0.0, 3.0))
>>> observation, info = env.reset(seed=1)
>>> many = gymnasium.make_vec("companion/Approach-v0", num_envs=256)

`spaces` names what is observed and what acts. It needs the extra `learn`.
"""

from __future__ import annotations

from vision.extras import missing_module

try:
    import gymnasium
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(missing_module(error) or str(error), name=error.name) from None

from mavlink_sim.environments.gym_env import TASKS, TaskEnv, TaskVectorEnv

__all__ = ["TASKS", "TaskEnv", "TaskVectorEnv"]

for _name in TASKS:
    gymnasium.register(
        f"companion/{_name}-v0",
        entry_point="mavlink_sim.environments.gym_env:TaskEnv",
        vector_entry_point="mavlink_sim.environments.gym_env:TaskVectorEnv",
        kwargs={"task": _name},
    )
