"""The environments: error of the fast model against the whole autopilot, and steps per second.

`python -m benchmarks.environments` prints the rows of the environments in `docs/measurements.md`.
"""

from __future__ import annotations

import time
from functools import partial

import gymnasium
import numpy as np

from companion.simulation.campaign import map_seeds
from mavlink_sim.environments import TASKS
from mavlink_sim.environments.autopilot_model import AutopilotModel
from mavlink_sim.environments.fast_model import FastModel
from mavlink_sim.environments.spaces import VELOCITY_ACTION, high, low
from mavlink_sim.environments.task import STEP_S

FLIGHTS = 32
SECONDS = 5.0
NEW_SETPOINT_S = 1.0
WORKERS = 2
TIMED_S = 10.0
CASES = ((0, 1.0, False), (5, 1.0, False), (0, 1.2, False), (5, 1.2, False), (0, 1.0, True))


def model_errors(wind_m_s: float, mass: float, *, noise: bool, flights: int = FLIGHTS) -> list[float]:
    """Distance in metres between both models 5 s after the same start, sorted, one for each flight.

    Each flight has a new random velocity and turn of the whole range every second. Gusts are off: they are
    random in both models.
    """
    rng = np.random.default_rng(5)
    whole, fast = AutopilotModel(flights, noise=noise), FastModel(flights)
    for model in (whole, fast):
        model.wind[0], model.mass[:] = wind_m_s, mass
        start = np.tile([[0.0], [0.0], [-20.0]], flights)
        model.begin(np.arange(flights), start, np.zeros(flights), np.random.default_rng(1))
    for step in range(round(SECONDS / STEP_S)):
        if step % round(NEW_SETPOINT_S / STEP_S) == 0:
            *velocity, turn = rng.uniform(low(VELOCITY_ACTION), high(VELOCITY_ACTION), (flights, 4)).T
        for model in (whole, fast):
            model.fly(np.stack(velocity), turn, rng)
    return sorted(np.linalg.norm(whole.position - fast.position, axis=0).tolist())


def steps_per_second(name: str, model: str, seed: int) -> float:
    """Of processor time, in one process: with the beginning of episodes, observations and rewards."""
    assert name in TASKS
    count = {"fast": 1024, "autopilot": 32}[model]
    env = gymnasium.make_vec(f"companion/{name}-v0", num_envs=count, model=model)
    env.reset(seed=seed)
    env.action_space.seed(seed)
    actions = env.action_space.sample() * 0.3
    done, started_s = 0, time.process_time()
    while (took_s := time.process_time() - started_s) < TIMED_S:
        env.step(actions)
        done += count
    return done / took_s


def main() -> None:
    print("| wind, m/s | mass | noise of the estimate | median, m | worst, m |\n|---|---|---|---|---|")
    for wind_m_s, mass, noise in CASES:
        errors = model_errors(wind_m_s, mass, noise=noise)
        middle = errors[len(errors) // 2]
        print(f"| {wind_m_s} | {mass} | {'yes' if noise else 'no'} | {middle:.3f} | {errors[-1]:.3f} |")
    print(f"\nsteps of 20 Hz per second of processor time, sum of {WORKERS} processes at once:")
    for model in ("fast", "autopilot"):
        timed = map_seeds(partial(steps_per_second, "Approach", model), range(WORKERS), processes=WORKERS)
        print(f"Approach, {model}: {sum(timed):.0f}")


if __name__ == "__main__":
    main()
