"""`companion learn train --policy`: a policy, trained in an environment of `mavlink_sim.environments`.

The algorithms are those of Stable-Baselines3 (extra `learn`). The network sees the observation normalized by
its running mean and deviation, and acts in -1..1; both scalings become part of the written file. The same
seed gives the same weights on one machine.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecEnv, VecMonitor, VecNormalize

from companion.guidance.policy_file import (
    Layer,
    LoadedPolicy,
    PolicyDescription,
    Quantity,
    load_policy,
    write_policy,
)
from companion.learning.training_display import TrainingDisplay
from companion.simulation.campaign import map_seeds
from mavlink_sim.environments import TASKS, TaskVectorEnv
from mavlink_sim.environments.task import STEP_S

ALGORITHMS: dict[str, type[BaseAlgorithm]] = {"ppo": PPO, "sac": SAC}
# Episodes side by side. SAC learns once for each four of its steps.
EPISODES = {"ppo": 128, "sac": 16}
_LAYERS = {"net_arch": [64, 64]}
PARAMETERS: dict[str, dict[str, Any]] = {
    "ppo": {
        "n_steps": 64,
        "batch_size": 1024,
        "n_epochs": 6,
        "learning_rate": 3e-4,
        "policy_kwargs": {**_LAYERS, "log_std_init": -1.0},
    },
    "sac": {"train_freq": 1, "gradient_steps": 4, "buffer_size": 300_000, "policy_kwargs": _LAYERS},
}
CHECKPOINT_STEPS = 100_000
JUDGED_EPISODES = 100
# Seeds of the judged episodes, far from those of trainings.
JUDGED_SEED = 1_000_000
_STATE = "state.pt"
_REPLAY = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
# Largest difference of the written file from the trained network, as a fraction of an action's range.
_TOLERANCE = 1e-4


class PolicyTrainingError(ValueError):
    """The training cannot begin or go on. The message is one line."""


@dataclass(frozen=True, slots=True)
class Training:
    """What is trained. It is stored with the state, and a training is resumed with the same."""

    environment: str
    algorithm: str
    seed: int


def train_policy(
    training: Training, steps: int, output: Path, *, resume: bool = False, progress: str = ""
) -> dict[str, float]:
    """Train, write the policy, and judge the written file.

    The state is kept in the folder `<output>.training`, with TensorBoard's files.

    Args:
        steps: of the environment, in all; rounded up to whole rollouts.
        resume: go on from the state.
        progress: begins every line of the progress, which is then no bar.

    Returns:
        means over `JUDGED_EPISODES` unseen episodes: `return`, `steps`, and the task's measures at the end.

    Raises:
        PolicyTrainingError: unknown environment or algorithm; a state that is missing, of another training,
            or in the way.
    """
    folder = _folder_of(output)
    torch.set_num_threads(1)
    kind = _algorithm(training.algorithm)
    monitored = VecMonitor(ScaledEnv(make_environment(training.environment, EPISODES[training.algorithm])))
    if not resume:
        _check_no_state(folder)
        folder.mkdir(parents=True, exist_ok=True)
    model = kind(
        "MlpPolicy",
        VecNormalize(monitored),
        seed=training.seed,
        device="cpu",
        tensorboard_log=str(folder / "tensorboard"),
        **PARAMETERS[training.algorithm],
    )
    if resume:
        _restore(model, training, folder)
    # The random numbers of a resumed training depend on its seed and its step alone.
    model.set_random_seed(training.seed + model.num_timesteps)
    if model.num_timesteps < steps:
        with TrainingDisplay(progress) as display:
            model.learn(
                steps - model.num_timesteps,
                _Checkpoints(training, steps, folder, display),
                tb_log_name="run",
                reset_num_timesteps=False,
            )
        _store(model, training, folder)
    description = description_of(training.environment)
    layers, draft = layers_of(model, description), folder / f"draft{output.suffix}"
    write_policy(draft, description, layers)
    policy = load_policy(draft)
    _compare(model, policy)
    figures, visited = judge(policy, JUDGED_EPISODES)
    write_policy(draft, description.model_copy(update={"observation": visited}), layers)
    load_policy(draft)
    os.replace(draft, output)
    return figures


def train_policies(
    environment: str,
    algorithm: str,
    seeds: Sequence[int],
    steps: int,
    output: Path,
    *,
    resume: bool = False,
    processes: int = 1,
    ray: str | None = None,
) -> Iterator[tuple[Path, dict[str, float]]]:
    """Train and judge a policy for each seed, as `train_policy` does, several at once; see `map_seeds`.

    On this machine each training keeps its state beside its output, and one whose process dies goes on from
    it. A machine of a cluster keeps none.

    Args:
        resume: go on from the states that there are; seeds without one begin.

    Yields:
        for each seed the file, `<stem of output>-<seed>`, and its figures.

    Raises:
        PolicyTrainingError: as `train_policy`, before the first training; to resume on a cluster.
    """
    _algorithm(algorithm)
    make_environment(environment, 1)
    files = [_of_seed(output, seed) for seed in seeds]
    if not resume:
        for file in files:
            _check_no_state(_folder_of(file))
    elif ray is not None:
        raise PolicyTrainingError("--resume goes on from states on this machine: remove --ray")
    elif not any((_folder_of(file) / _STATE).exists() for file in files):
        raise PolicyTrainingError(f"--resume: no state of a training of these seeds beside {output}")
    if ray is None:
        train = partial(_train_beside, environment, algorithm, steps, output)
        yield from zip(files, map_seeds(train, seeds, processes=processes), strict=True)
        return
    trained = map_seeds(partial(_train_away, environment, algorithm, steps, output.name), seeds, ray=ray)
    for file, (figures, written) in zip(files, trained, strict=True):
        for name, content in written.items():
            path = output.parent / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        yield file, figures


def _train_beside(environment: str, algorithm: str, steps: int, output: Path, seed: int) -> dict[str, float]:
    file = _of_seed(output, seed)
    # There is a state if one is resumed, or the process that wrote it died.
    resume = (_folder_of(file) / _STATE).exists()
    training = Training(environment, algorithm, seed)
    return train_policy(training, steps, file, resume=resume, progress=f"seed {seed}: ")


def _train_away(
    environment: str, algorithm: str, steps: int, name: str, seed: int
) -> tuple[dict[str, float], dict[str, bytes]]:
    """The figures, and the files with their contents: the cluster's machines may share no folder."""
    with TemporaryDirectory() as folder:
        figures = _train_beside(environment, algorithm, steps, Path(folder, name), seed)
        files = [file for file in Path(folder).rglob("*") if file.is_file()]
        return figures, {str(file.relative_to(folder)): file.read_bytes() for file in files}


