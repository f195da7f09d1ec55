"""`companion learn train --policy`: seeded and resumable, and what it writes can be flown."""

from __future__ import annotations

import pickle
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
from typer.testing import CliRunner

pytest.importorskip("stable_baselines3", reason="stable_baselines3 is of the optional extra learn")

import torch

from companion.cli import app
from companion.guidance.behaviours.policy import ACTIONS, OBSERVATIONS, check_quantities
from companion.guidance.policy_file import PolicyError, load_policy
from companion.learning import train_policy as trainer
from companion.learning.train_policy import PolicyTrainingError, Training, description_of, train_policy
from companion.learning.training_display import TrainingDisplay

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
    """Its description has the range of what the episodes visited."""
    files = [tmp_path / name for name in ("a.onnx", "b.onnx", "c.onnx")]
    for file, seed in zip(files, (3, 3, 4), strict=True):
        figures = train_policy(replace(APPROACH, seed=seed), 256, file)
        assert {"return", "steps", "range_error_m"} <= set(figures)
    first, again, other = (file.read_bytes() for file in files)
    assert first == again
    assert first != other
    policy = load_policy(files[0])
    check_quantities(policy)
    assert policy.description.environment == "companion/Approach-v0"
    assert policy.description.rate_hz == 20.0
    assert list((tmp_path / "a.onnx.training" / "tensorboard").rglob("events.out.tfevents.*"))
    limits = {each.name: each for each in description_of("companion/Approach-v0").observation}
    found = {each.name: each for each in policy.description.observation}
    for name, each in found.items():
        assert limits[name].low <= each.low < each.high <= limits[name].high
    # Episodes begin at heights of 1.5 to 3.5 m, 6 to 30 m away.
    assert -10.0 < found["target_up_m"].low < -1.5
    assert found["target_forward_m"].high < 35.0
    assert 4.4 <= found["distance_wanted_m"].low


def test_policies_of_many_seeds_are_those_of_each_seed(tmp_path: Path) -> None:
    command = ["learn", "train", "--policy", "companion/CartPole-v0", "--steps", "256"]
    output, alone = tmp_path / "policy.onnx", tmp_path / "alone.onnx"
    several = [*command, "--seeds", "3,5", "--output", str(output)]
    result = CliRunner().invoke(app, several)
    assert result.exit_code == 0, result.output
    assert [line.split(":")[0] for line in result.stdout.splitlines()] == [
        str(tmp_path / "policy-3.onnx"),
        str(tmp_path / "policy-5.onnx"),
    ]
    train_policy(replace(CART_POLE, seed=5), 256, alone)
    assert (tmp_path / "policy-5.onnx").read_bytes() == alone.read_bytes()
    assert (tmp_path / "policy-3.onnx").read_bytes() != alone.read_bytes()
    assert list((tmp_path / "policy-5.onnx.training" / "tensorboard").rglob("events.out.tfevents.*"))
    train_policy(replace(CART_POLE, seed=5), 512, tmp_path / "policy-5.onnx", resume=True)
    elsewhere = ["--output", str(tmp_path / "other.onnx"), "--resume"]
    for refused in (
        several,
        [*several, *elsewhere],
        [*several, "--resume", "--ray", "127.0.0.1:1"],
        [*command, "--seeds", "5..3"],
    ):
        result = CliRunner().invoke(app, refused)
        assert result.exit_code == 2
        assert len(result.stderr.splitlines()) == 1


def test_failed_training_of_a_seed_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object) -> None:
        raise RuntimeError("policy 7")

    monkeypatch.setattr(trainer, "judge", fails)
    command = ["learn", "train", "--policy", "companion/CartPole-v0", "--steps", "256", "--seeds", "3"]
    result = CliRunner().invoke(app, [*command, "--output", str(tmp_path / "policy.onnx")])
    assert result.exit_code == 2
    trained, failed = result.stderr.splitlines()
    assert trained.startswith("seed 3: step 256/256 return ")
    assert failed.endswith("seed 3: RuntimeError: policy 7")


