"""The environments: Gymnasium's own check, the contract of names, and what an episode does."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

pytest.importorskip("gymnasium", reason="gymnasium is of the optional extra learn")

import gymnasium
from gymnasium.utils.env_checker import check_env

from benchmarks.environments import model_errors
from mavlink_sim.environments import TASKS, TaskEnv, TaskVectorEnv
from mavlink_sim.environments.approach import Approach
from mavlink_sim.environments.autopilot_model import hovering
from mavlink_sim.environments.obstacles import Obstacles
from mavlink_sim.environments.spaces import (
    APPROACH_OBSERVATION,
    MAX_AGE_S,
    MAX_RANGE_M,
    SECTORS_DEG,
    VELOCITY_ACTION,
    high,
)
from mavlink_sim.environments.task import STEP_S
from mavlink_sim.physics.airframe import GRAVITY_MPS2, MAX_THRUST_MPS2

MODELS = [(name, model) for name in TASKS if name != "CartPole" for model in ("fast", "autopilot")]
MODELS.remove(("Rotors", "autopilot"))
Numbers = np.ndarray[Any, Any]


def make(name: str, **options: Any) -> TaskEnv:
    env = gymnasium.make(f"companion/{name}-v0", **options).unwrapped
    assert isinstance(env, TaskEnv)
    return env


def make_many(name: str, count: int, **options: Any) -> TaskVectorEnv:
    env = gymnasium.make_vec(f"companion/{name}-v0", num_envs=count, **options).unwrapped
    assert isinstance(env, TaskVectorEnv)
    return env


def ahead(observed: Numbers) -> Numbers:
    """A proportional approach: turn to the target, fly along its bearing."""
    forward, right, *_, wanted = observed.T
    bearing = np.arctan2(right, forward)
    speed = np.clip(0.5 * (np.hypot(forward, right) - wanted), -1.0, 2.0) * np.cos(bearing) ** 2
    level = [speed * np.cos(bearing), speed * np.sin(bearing), np.zeros_like(speed)]
    return np.stack([*level, np.clip(1.5 * bearing, -1.0, 1.0)], axis=1)


def circle(observed: Numbers) -> Numbers:
    """An orbit facing the object."""
    forward, right, *_, wanted, speed = observed.T
    bearing, distance = np.arctan2(right, forward), np.hypot(forward, right)
    inward = np.clip(0.7 * (distance - wanted), -1.0, 1.0)
    return np.stack([inward, -speed, 0.0 * speed, speed / distance + 1.5 * bearing], axis=1)


def descend(observed: Numbers) -> Numbers:
    """A descent within a cone above the marker; a climb while it is out of sight."""
    forward, right, up, *_, age = observed.T
    off = np.hypot(forward, right)
    down = np.where(off < 0.2 - 0.15 * up, np.clip(-0.4 * up, 0.4, 1.0), 0.0)
    down = np.where(up > -0.4, 0.4, np.where(age > 0.5, -0.5, down))
    return np.stack([1.2 * forward, 1.2 * right, -down, 0.0 * off], axis=1)


def around(observed: Numbers) -> Numbers:
    """The free sector that is nearest to the target's, and a push away from what is near."""
    (forward, right, up), ranges, angles = observed.T[:3], observed[:, 6:18], np.radians(SECTORS_DEG)
    off = np.abs((angles - np.arctan2(right, forward)[:, None] + np.pi) % (2.0 * np.pi) - np.pi)
    near = np.minimum(ranges, np.minimum(np.roll(ranges, 1, 1), np.roll(ranges, -1, 1)))
    best = angles[np.argmax(np.minimum(near, 3.0) - off, 1)]
    push = 2.0 * np.maximum(1.5 - ranges, 0.0)
    speed = np.minimum(1.0, 0.8 * np.hypot(forward, right))
    level = [speed * axis(best) - (push * axis(angles)).sum(1) for axis in (np.cos, np.sin)]
    return np.stack([*level, 0.8 * up, 0.0 * up], axis=1)


