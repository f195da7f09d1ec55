"""The command line of `companion train-policy`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from companion.cli.flags import Processes, RayAddress, check_seed_options, plain_errors
from companion.simulation.campaign import MAX_SEED, ClusterError, SeedError, seeds_of


def train_policy(
    context: typer.Context,
    environment: Annotated[str, typer.Argument(help="Environment, for example companion/Approach-v0.")],
    algorithm: Annotated[str, typer.Option(help="Algorithm: ppo or sac.")] = "ppo",
    steps: Annotated[int, typer.Option(min=1, help="Steps of the environment, in all.")] = 1_000_000,
    seed: Annotated[int, typer.Option(min=0, max=MAX_SEED, help="Random seed of weights and episodes.")] = 0,
    seeds: Annotated[
        str | None, typer.Option(help="Train a policy for each seed, OUTPUT-SEED: 1..8, or 3,7,9..12.")
    ] = None,
    processes: Processes = 1,
    ray: RayAddress = None,
    resume: Annotated[bool, typer.Option(help="Continue from the state in OUTPUT.training.")] = False,
    output: Annotated[Path, typer.Option(help="Policy file to write.")] = Path("runs/policy.onnx"),
) -> None:
    """Train a policy in a simulated environment. Writes an ONNX file for the flight command `policy`."""
    check_seed_options(context)
    from companion.guidance.policy_file import PolicyError
    from companion.learning.train_policy import PolicyTrainingError, Training, train_policies, train_policy

    with plain_errors(PolicyTrainingError, PolicyError, ClusterError, SeedError, ValueError, OSError):
        if seeds is None:
            _report(
                output, train_policy(Training(environment, algorithm, seed), steps, output, resume=resume)
            )
            return
        for trained in train_policies(
            environment,
            algorithm,
            seeds_of(seeds),
            steps,
            output,
            resume=resume,
            processes=processes,
            ray=ray,
        ):
            _report(*trained)


def _report(output: Path, figures: dict[str, float]) -> None:
    written = ", ".join(f"{name} {value:.3g}" for name, value in figures.items())
    typer.echo(f"{output}: over 100 episodes on average {written}")
