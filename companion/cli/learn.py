"""The command line of `companion learn collect|evaluate|train`."""

from __future__ import annotations

import functools
import json
import logging
import signal
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from companion.cli.flags import (
    CLIENT_SETTINGS,
    AsJson,
    Command,
    Device,
    ImageSize,
    Iou,
    Limit,
    Model,
    Processes,
    RayAddress,
    Runtime,
    Threads,
    TileOverlap,
    Tiles,
    TileSize,
    check_belonging,
    check_seed_options,
    plain_errors,
    settings_command,
    vehicle_of,
)
from companion.host.journal import log_to_standard_error

if TYPE_CHECKING:
    from companion.settings import Settings

learn = typer.Typer(
    help="Collect frames, evaluate models, train detectors and policies.", no_args_is_help=True
)

_of_detector = functools.partial(typer.Option, rich_help_panel="A detector")
_of_data = functools.partial(typer.Option, rich_help_panel="A detector, on your own data")
_of_policy = functools.partial(typer.Option, rich_help_panel="A policy")
_POLICY_STEPS = 1_000_000


@settings_command(learn, *CLIENT_SETTINGS)
def collect(
    settings: Settings,
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="Folder of the data set, new or to be continued.")
    ],
    files: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[FILE…]", help="Recordings of one run, in order. None: a running service."),
    ] = None,
    camera: Annotated[str | None, typer.Option(help="Name of the camera. Default: the first.")] = None,
    interval: Annotated[float, typer.Option(min=0, help="Least time between two images, seconds.")] = 1.0,
    most: Annotated[int, typer.Option(min=1, help="Number of images.")] = 200,
) -> None:
    """Collect frames to label.

    Writes those with tracks that were doubted, lost, or changed class, from recordings, or from a running
    service until Ctrl-C. The labels are the model's own boxes; correct them, then train with `companion
    learn train --data FOLDER`.
    """
    from companion.bus.client import NoAnswerError, client_settings, open_client
    from companion.bus.config import BusError
    from companion.learning import collect as collecting
    from companion.logs.frames import recorded_frames
    from companion.recording import RecordingError

    ending = threading.Event()
    kept = 0
    with plain_errors(RecordingError, NoAnswerError, BusError, ValueError, OSError):
        if files:
            frames, source = recorded_frames(files, camera), files[0].stem
        else:
            for number in (signal.SIGINT, signal.SIGTERM):
                signal.signal(number, lambda *_: ending.set())
            zenoh = client_settings(settings.zenoh)
            with open_client(zenoh) as session:
                vehicle = vehicle_of(session, settings)
            source = f"{vehicle}_{time.strftime('%Y%m%dT%H%M%SZ', time.gmtime())}"
            frames = collecting.live_frames(zenoh, vehicle, camera, ending)
        for path, reasons in collecting.collect(frames, folder, source, interval_s=interval, most=most):
            kept += 1
            typer.echo(f"{path}: {', '.join(reasons)}")
    typer.echo(f"{folder}: {kept} images", err=True)