def _of_seed(output: Path, seed: int) -> Path:
    return output.with_stem(f"{output.stem}-{seed}")


def _folder_of(output: Path) -> Path:
    return output.with_name(f"{output.name}.training")


def _check_no_state(folder: Path) -> None:
    if (folder / _STATE).exists():
        raise PolicyTrainingError(
            f"{folder} holds the state of a training: continue it with --resume, or give another --output"
        )


def _algorithm(name: str) -> type[BaseAlgorithm]:
    if name not in ALGORITHMS:
        raise PolicyTrainingError(f"unknown algorithm {name!r}; there are: {', '.join(ALGORITHMS)}")
    return ALGORITHMS[name]


def make_environment(name: str, count: int) -> TaskVectorEnv:
    """`count` episodes side by side. Raises PolicyTrainingError for an unknown environment."""
    known = [f"companion/{task}-v0" for task in TASKS]
    if name not in known:
        raise PolicyTrainingError(f"unknown environment {name!r}; there are: {', '.join(known)}")
    env = gymnasium.make_vec(name, num_envs=count)
    assert isinstance(env, TaskVectorEnv)
    return env


def description_of(environment: str) -> PolicyDescription:
    """What a policy of this environment observes and commands, with the limits of its spaces."""
    task = make_environment(environment, 1).task
    observation, action = (
        tuple(Quantity(**asdict(entry)) for entry in entries) for entries in (task.observation, task.action)
    )
    return PolicyDescription(
        environment=environment, rate_hz=1.0 / STEP_S, observation=observation, action=action
    )