def balance(observed: Numbers) -> Numbers:
    """Proportional loops of position, velocity, tilt and body rates."""
    target, velocity, down, rates = (observed[:, first : first + 3].T for first in (0, 3, 6, 9))
    ask = np.clip(3.0 * (target - velocity), -4.0, 4.0)
    roll = 0.06 * (4.0 * (ask[1] / GRAVITY_MPS2 - down[1]) - rates[0])
    pitch = 0.06 * (-4.0 * (ask[0] / GRAVITY_MPS2 - down[0]) - rates[1])
    base, yaw = (GRAVITY_MPS2 + ask[2]) / MAX_THRUST_MPS2 / down[2], -0.1 * rates[2]
    one, other = roll - pitch, roll + pitch
    return np.stack([base - one + yaw, base + one + yaw, base + other - yaw, base - other - yaw], axis=1)


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
        observed += [env.step(np.full(4, 0.3, np.float32))[0] for _ in range(20)]
        return [one.tolist() for one in observed]

    assert fly(1) == fly(1)
    assert fly(1)[-1] != fly(2)[-1]


def test_fast_model_follows_the_autopilot_within_5_cm_in_5_s() -> None:
    assert model_errors(5.0, 1.2, noise=False, flights=4)[-1] < 0.05


PILOTS: dict[str, tuple[Callable[[Numbers], Numbers], dict[str, float], float]] = {
    "Approach": (ahead, {"range_error_m": 1.5}, 0.9),
    "Orbit": (circle, {"range_error_m": 1.5, "speed_error_m_s": 0.8}, 0.9),
    "Landing": (descend, {"marker_distance_m": 1.0, "height_m": 0.15, "descent_m_s": 0.8}, 0.9),
    "Obstacles": (around, {"target_distance_m": 1.0}, 0.6),
    "Rotors": (balance, {"distance_m": 1.0}, 0.9),
}
"""By task: a controller, limits of the true errors at the end, and the share of episodes within them."""


# Of the tasks, Approach flies the autopilot's model in `make test`; the seed is tested with all of them.
@pytest.mark.parametrize(
    ("name", "model"),
    [
        case if case[1] == "fast" or case[0] == "Approach" else pytest.param(*case, marks=pytest.mark.slow)
        for case in MODELS
    ],
)
def test_hand_written_controller_solves_the_task(name: str, model: str) -> None:
    pilot, limits, share = PILOTS[name]
    count = 32 if model == "fast" else 2
    env = make_many(name, count, model=model)
    observed, _ = env.reset(seed=5)
    solved, over = np.zeros(count, bool), np.zeros(count, bool)
    for _ in range(env.task.max_steps):
        observed, _, ended, truncated, infos = env.step(pilot(observed))
        now = (ended | truncated) & ~over
        solved |= now & np.all([np.abs(infos[key]) <= limit for key, limit in limits.items()], axis=0)
        over |= now
        if over.all():
            break
    assert over.all()
    assert solved.mean() >= (share if model == "fast" else 0.5)


def test_trunk_ends_the_episode_and_is_in_its_sector() -> None:
    env = make("Obstacles", wind_m_s=(0.0, 0.0), noise=(0.0, 0.0), misses=(0.0, 0.0), latency_s=(0.0, 0.0))
    env.reset(seed=1)
    task = env.task
    assert isinstance(task, Obstacles)
    task._trunks[:, :, 0] = 100.0
    yaw = float(task.model.yaw_rad[0])
    task._trunks[:, 0, 0] = -3.0 * np.sin(yaw), 3.0 * np.cos(yaw)  # 3 m to the right
    observed, *_ = env.step(np.zeros(4, np.float32))
    assert observed[6 + SECTORS_DEG.index(90)] == pytest.approx(3.0 - task._radius_m[0, 0], abs=0.05)
    assert observed[6] == MAX_RANGE_M
    ended, steps, reward = False, 0, 0.0
    while not ended:
        observed, reward, ended, _, info = env.step(np.array([0.0, 1.0, 0.0, 0.0], np.float32))
        steps += 1
    assert reward < -9.0
    assert 0.2 < info["clearance_m"] < 0.35
    assert 30 < steps < 100


@pytest.mark.parametrize("name", TASKS)
def test_image_changes_with_the_flight(name: str) -> None:
    env = make(name, render_mode="rgb_array")
    env.reset(seed=1)
    before = env.render()
    for _ in range(10):
        env.step(high(env.task.action).astype(np.float32))
    assert before.shape == (320, 320 if name == "CartPole" else 640, 3)
    assert before.dtype == np.uint8
    assert (env.render() != before).any()


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
        ({"rain": (0.0, 1.0)}, "rain"),
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


def test_rotor_task_is_refused_on_the_autopilot() -> None:
    with pytest.raises(ValueError, match="only 'fast'"):
        make("Rotors", model="autopilot")
