"""The compiled simulator flies as the pure one, bit for bit.

Run as a program, this file prints what it flew.
"""

import hashlib
import os
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

pytest.importorskip("gymnasium", reason="gymnasium is of the optional extra learn")
pytest.importorskip("mypyc", reason="mypyc is of the optional extra dev")

import gymnasium

from mavlink_sim import LockstepVehicle
from mavlink_sim.environments import TASKS
from mavlink_sim.physics import airframe
from tools.compile_simulator import MODULES, compile_simulator

ROOT = Path(__file__).parents[2]


def episodes(name: str, seed: int, count: int = 2, steps: int = 100) -> str:
    """Digest of all observations and rewards."""
    env = gymnasium.make_vec(f"companion/{name}-v0", num_envs=count, model="autopilot")
    env.action_space.seed(seed)
    digest = hashlib.sha256(env.reset(seed=seed)[0].tobytes())
    for step in range(steps):
        if step % 20 == 0:
            actions = env.action_space.sample()
        observed, rewards, *_ = env.step(actions)
        digest.update(observed.tobytes() + rewards.tobytes())
    return digest.hexdigest()


def flight(seed: int) -> str:
    """From the ground to the ground, with an error of the estimated heading."""
    vehicle = LockstepVehicle(seed=seed, wind_mps=6.0)
    vehicle.take_off(5.0)
    vehicle.vehicle.estimate.set_error(1, (1.0, 0.0, 0.0), yaw_rad=0.2)
    vehicle.set_velocity(3.0, 1.0, 0.0, yaw_rad=1.0)
    vehicle.step(5.0)
    vehicle.land()
    return repr((vehicle.truth, vehicle.vehicle.estimate.position, vehicle.vehicle.estimate.quaternion))


def flown(*paths: Path) -> list[str]:
    """This file's output with the simulator found first on these paths."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, paths))}
    command = [sys.executable, "-P", __file__]
    done = subprocess.run(command, env=environment, check=True, stdout=subprocess.PIPE, text=True)
    return done.stdout.splitlines()


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.needs("C compiler")
def test_compiled_flights_equal_the_pure_ones(tmp_path: Path) -> None:
    compile_simulator(tmp_path / "compiled")
    pure, compiled = flown(ROOT), flown(tmp_path / "compiled", ROOT)
    assert pure[0].endswith(MODULES[0])
    assert compiled[0].endswith(sysconfig.get_config_var("EXT_SUFFIX"))
    assert len(pure) == 16
    assert compiled[1:] == pure[1:]


if __name__ == "__main__":
    print(airframe.__file__)
    for seed in (1, 2, 3):
        for name in sorted(TASKS.keys() - {"CartPole", "Rotors"}):
            print(name, seed, episodes(name, seed))
        print("flight", seed, flight(seed))
