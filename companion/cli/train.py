"""The command line of `companion train`."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Annotated, Any

import typer

from companion.cli.flags import plain_errors
from companion.host.journal import log_to_standard_error

_DATA = "Your own data"


def train(
    output: Annotated[Path, typer.Option(help="Output: NAME.safetensors and NAME.yaml.")] = Path(
        "runs/model.safetensors"
    ),
    start: Annotated[
        str | None,
        typer.Option(
            "--from",
            "--start",
            help="Model to start from, a file or a name in the models folder. Without --data: weights to "
            "refine, instead of the first training; with it: default is the bundled model.",
        ),
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option(min=0, help="Random seed of weights and images. Default: the recipe's, or 0."),
    ] = None,
    steps: Annotated[
        int | None,
        typer.Option(min=1, help="Number of training steps. Default: the recipe's, or 40 passes over DATA."),
    ] = None,
    hours: Annotated[float | None, typer.Option(min=0.001, help="Time limit, hours.")] = None,
    workers: Annotated[int | None, typer.Option(min=0, help="Number of processes that make images.")] = None,
    threads: Annotated[int | None, typer.Option(min=1, help="CPU threads of torch.")] = None,
    resume: Annotated[bool, typer.Option(help="Continue from OUTPUT's training state.")] = False,
    held_out: Annotated[
        int, typer.Option(min=1, help="Number of scenes for the evaluation, without --data.")
    ] = 400,
    data: Annotated[
        Path | None,
        typer.Option(
            help="Labelled images: YOLO-format folder, data.yaml or COCO JSON.", rich_help_panel=_DATA
        ),
    ] = None,
    validation: Annotated[
        Path | None,
        typer.Option(
            help="Data set to evaluate on. Default: the split `val` of DATA, or its training images.",
            rich_help_panel=_DATA,
        ),
    ] = None,
    image_size: Annotated[
        int | None,
        typer.Option(min=32, help="Side of the images, pixels. Default: 640.", rich_help_panel=_DATA),
    ] = None,
    batch_size: Annotated[
        int | None, typer.Option(min=1, help="Images per step. Default: 8.", rich_help_panel=_DATA)
    ] = None,
    learning_rate: Annotated[
        float | None, typer.Option(help="Highest learning rate. Default: 0.001.", rich_help_panel=_DATA)
    ] = None,
) -> None:
    """Train a detector.

    Trains it on labelled images (--data), or the default one on rendered scenes.
    """
    from companion.learning.train import score_lines, train_default, train_on_data
    from vision.yolo.checkpoint_error import CheckpointError

    log_to_standard_error(logging.INFO, "%(message)s")
    common = _given(seed=seed, steps=steps, workers=workers, threads=threads)
    common["time_limit_s"] = None if hours is None else hours * 3600
    of_data = _given(
        start=start,
        validation=validation,
        image_size=image_size,
        batch_size=batch_size,
        learning_rate=learning_rate,
    )
    with plain_errors(CheckpointError, FileNotFoundError, FloatingPointError, ValueError, OSError):
        if data is not None:
            result = train_on_data(data, output, resume=resume, **common, **of_data)
            score, judged_on = result.after, f"{result.after.images} images"
            judged_on += ", none of them trained on" if result.held_out else ", the training images"
            for line in score_lines(result):
                typer.echo(line)
        else:
            if misplaced := sorted(of_data.keys() - {"start"}):
                raise ValueError(
                    f"--{misplaced[0].replace('_', '-')} is an option of --data, which is missing"
                )
            score = train_default(
                output,
                resume=resume,
                start=None if start is None else Path(start),
                held_out=held_out,
                **common,
            )
            judged_on = f"{held_out} held-out scenes"
    typer.echo(
        f"{output.with_suffix('.safetensors')}: mAP50 {score.map50:.3f}, mAP50-95 {score.map50_95:.3f} "
        f"on {judged_on}"
    )


def _given(**options: Any) -> dict[str, Any]:
    return {name: value for name, value in options.items() if value is not None}