class ScaledEnv(VecEnv):
    """Episodes side by side as Stable-Baselines3 takes them, with actions scaled to -1..1."""

    def __init__(self, env: TaskVectorEnv) -> None:
        self._env, self._actions = env, np.zeros(0)
        actions = gymnasium.spaces.Box(-1.0, 1.0, (len(env.task.action),), np.float32)
        super().__init__(env.num_envs, env.single_observation_space, actions)

    def reset(self) -> NDArray[np.float32]:
        seed = self._seeds[0]
        observed, _ = self._env.reset(seed=seed)
        self._reset_seeds()
        return observed

    def step_async(self, actions: NDArray[Any]) -> None:
        centre, half = _centre_and_half(self._env.task.action)
        self._actions = centre + half * actions

    def step_wait(self) -> tuple[NDArray[np.float32], NDArray[Any], NDArray[Any], list[dict[str, Any]]]:
        observed, rewards, ended, truncated, infos = self._env.step(self._actions.astype(np.float32))
        over = ended | truncated
        each: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if over.any():
            for index in np.flatnonzero(over):
                each[index] = {
                    "terminal_observation": infos["final_obs"][index],
                    "TimeLimit.truncated": bool(truncated[index]),
                }
        return observed, rewards.astype(np.float32), over, each

    def close(self) -> None:
        self._env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self._env, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        setattr(self._env, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        return [getattr(self._env, method_name)(*args, **kwargs)]

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False] * len(list(self._get_indices(indices)))


