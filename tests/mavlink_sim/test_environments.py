"""The environments: Gymnasium's own check, the contract of names, and what an episode does."""

from __future__ import annotations

import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from benchmarks.environments import model_errors
from mavlink_sim.environments import TASKS, TaskEnv, TaskVectorEnv
from mavlink_sim.environments.approach import Approach
from mavlink_sim.environments.autopilot_model import hovering
from mavlink_sim.environments.spaces import APPROACH_OBSERVATION, MAX_AGE_S, VELOCITY_ACTION
from mavlink_sim.environments.task import STEP_S

MODELS = [(name, model) for name in TASKS if name != "CartPole" for model in ("fast", "autopilot")]


def make(name: str, **options: Any) -> TaskEnv:
    env = gymnasium.make(f"companion/{name}-v0", **options).unwrapped
    assert isinstance(env, TaskEnv)
    return env


def make_many(name: str, count: int, **options: Any) -> TaskVectorEnv:
    env = gymnasium.make_vec(f"companion/{name}-v0", num_envs=count, **options).unwrapped
    assert isinstance(env, TaskVectorEnv)
    return env


def ahead(observed: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """A proportional approach: turn to the target, fly along its bearing."""
    forward, right, *_, wanted = observed.T
    bearing = np.arctan2(right, forward)
    speed = np.clip(0.5 * (np.hypot(forward, right) - wanted), -1.0, 2.0) * np.cos(bearing) ** 2
    level = [speed * np.cos(bearing), speed * np.sin(bearing), np.zeros_like(speed)]
    return np.stack([*level, np.clip(1.5 * bearing, -1.0, 1.0)], axis=1)


@pytest.mark.parametrize(("name", "model"), [("CartPole", None), *MODELS])
def test_environment_passes_the_check_of_gymnasium(name: str, model: str | None) -> None:
    options = {} if model is None else {"model": model}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*symmetric and normalized.*")  # the units are physical
        check_env(make(name, render_mode="rgb_array", **options))


def test_names_of_the_approach_are_a_contract() -> None:
    assert [entry.name for entry in APPROACH_OBSERVATION] == [
        *("target_forward_m", "target_right_m", "target_up_m"),
        *("velocity_forward_m_s", "velocity_right_m_s", "velocity_up_m_s"),
        *("target_age_s", "distance_wanted_m"),
    ]
    assert [entry.name for entry in VELOCITY_ACTION] == ["forward_m_s", "right_m_s", "up_m_s", "turn_rad_s"]
    assert make("Approach").observation_space.shape == (8,)


@pytest.mark.parametrize(("name", "model"), MODELS)
def test_same_seed_gives_the_same_episode(name: str, model: str) -> None:
    def fly(seed: int) -> list[list[float]]:
        env = make(name, model=model)
        observed = [env.reset(seed=seed)[0]]
        observed += [env.step(np.full(4, -0.3, np.float32))[0] for _ in range(20)]
        return [one.tolist() for one in observed]

    assert fly(1) == fly(1)
    assert fly(1)[-1] != fly(2)[-1]


def test_fast_model_follows_the_autopilot_within_5_cm_in_5_s() -> None:
    assert model_errors(5.0, 1.2, noise=False, flights=4)[-1] < 0.05


@pytest.mark.parametrize(("model", "count", "least"), [("fast", 32, 29), ("autopilot", 2, 2)])
def test_proportional_approach_holds_the_distance(model: str, count: int, least: int) -> None:
    env = make_many("Approach", count, model=model)
    observed, _ = env.reset(seed=5)
    for _ in range(400):
        observed, _, _, _, infos = env.step(ahead(observed))
    assert (np.abs(infos["range_error_m"]) < 1.5).sum() >= least


def test_target_that_is_never_detected_ends_the_episode() -> None:
    env = make("Approach", misses=(1.0, 1.0), latency_s=(0.1, 0.1))
    observed, _ = env.reset(seed=1)
    assert observed[6] == pytest.approx(0.1)
    steps, ended, reward = 0, False, 0.0
    while not ended:
        observed, reward, ended, _, _ = env.step(np.zeros(4, np.float32))
        steps += 1
    assert observed[6] == pytest.approx(MAX_AGE_S)
    assert steps == pytest.approx((MAX_AGE_S - 0.1) / STEP_S, abs=2)
    assert reward < -5.0


def test_position_is_measured_late_and_kept_over_missed_frames() -> None:
    env = make("Approach", misses=(0.0, 0.0), latency_s=(0.2, 0.2), noise=(0.0, 0.0), wind_m_s=(0.0, 0.0))
    env.reset(seed=1)
    for _ in range(20):
        observed, *_ = env.step(np.zeros(4, np.float32))
    assert isinstance(env.task, Approach)
    assert observed[6] == pytest.approx(0.2)
    off = env.task.seen[:, 0] - env.task.target[:, 0]
    assert 0.0 < np.abs(off).max() < 1.0  # the bearing's noise alone


def test_ended_episode_is_replaced_in_the_same_step() -> None:
    env = make_many("Approach", 16, misses=(1.0, 1.0))
    env.reset(seed=1)
    for _ in range(150):
        observed, _, ended, _, infos = env.step(np.zeros((16, 4), np.float32))
        if ended.any():
            break
    assert infos["_final_obs"].tolist() == ended.tolist()
    assert (infos["final_obs"][ended][:, 6] >= MAX_AGE_S - STEP_S).all()
    assert (observed[ended][:, 6] < 0.3).all()


def test_pole_falls_alone_and_is_held_by_feedback() -> None:
    gain = np.array([1.0, 2.0, 40.0, 8.0])
    for force, expected in ((0.0, False), (1.0, True)):
        env = make("CartPole")
        observed, _ = env.reset(seed=3)
        ended = truncated = False
        while not (ended or truncated):
            observed, reward, ended, truncated, _ = env.step(np.array([force * gain @ observed]))
            assert reward == 1.0
        assert truncated is expected


def test_copies_with_a_seed_fly_in_other_gusts() -> None:
    def end(seed: int | None) -> tuple[float, ...]:
        vehicle = hovering().copy(seed)
        vehicle.vehicle.airframe.gusts_mps = 1.0
        vehicle.set_velocity(0.0, 0.0, 0.0)
        vehicle.step(1.0)
        return vehicle.truth.position_ned_m

    assert end(1) == end(1)
    assert end(None) == end(None)
    assert len({end(None), end(1), end(2)}) == 3


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"model": "slow"}, "fast, autopilot"),
        ({"wind_m_s": (3.0, 1.0)}, "wind_m_s"),
        ({"mass": (0.0, 1.0)}, "0.5 to 1.5"),
        ({"misses": 0.5}, "misses"),
    ],
)
def test_bad_conditions_are_named(options: dict[str, Any], named: str) -> None:
    with pytest.raises(ValueError, match=named):
        make("Approach", **options)


def test_action_of_another_shape_or_nan_is_named() -> None:
    env = make("Approach")
    env.reset(seed=1)
    for action in (np.zeros(3, np.float32), np.full(4, np.nan, np.float32)):
        with pytest.raises(ValueError, match="action: expected"):
            env.step(action)