@learn.command(cls=Command)
def evaluate(
    dataset: Annotated[Path, typer.Argument(help="YOLO-format folder, data.yaml or COCO JSON.")],
    model: Model = "default",
    split: Annotated[
        str | None, typer.Option(help="Split of a data.yaml: train, val or test. Default: val.")
    ] = None,
    images: Annotated[Path | None, typer.Option(help="Image folder of a COCO file.")] = None,
    image_size: ImageSize = 640,
    iou: Iou = None,
    runtime: Runtime = None,
    precision: Annotated[
        str | None,
        typer.Option(
            help="Precision: auto, float32, bfloat16 or float16. Default: float32, or auto for an int8 file."
        ),
    ] = None,
    device: Device = "cpu",
    threads: Threads = None,
    tiles: Tiles = False,
    tile_size: TileSize = None,
    tile_overlap: TileOverlap = 0.2,
    limit: Limit = None,
    misses: Annotated[Path, typer.Option(help="Output image of the worst misses.")] = Path("misses.png"),
    as_json: AsJson = False,
) -> None:
    """Evaluate a model on a labelled data set. Prints mAP50 and mAP50-95, overall and per class."""
    from companion.learning.evaluate import (
        JUDGED_CONFIDENCE,
        evaluate_dataset,
        map_classes,
        report_lines,
        usual_precision,
        write_sheet,
    )
    from vision.detector import Detector
    from vision.evaluation.datasets import DatasetError, open_dataset
    from vision.pipeline import FrameDetector
    from vision.tiling import TiledDetector
    from vision.yolo.checkpoint_error import CheckpointError

    log_to_standard_error(logging.INFO, "%(message)s")
    with plain_errors(CheckpointError, DatasetError, ValueError, OSError):
        data = open_dataset(dataset, split=split, images=images)
        if limit is not None:
            data = replace(data, samples=data.samples[:limit])
        detector = Detector(
            model,
            confidence=JUDGED_CONFIDENCE,
            iou=iou,
            image_size=image_size,
            precision=precision or usual_precision(model),  # type: ignore[arg-type]
            device=device,  # type: ignore[arg-type]
            threads=threads,
            runtime=runtime,  # type: ignore[arg-type]
        )
        frame_detector: FrameDetector = detector
        if tiles:
            frame_detector = TiledDetector(detector, tile_size=tile_size or image_size, overlap=tile_overlap)
        evaluation = evaluate_dataset(data, frame_detector, map_classes(detector.class_names, data))
        has_sheet = write_sheet(evaluation, misses)
    if as_json:
        settings = {
            "model": model,
            "dataset": str(dataset),
            "image_size": image_size,
            "runtime": detector.runtime,
            "precision": detector.precision,
            "tiles": tiles,
        }
        sheet = str(misses) if has_sheet else None
        typer.echo(json.dumps({**settings, **evaluation.plain(), "misses_image": sheet}))
        return
    for line in report_lines(evaluation):
        typer.echo(line)
    if has_sheet:
        typer.echo(f"worst misses: {misses}")


@learn.command(cls=Command)
def train(
    context: typer.Context,
    output: Annotated[
        Path | None,
        typer.Option(
            help="Output: NAME.safetensors and NAME.yaml, or the policy's file. Default: "
            "runs/model.safetensors, runs/policy.onnx."
        ),
    ] = None,
    seed: Annotated[
        int | None, typer.Option(min=0, help="Random seed of weights and images or episodes. Default: 0.")
    ] = None,
    steps: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Number of training steps. Default: the recipe's, or 40 passes over DATA; of a policy "
            "1,000,000 of the environment.",
        ),
    ] = None,
    resume: Annotated[bool, typer.Option(help="Continue from OUTPUT's training state.")] = False,
    start: Annotated[
        str | None,
        _of_detector(
            "--from",
            "--start",
            help="Model to start from, a file or a name in the models folder. Without --data: weights to "
            "refine, instead of the first training; with it: default is the bundled model.",
        ),
    ] = None,
    hours: Annotated[float | None, _of_detector(min=0.001, help="Time limit, hours.")] = None,
    workers: Annotated[int | None, _of_detector(min=0, help="Number of processes that make images.")] = None,
    threads: Annotated[int | None, _of_detector(min=1, help="CPU threads of torch.")] = None,
    held_out: Annotated[
        int, _of_detector(min=1, help="Number of scenes for the evaluation, without --data.")
    ] = 400,
    data: Annotated[
        Path | None, _of_data(help="Labelled images: YOLO-format folder, data.yaml or COCO JSON.")
    ] = None,
    validation: Annotated[
        Path | None,
        _of_data(help="Data set to evaluate on. Default: the split `val` of DATA, or its training images."),
    ] = None,
    image_size: Annotated[
        int | None, _of_data(min=32, help="Side of the images, pixels. Default: 640.")
    ] = None,
    batch_size: Annotated[int | None, _of_data(min=1, help="Images per step. Default: 8.")] = None,
    learning_rate: Annotated[float | None, _of_data(help="Highest learning rate. Default: 0.001.")] = None,
    policy: Annotated[
        str | None,
        _of_policy(
            metavar="TASK", help="Train a policy in this environment, for example companion/Approach-v0."
        ),
    ] = None,
    algorithm: Annotated[str, _of_policy(help="Algorithm: ppo or sac.")] = "ppo",
    seeds: Annotated[
        str | None, _of_policy(help="Train a policy for each seed, OUTPUT-SEED: 1..8, or 3,7,9..12.")
    ] = None,
    processes: Processes = 1,
    ray: RayAddress = None,
) -> None:
    """Train a detector or a flight policy.

    A detector: on labelled images (--data), or the default one on rendered scenes. A policy (--policy): in a
    simulated environment; writes an ONNX file for the flight command `policy`.
    """
    of_policy = ("algorithm", "seeds", "processes", "ray")
    of_data = ("validation", "image_size", "batch_size", "learning_rate")
    of_detector = ("start", "hours", "workers", "threads", "held_out", "data", *of_data)
    check_belonging(context, "--policy TASK", of_policy, chosen=policy is not None)
    check_belonging(context, "a detector, without --policy", of_detector, chosen=policy is None)
    check_belonging(context, "--data DATA", of_data, chosen=data is not None)
    if policy is not None:
        check_seed_options(context)
        policy_file = output or Path("runs/policy.onnx")
        _train_policy(policy, algorithm, policy_file, seed, seeds, steps, processes, ray, resume=resume)
        return
    common = _given(seed=seed, steps=steps, workers=workers, threads=threads)
    common["time_limit_s"] = None if hours is None else hours * 3600
    own = _given(
        start=start,
        validation=validation,
        image_size=image_size,
        batch_size=batch_size,
        learning_rate=learning_rate,
    )
    _train_detector(
        output or Path("runs/model.safetensors"), data, common, own, held_out=held_out, resume=resume
    )


