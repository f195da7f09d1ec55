"""`companion train-policy`: seeded and resumable, and what it writes can be flown."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

pytest.importorskip("stable_baselines3", reason="stable_baselines3 is of the optional extra rl")

from companion import train_policy as trainer
from companion.cli import app
from companion.guidance.behaviours.policy import ACTIONS, OBSERVATIONS, check_quantities
from companion.guidance.policy_file import PolicyError, load_policy
from companion.train_policy import PolicyTrainingError, Training, description_of, train_policy

APPROACH = Training("companion/Approach-v0", "ppo", 3)
CART_POLE = Training("companion/CartPole-v0", "ppo", 0)


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rollouts of 256 steps, and few judged episodes."""
    monkeypatch.setitem(trainer.EPISODES, "ppo", 16)
    monkeypatch.setitem(
        trainer.PARAMETERS, "ppo", trainer.PARAMETERS["ppo"] | {"n_steps": 16, "batch_size": 64}
    )
    monkeypatch.setattr(trainer, "JUDGED_EPISODES", 4)


def test_same_seed_gives_the_same_file_and_another_does_not(tmp_path: Path) -> None:
    files = [tmp_path / name for name in ("a.onnx", "b.onnx", "c.onnx")]
    for file, seed in zip(files, (3, 3, 4), strict=True):
        figures = train_policy(replace(APPROACH, seed=seed), 512, file)
        assert {"return", "steps", "range_error_m"} <= set(figures)
    first, again, other = (file.read_bytes() for file in files)
    assert first == again
    assert first != other
    policy = load_policy(files[0])
    check_quantities(policy)
    assert policy.description.environment == "companion/Approach-v0"
    assert policy.description.rate_hz == 20.0
    assert list((tmp_path / "a.onnx.training" / "tensorboard").rglob("events.out.tfevents.*"))


def test_training_resumes_with_its_state(tmp_path: Path) -> None:
    file, folder = tmp_path / "policy.onnx", tmp_path / "policy.onnx.training"
    with pytest.raises(PolicyTrainingError, match=r"no state of a training in .*policy.onnx.training"):
        train_policy(CART_POLE, 256, file, resume=True)
    train_policy(CART_POLE, 256, file)
    first = file.read_bytes()
    train_policy(CART_POLE, 512, file, resume=True)
    assert json.loads((folder / "training.json").read_text())["steps"] == 512
    second = file.read_bytes()
    assert second != first
    # A finished training has nothing left to do.
    train_policy(CART_POLE, 512, file, resume=True)
    assert file.read_bytes() == second
    with pytest.raises(PolicyTrainingError, match="seed 0, not 1"):
        train_policy(replace(CART_POLE, seed=1), 1024, file, resume=True)
    with pytest.raises(PolicyTrainingError, match="holds the state of a training: continue it with --resume"):
        train_policy(CART_POLE, 512, file)


def test_sac_writes_its_policy_and_resumes(tmp_path: Path) -> None:
    training = replace(APPROACH, algorithm="sac")
    file = tmp_path / "policy.onnx"
    train_policy(training, 160, file)
    first = file.read_bytes()
    train_policy(training, 208, file, resume=True)
    assert file.read_bytes() != first
    assert len(load_policy(file).act([1.0] * 8)) == 4


def test_behaviour_and_environment_name_the_same_quantities() -> None:
    described = description_of("companion/Approach-v0")
    assert {each.name: each.unit for each in described.observation} == OBSERVATIONS
    assert {each.name: each.unit for each in described.action} == ACTIONS


def test_policy_of_another_environment_is_not_flown(tmp_path: Path) -> None:
    train_policy(CART_POLE, 256, tmp_path / "cart.onnx")
    with pytest.raises(PolicyError, match=r"cart \(companion/CartPole-v0\): unknown observation 'cart_pos"):
        check_quantities(load_policy(tmp_path / "cart.onnx"))


def test_unknown_environment_or_algorithm_is_refused_in_one_line(tmp_path: Path) -> None:
    output = ["--output", str(tmp_path / "policy.onnx")]
    for arguments, words in (
        (["companion/Car-v0"], "unknown environment 'companion/Car-v0'; there are: companion/"),
        (["companion/CartPole-v0", "--algorithm", "dqn"], "unknown algorithm 'dqn'; there are: ppo, sac"),
    ):
        result = CliRunner().invoke(app, ["train-policy", *arguments, *output])
        assert result.exit_code == 2
        assert words in result.stderr
        assert len(result.stderr.splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_missing_extra_is_named_and_help_does_not_need_it() -> None:
    code = (
        "import sys; sys.modules['stable_baselines3'] = None\n"
        "from companion.cli import app; app(sys.argv[1:])"
    )
    command = [sys.executable, "-c", code, "train-policy"]
    wanted = subprocess.run([*command, "companion/CartPole-v0"], capture_output=True, text=True)
    assert wanted.returncode == 2
    assert "mavlink-companion[rl]" in wanted.stderr
    assert len(wanted.stderr.splitlines()) == 1
    assert subprocess.run([*command, "--help"], capture_output=True, text=True).returncode == 0