def test_interrupted_trainings_of_many_seeds_resume(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The first stores a state and is interrupted; the second was not begun."""
    monkeypatch.setattr(trainer, "CHECKPOINT_STEPS", 256)
    monkeypatch.setattr(TrainingDisplay, "EVERY_S", 0.0)
    several = partial(trainer.train_policies, "companion/CartPole-v0", "ppo", [3, 5])
    with monkeypatch.context() as patch:

        def interrupt(*_: object) -> None:
            raise KeyboardInterrupt

        patch.setattr(trainer, "judge", interrupt)
        with pytest.raises(KeyboardInterrupt):
            list(several(768, tmp_path / "policy.onnx"))
    assert "seed 3: step 512/768 return" in capsys.readouterr().err
    state = tmp_path / "policy-3.onnx.training" / "state.pt"
    assert torch.load(state, weights_only=True)["steps"] == 768
    resumed = list(several(1024, tmp_path / "policy.onnx", resume=True))
    shown = capsys.readouterr().err
    assert "seed 3: step 256/" not in shown
    assert "seed 3: step 768/1024" in shown
    assert "seed 5: step 256/1024" in shown
    assert [file for file, _ in resumed] == [tmp_path / "policy-3.onnx", tmp_path / "policy-5.onnx"]
    assert torch.load(state, weights_only=True)["steps"] == 1024


def test_training_resumes_with_its_state(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    file, folder = tmp_path / "policy.onnx", tmp_path / "policy.onnx.training"
    with pytest.raises(PolicyTrainingError, match=r"\.training: state\.pt"):
        train_policy(CART_POLE, 256, file, resume=True)
    train_policy(CART_POLE, 256, file)
    first = file.read_bytes()
    capsys.readouterr()
    train_policy(CART_POLE, 500, file, resume=True)
    (last,) = capsys.readouterr().err.splitlines()
    assert last.startswith("step 512/500 return ")
    assert last.endswith(" steps/s, 0.0 min left")
    assert torch.load(folder / "state.pt", weights_only=True)["steps"] == 512
    second = file.read_bytes()
    assert second != first
    # A finished training has nothing left to do.
    train_policy(CART_POLE, 512, file, resume=True)
    assert file.read_bytes() == second
    with pytest.raises(PolicyTrainingError, match="seed 0, not 1"):
        train_policy(replace(CART_POLE, seed=1), 1024, file, resume=True)
    with pytest.raises(PolicyTrainingError, match=r"\.training .* --resume\b"):
        train_policy(CART_POLE, 512, file)
    monkeypatch.setitem(trainer.EPISODES, "ppo", 8)
    with pytest.raises(PolicyTrainingError, match="episodes 16, not 8"):
        train_policy(CART_POLE, 1024, file, resume=True)


class _Runs:
    """Unpickled, it makes a file."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __reduce__(self) -> tuple[object, ...]:
        return Path.touch, (self._path,)


def test_state_that_is_no_training_is_refused_and_runs_nothing(tmp_path: Path) -> None:
    file, state = tmp_path / "policy.onnx", tmp_path / "policy.onnx.training" / "state.pt"
    command = [
        "learn",
        "train",
        "--policy",
        "companion/CartPole-v0",
        "--steps",
        "512",
        "--resume",
        "--output",
        str(file),
    ]
    train_policy(CART_POLE, 256, file)
    whole, run = torch.load(state, weights_only=True), tmp_path / "run"

    def refused() -> str:
        result = CliRunner().invoke(app, command)
        assert result.exit_code == 2
        assert f"--resume: {state} is no " in result.stderr
        assert len(result.stderr.splitlines()) == 1
        return result.stderr

    content = state.read_bytes()
    for bad in (content[: len(content) // 2], b"", b"[]", pickle.dumps(_Runs(run), 2)):
        state.write_bytes(bad)
        refused()
    mean = whole["arrays"]["observation.mean"]
    bad_states: tuple[object, ...] = (
        [],
        {},
        _Runs(run),
        whole | {"extra": _Runs(run)},
        whole | {"steps": -(10**13)},
        whole | {"parameters": {}},
        whole | {"parameters": whole["parameters"] | {"policy": {"x": mean}}},
        whole | {"arrays": whole["arrays"] | {"observation.mean": mean[:1]}},
        whole | {"arrays": whole["arrays"] | {"observation.mean": mean * float("nan")}},
    )
    for bad_state in bad_states:
        torch.save(bad_state, state)
        refused()
    assert not run.exists()


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
    with pytest.raises(PolicyError, match=r"CartPole-v0\): .*'cart_pos"):
        check_quantities(load_policy(tmp_path / "cart.onnx"))


def test_unknown_environment_or_algorithm_is_refused_in_one_line(tmp_path: Path) -> None:
    output = ["--output", str(tmp_path / "policy.onnx")]
    for arguments, words in (
        (["companion/Car-v0"], "unknown environment 'companion/Car-v0'; there are: companion/"),
        (["companion/CartPole-v0", "--algorithm", "dqn"], "unknown algorithm 'dqn'; there are: ppo, sac"),
    ):
        result = CliRunner().invoke(app, ["learn", "train", "--policy", *arguments, *output])
        assert result.exit_code == 2
        assert words in result.stderr
        assert len(result.stderr.splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_missing_extra_is_named_and_help_does_not_need_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    monkeypatch.delitem(sys.modules, "companion.learning.train_policy")  # imported without it
    shown = CliRunner().invoke(app, ["learn", "train", "--help"])
    assert "--algorithm" in shown.stdout
    done = CliRunner().invoke(app, ["learn", "train", "--policy", "companion/CartPole-v0"])
    assert done.exit_code == 2
    assert "mavlink-companion[learn]" in done.stderr
    assert len(done.stderr.splitlines()) == 1