def _train_detector(
    output: Path,
    data: Path | None,
    common: dict[str, Any],
    own: dict[str, Any],
    *,
    held_out: int,
    resume: bool,
) -> None:
    from companion.learning.train import score_lines, train_default, train_on_data
    from vision.yolo.checkpoint_error import CheckpointError

    log_to_standard_error(logging.INFO, "%(message)s")
    with plain_errors(CheckpointError, FileNotFoundError, FloatingPointError, ValueError, OSError):
        if data is not None:
            result = train_on_data(data, output, resume=resume, **common, **own)
            score, judged_on = result.after, f"{result.after.images} images"
            judged_on += ", none of them trained on" if result.held_out else ", the training images"
            for line in score_lines(result):
                typer.echo(line)
        else:
            start = own.get("start")
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


def _train_policy(
    task: str,
    algorithm: str,
    output: Path,
    seed: int | None,
    seeds: str | None,
    steps: int | None,
    processes: int,
    ray: str | None,
    *,
    resume: bool,
) -> None:
    from companion.guidance.policy_file import PolicyError
    from companion.learning.train_policy import PolicyTrainingError, Training, train_policies, train_policy
    from companion.simulation.campaign import MAX_SEED, ClusterError, SeedError, seeds_of

    steps = steps or _POLICY_STEPS
    with plain_errors(PolicyTrainingError, PolicyError, ClusterError, SeedError, ValueError, OSError):
        if seed is not None and seed > MAX_SEED:
            raise ValueError(f"--seed must be 0 to {MAX_SEED}, got {seed}")
        if seeds is None:
            training = Training(task, algorithm, seed or 0)
            _report(output, train_policy(training, steps, output, resume=resume))
            return
        for trained in train_policies(
            task, algorithm, seeds_of(seeds), steps, output, resume=resume, processes=processes, ray=ray
        ):
            _report(*trained)


def _report(output: Path, figures: dict[str, float]) -> None:
    written = ", ".join(f"{name} {value:.3g}" for name, value in figures.items())
    typer.echo(f"{output}: over 100 episodes on average {written}")


def _given(**options: Any) -> dict[str, Any]:
    return {name: value for name, value in options.items() if value is not None}
