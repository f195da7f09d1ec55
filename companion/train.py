"""`companion train`: train the bundled detector from this repository.

The recipe (`vision.yolo.recipe`) and the scenes (`mavlink_sim.datasets.training_scenes`) determine the
weights; nothing is downloaded.
"""

from __future__ import annotations

import json
import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from mavlink_sim.datasets.training_scenes import random_scene, training_scene
from mavlink_sim.world.shapes import CLASS_NAMES
from vision.yolo.checkpoint import load_checkpoint, save_checkpoint
from vision.yolo.checkpoint_pair import WEIGHTS_SUFFIX
from vision.yolo.metrics import Score
from vision.yolo.recipe import DEFAULT_RECIPE, HELD_OUT_SEED, HELD_OUT_SIZE, REFINEMENT, evaluate
from vision.yolo.training import Progress as TrainingProgress
from vision.yolo.training import TrainedModel, TrainingSettings, train

LICENCE = "Apache-2.0"


def train_default(
    output: Path,
    *,
    seed: int | None = None,
    steps: int | None = None,
    time_limit_s: float | None = None,
    workers: int | None = None,
    threads: int | None = None,
    resume: bool = False,
    start: Path | None = None,
    held_out: int = 400,
) -> Score:
    """Train by the recipe with the given changes, evaluate, and write the result (`evaluate_and_save`).

    The first stage starts with random weights, the second refines them. The state of each is stored beside
    the output as `<output>.training` and `<output>.refining`, for `resume`. `steps` and `time_limit_s` are
    distributed over the stages in proportion.

    Args:
        start: a model of the recipe's network to refine; replaces the first stage.

    Raises:
        FileNotFoundError: `resume` without a state. CheckpointError: `start` cannot be read.
        ValueError: the state or `start` belongs to another recipe.
    """
    output.parent.mkdir(parents=True, exist_ok=True)
    changes: dict[str, Any] = {
        key: value for key, value in (("workers", workers), ("threads", threads)) if value is not None
    }
    first, second = replace(DEFAULT_RECIPE, **changes), replace(REFINEMENT, **changes)
    if tuple(first.class_names) != tuple(CLASS_NAMES):
        raise ValueError(f"recipe classes {first.class_names}, expected those of the scenes {CLASS_NAMES}")
    if seed is not None:
        first, second = replace(first, seed=seed), replace(second, seed=seed + 1)
    share = 0.0 if start is not None else first.steps / (first.steps + second.steps)
    if steps is not None:
        second = second.with_steps(max(1, round(steps * (1 - share))))
        first = first.with_steps(max(1, round(steps * share)))
    if time_limit_s is not None:
        first = replace(first, time_limit_s=time_limit_s * share)
        second = replace(second, time_limit_s=time_limit_s * (1 - share))
    states = [output.with_suffix(f"{output.suffix}.{name}") for name in ("training", "refining")]
    with _ProgressDisplay() as display:
        if start is not None:
            initial = load_checkpoint(start).model
        else:
            initial = train(first, random_scene, display, checkpoint=states[0], resume=resume).model
        refined = train(
            second,
            training_scene,
            display,
            checkpoint=states[1],
            resume=resume and (start is not None or states[1].is_file()),
            start=initial,
        )
    return evaluate_and_save(output, refined, second, held_out)


def evaluate_and_save(
    output: Path, trained: TrainedModel, settings: TrainingSettings, held_out: int
) -> Score:
    """Score a model on held-out scenes and write it, fp16, with licence, score and settings.

    Writes the pair `NAME.safetensors` and `NAME.yaml`, whatever the suffix of `output`.
    """
    width, height = HELD_OUT_SIZE
    score = evaluate(trained.model, training_scene, HELD_OUT_SEED, held_out, width, height)
    metadata = {
        "licence": LICENCE,
        "trained_on": "scenes drawn by mavlink_sim.datasets.training_scenes",
        "steps_done": trained.steps_done,
        "score": {
            "map50": round(score.map50, 4),
            "map50_95": round(score.map50_95, 4),
            "per_class": json.loads(json.dumps(score.per_class, default=asdict)),
            "held_out_scenes": held_out,
            "held_out_seed": HELD_OUT_SEED,
            "held_out_size": [width, height],
        },
        "settings": json.loads(json.dumps(asdict(settings))),
    }
    save_checkpoint(output.with_suffix(WEIGHTS_SUFFIX), trained.model, metadata=metadata)
    return score


class _ProgressDisplay:
    """Progress on standard error: a bar on a terminal, else a line per 100 steps."""

    _LINE_EVERY = 100

    def __init__(self) -> None:
        self._bar: Progress | None = None
        if sys.stderr.isatty():
            self._bar = Progress(
                TextColumn("training"),
                BarColumn(),
                TextColumn("{task.fields[losses]}"),
                TimeRemainingColumn(),
                console=Console(stderr=True),
            )
        self._task = self._bar.add_task("training", total=None, losses="") if self._bar else None

    def __call__(self, progress: TrainingProgress) -> None:
        losses = (
            f"step {progress.step}/{progress.steps} box {progress.box_loss:.3f} "
            f"class {progress.class_loss:.3f} distribution {progress.distribution_loss:.3f} "
            f"{progress.images_per_s:.1f} images/s"
        )
        if self._bar is not None and self._task is not None:
            self._bar.update(self._task, total=progress.steps, completed=progress.step, losses=losses)
        elif progress.step % self._LINE_EVERY == 0 or progress.step == progress.steps:
            print(f"{losses}, {progress.remaining_s / 60:.1f} min left", file=sys.stderr, flush=True)

    def __enter__(self) -> _ProgressDisplay:
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()