def _centre_and_half(entries: Sequence[Any]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    low, high = np.array([each.low for each in entries]), np.array([each.high for each in entries])
    return (low + high) / 2, (high - low) / 2


def layers_of(model: BaseAlgorithm, description: PolicyDescription) -> list[Layer]:
    """The deterministic policy of a trained model, between the units of the description."""
    policy: Any = model.policy
    if isinstance(model, SAC):
        modules = [*policy.actor.latent_pi, policy.actor.mu, torch.nn.Tanh()]
    else:
        modules = [*policy.mlp_extractor.policy_net, policy.action_net]
    normal = model.get_vec_normalize_env()
    assert normal is not None
    assert isinstance(normal.obs_rms, RunningMeanStd)
    deviation = np.sqrt(normal.obs_rms.var + normal.epsilon)
    layers = [Layer(np.diag(1.0 / deviation), -normal.obs_rms.mean / deviation)]
    for module in modules:
        if isinstance(module, torch.nn.Linear):
            weight, bias = (
                values.detach().numpy().astype(np.float64) for values in (module.weight, module.bias)
            )
            layers.append(Layer(weight, bias))
        else:
            activation: Literal["Tanh", "Relu"] = "Tanh" if isinstance(module, torch.nn.Tanh) else "Relu"
            layers[-1] = Layer(layers[-1].weight, layers[-1].bias, activation)
    centre, half = _centre_and_half(description.action)
    return [*layers, Layer(np.diag(half), centre)]


def _compare(model: BaseAlgorithm, policy: LoadedPolicy) -> None:
    """Raises PolicyTrainingError if the written file is not the trained network."""
    normal = model.get_vec_normalize_env()
    assert normal is not None
    assert isinstance(normal.obs_rms, RunningMeanStd)
    rng = np.random.default_rng(0)
    centre, half = _centre_and_half(policy.description.action)
    # Within two deviations: it is trained there, and nothing is clipped.
    spread = 2.0 * np.sqrt(normal.obs_rms.var)
    for part in rng.uniform(-1.0, 1.0, (20, len(spread))):
        observation = (normal.obs_rms.mean + part * spread).astype(np.float32)
        action, _ = model.predict(normal.normalize_obs(observation), deterministic=True)
        written = (np.array(policy.act(observation.tolist())) - centre) / half
        off = float(np.abs(np.clip(written, -1.0, 1.0) - action).max())
        if off > _TOLERANCE:
            raise PolicyTrainingError(f"the written policy differs from the trained one by {off:.2g}")


def judge(
    policy: LoadedPolicy, episodes: int, seed: int = JUDGED_SEED
) -> tuple[dict[str, float], tuple[Quantity, ...]]:
    """Fly unseen episodes of its environment.

    Returns:
        means: `return`, `steps`, and the measures at the end; and the observation with its visited range.
    """
    env = make_environment(policy.description.environment, episodes)
    observed, _ = env.reset(seed=seed)
    running = np.ones(episodes, bool)
    total, steps, measures = np.zeros(episodes), np.zeros(episodes), dict[str, NDArray[np.float64]]()
    least, most = observed.min(0), observed.max(0)
    while running.any():
        least = np.minimum(least, observed[running].min(0))
        most = np.maximum(most, observed[running].max(0))
        actions = np.array([policy.act(observation) for observation in observed], np.float32)
        observed, rewards, ended, truncated, infos = env.step(actions)
        total += rewards * running
        steps += running
        over = running & (ended | truncated)
        for name, values in infos.items():
            if not name.endswith("final_obs"):
                measures.setdefault(name, np.zeros(episodes))[over] = np.abs(np.asarray(values)[over])
        running &= ~over
    figures = {"return": total, "steps": steps, **measures}
    return {key: float(values.mean()) for key, values in figures.items()}, tuple(
        _visited(quantity, float(low), float(high))
        for quantity, low, high in zip(policy.description.observation, least, most, strict=True)
    )


def _visited(quantity: Quantity, low: float, high: float) -> Quantity:
    """The range from low to high, rounded outward to two digits."""
    step = 10.0 ** (math.floor(math.log10(max(abs(low), abs(high), 1e-3))) - 1)
    first, last = math.floor(low / step), math.ceil(high / step)
    update = {"low": round(first * step, 9), "high": round(max(last, first + 1) * step, 9)}
    return quantity.model_copy(update=update)


# --- state -----------------------------------------------------------------------------------------------


def _store(model: BaseAlgorithm, training: Training, folder: Path) -> None:
    """Store the state: one file of tensors and plain values, which appears complete."""
    state: dict[str, Any] = {
        "training": _conditions(training),
        "steps": model.num_timesteps,
        "parameters": model.get_parameters(),
        "arrays": {name: torch.as_tensor(values) for name, values in _arrays(model).items()},
    }
    if isinstance(model, SAC):
        buffer = model.replay_buffer
        assert buffer is not None
        used = buffer.size()
        state["replay"] = {name: torch.as_tensor(getattr(buffer, name)[:used]) for name in _REPLAY}
        state["next"] = buffer.pos
    torch.save(state, folder / f"next.{_STATE}")
    os.replace(folder / f"next.{_STATE}", folder / _STATE)


def _conditions(training: Training) -> dict[str, Any]:
    """All that a training must share with its state."""
    name = training.algorithm
    return {**asdict(training), "episodes": EPISODES[name], "parameters": PARAMETERS[name]}


def _arrays(model: BaseAlgorithm) -> dict[str, NDArray[Any]]:
    """The numbers beside the networks and their optimizers, as views where they are arrays."""
    normal = model.get_vec_normalize_env()
    assert normal is not None
    assert isinstance(normal.obs_rms, RunningMeanStd)
    arrays = {}
    for name, measured in (("observation", normal.obs_rms), ("return", normal.ret_rms)):
        arrays |= {f"{name}.mean": measured.mean, f"{name}.var": measured.var}
        arrays[f"{name}.count"] = np.asarray(measured.count)
    if isinstance(model, SAC):
        assert model.log_ent_coef is not None
        arrays["log_ent_coef"] = model.log_ent_coef.detach().numpy()
    return {name: np.asarray(values) for name, values in arrays.items()}


def _restore(model: BaseAlgorithm, training: Training, folder: Path) -> None:
    """Give a new model the stored state. Nothing in the file can run code: it holds no other objects.

    Raises:
        PolicyTrainingError: no state, a damaged one, or one of another training.
    """
    file = folder / _STATE
    if not file.is_file():
        raise PolicyTrainingError(f"--resume: no state of a training in {folder}: {_STATE} is missing")
    try:
        state = torch.load(file, weights_only=True)
        stored = dict(state["training"])
    except Exception as error:
        raise _damaged(file, error) from error
    for key, value in _conditions(training).items():
        if stored.get(key) != value:
            raise PolicyTrainingError(
                f"--resume: {folder} is a training with {key} {stored.get(key)}, not {value}"
            )
    try:
        _apply(model, state)
    except Exception as error:
        raise _damaged(file, error) from error


def _damaged(file: Path, error: Exception) -> PolicyTrainingError:
    why = (str(error).splitlines() or [""])[0][:120]
    return PolicyTrainingError(
        f"--resume: {file} is no state of a training ({type(error).__name__}: {why}): "
        "train again with another --output"
    )


def _apply(model: BaseAlgorithm, state: dict[str, Any]) -> None:
    """Raises any error if the state does not fit the model."""
    if state["parameters"].keys() != model.get_parameters().keys():
        raise ValueError(f"parameters of {', '.join(state['parameters'])}")
    model.set_parameters(state["parameters"])
    arrays = {}
    for name, current in _arrays(model).items():
        arrays[name] = state["arrays"][name].numpy()
        if arrays[name].shape != current.shape or not np.isfinite(arrays[name]).all():
            raise ValueError(f"{name} of shape {list(arrays[name].shape)}")
    normal = model.get_vec_normalize_env()
    assert normal is not None
    assert isinstance(normal.obs_rms, RunningMeanStd)
    for name, measured in (("observation", normal.obs_rms), ("return", normal.ret_rms)):
        measured.mean, measured.var = arrays[f"{name}.mean"], arrays[f"{name}.var"]
        measured.count = float(arrays[f"{name}.count"])
    if isinstance(model, SAC):
        assert model.log_ent_coef is not None
        model.log_ent_coef.data.copy_(state["arrays"]["log_ent_coef"])
        buffer = model.replay_buffer
        assert buffer is not None
        used = len(state["replay"]["rewards"])
        for name in _REPLAY:
            getattr(buffer, name)[:used] = state["replay"][name].reshape(
                (used, *getattr(buffer, name).shape[1:])
            )
        buffer.full, buffer.pos = used == buffer.buffer_size, range(buffer.buffer_size)[state["next"]]
    model.num_timesteps = range(10**12)[state["steps"]]


class _Checkpoints(BaseCallback):
    """Shows the progress and stores the state every `CHECKPOINT_STEPS`."""

    def __init__(self, training: Training, steps: int, folder: Path, display: TrainingDisplay) -> None:
        super().__init__()
        self._training, self._steps, self._folder, self._display = training, steps, folder, display
        self._stored = self._begun = 0
        self._begun_s = 0.0

    def _on_training_start(self) -> None:
        self._stored = self._begun = self.num_timesteps
        self._begun_s = time.monotonic()

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        if self.num_timesteps - self._stored >= CHECKPOINT_STEPS:
            self._stored = self.num_timesteps
            _store(self.model, self._training, self._folder)
        self._show()

    def _on_training_end(self) -> None:
        self._show()

    def _show(self) -> None:
        episodes: Sequence[dict[str, float]] = tuple(self.model.ep_info_buffer or ())
        mean = float(np.mean([each["r"] for each in episodes])) if episodes else float("nan")
        rate = (self.num_timesteps - self._begun) / max(time.monotonic() - self._begun_s, 1e-9)
        # The last rollout may end after the last step that was asked for.
        remaining_s = max(0, self._steps - self.num_timesteps) / rate if rate else None
        figures = f"return {mean:.1f} {rate:.0f} steps/s"
        self._display.show(self.num_timesteps, self._steps, figures, remaining_s)
