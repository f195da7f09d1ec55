"""The command line of models: `companion models list|info|pull|export|verify`."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from companion.cli.flags import plain_errors

models = typer.Typer(
    help="Models: which there are, what is in a file, fetch, export, verify.", no_args_is_help=True
)

_JSON = Annotated[bool, typer.Option("--json", help="as JSON")]
_FOLDER = Annotated[
    Path | None,
    typer.Option(help="the models folder; else $COMPANION_MODELS_FOLDER, else one in your data folder"),
]


@models.command("list")
def list_models(folder: _FOLDER = None, as_json: _JSON = False) -> None:
    """The bundled model, those in the models folder, and the official ones that can be fetched by name."""
    from companion.models.info import list_rows
    from vision.model_files import models_folder

    where = folder or models_folder()
    rows = list_rows(where)
    if as_json:
        typer.echo(json.dumps({"folder": str(where), "models": rows}))
        return
    typer.echo(f"models folder: {where}")
    width = max(len(row["name"]) for row in rows)
    for row in rows:
        size = "       " if row["size_bytes"] is None else f"{row['size_bytes'] / 1e6:5.1f} MB"
        typer.echo(
            f"{row['name']:<{width}}  {row['state']:<13}  {size:>8}  {row['licence'] or '':<10}  "
            f"{row['about']}"
        )


@models.command()
def info(
    file: Annotated[str, typer.Argument(help="a checkpoint, `default`, or a name in the models folder")],
    image_size: Annotated[int, typer.Option(min=32, help="for the GFLOPs, pixels")] = 640,
    runtime: Annotated[
        str, typer.Option(help="torch, onnxruntime, openvino, tensorrt; auto measures")
    ] = "torch",
    as_json: _JSON = False,
) -> None:
    """What a model file is, and what it computes in here: generation, classes, GFLOPs, licence, precision."""
    from companion.models.info import info_lines, model_info
    from vision.yolo.safe_pickle import CheckpointError

    with plain_errors(CheckpointError, ValueError):
        found = model_info(_path(file), image_size, runtime)  # type: ignore[arg-type]  # checked there
    if as_json:
        typer.echo(json.dumps(found.plain()))
        return
    for line in info_lines(found):
        typer.echo(line)


@models.command()
def pull(
    name: Annotated[str, typer.Argument(help="such as yolov8n; `companion models list` has them all")],
    folder: _FOLDER = None,
    url: Annotated[str | None, typer.Option(help="fetch the same file from here instead")] = None,
) -> None:
    """Fetch an official model, check its SHA-256, keep it in the models folder. Goes on where it stopped."""
    import difflib

    from companion.models.catalog import KNOWN, LICENCE_NOTES
    from companion.models.pull import PullError, at_address, pull
    from vision.model_files import models_folder

    known = KNOWN.get(name.removesuffix(".pt"))
    if known is None:
        near = difflib.get_close_matches(name.lower(), KNOWN, n=3, cutoff=0.0)
        typer.echo(f"companion: no official model is called {name!r}; nearest: {', '.join(near)}", err=True)
        raise typer.Exit(2)
    typer.echo(f"{known.name}: {LICENCE_NOTES[known.licence]}", err=True)
    with plain_errors(PullError), _DownloadBar(known.file) as progress:
        pulled = pull(
            known if url is None else at_address(known, url),
            folder or models_folder(),
            progress=progress,
        )
    typer.echo(f"{pulled.path} ({'fetched' if pulled.fetched else 'was there'}), SHA-256 {pulled.sha256}")


@models.command()
def export(
    file: Annotated[str, typer.Argument(help="a checkpoint, `default`, or a name in the models folder")],
    to: Annotated[str, typer.Option(help="onnx, openvino, tensorrt or torchscript")],
    output: Annotated[Path | None, typer.Option(help="the file to write; else beside the checkpoint")] = None,
    image_size: Annotated[int, typer.Option(min=32, help="what it is tuned and checked for, pixels")] = 640,
) -> None:
    """Write a model for another runtime; the file is checked against the model before it is kept."""
    from vision.runtimes.base import RuntimeUnusableError
    from vision.runtimes.export import export
    from vision.yolo.checkpoint import CheckpointError, load_checkpoint
    from vision.yolo.model_family import model_family_of

    path = _path(file)
    with plain_errors(CheckpointError, RuntimeUnusableError, ValueError, OSError):
        model_family = model_family_of(load_checkpoint(path).model)
        written = export(path, to, output, image_size, model_family=model_family)  # type: ignore[arg-type]
    reader = {"onnx": "onnxruntime", "torchscript": "torch"}.get(to, to)
    typer.echo(f"{written} ({written.stat().st_size} bytes), for --model with --runtime {reader}")


@models.command()
def verify(
    source: Annotated[str, typer.Argument(help="the checkpoint")],
    exported: Annotated[Path, typer.Argument(help="what `companion models export` made of it")],
    images: Annotated[
        Path | None, typer.Option(help="folder of pictures to compare on; else drawn scenes")
    ] = None,
    count: Annotated[int, typer.Option(min=1, help="how many pictures")] = 8,
    image_size: Annotated[int, typer.Option(min=32, help="longer side the network sees, pixels")] = 640,
    map_tolerance: Annotated[float, typer.Option(min=0, help="of raw maps, logits")] = 0.02,
    box_tolerance: Annotated[float, typer.Option(min=0, help="of the sides of boxes, pixels")] = 0.5,
    threads: Annotated[int | None, typer.Option(min=1, help="processor threads")] = None,
    as_json: _JSON = False,
) -> None:
    """Whether an exported model finds what its source finds. Exit code 1 if not."""
    from companion.models.verify import parity_lines, sample_pictures, verify
    from vision.runtimes.base import RuntimeUnusableError
    from vision.yolo.safe_pickle import CheckpointError

    with plain_errors(CheckpointError, RuntimeUnusableError, ValueError, OSError):
        pictures = sample_pictures(images, count)
        parity = verify(_path(source), exported, pictures, image_size, threads=threads)
    holds = parity.holds(map_tolerance, box_tolerance)
    if as_json:
        typer.echo(json.dumps({**parity.plain(), "holds": holds}))
    else:
        for line in parity_lines(parity, map_tolerance, box_tolerance):
            typer.echo(line)
        typer.echo("the same" if holds else "NOT the same")
    if not holds:
        raise typer.Exit(1)


def _path(model: str) -> Path:
    from vision.detector import DEFAULT_MODEL
    from vision.model_files import find_model
    from vision.weights import DEFAULT_WEIGHTS

    return DEFAULT_WEIGHTS if model == DEFAULT_MODEL else find_model(model)


class _DownloadBar:
    """Bytes, speed and time left on standard error, where somebody looks."""

    def __init__(self, what: str) -> None:
        self._what = what
        self._bar: Any = None
        self._task: Any = None

    def __enter__(self) -> _DownloadBar:
        return self

    def __call__(self, done: int, total: int | None) -> None:
        if not sys.stderr.isatty():
            return
        if self._bar is None:
            from rich.console import Console
            from rich.progress import (
                BarColumn,
                DownloadColumn,
                Progress,
                TextColumn,
                TimeRemainingColumn,
                TransferSpeedColumn,
            )

            self._bar = Progress(
                TextColumn("{task.description}"),
                BarColumn(),
                DownloadColumn(),
                TransferSpeedColumn(),
                TimeRemainingColumn(),
                console=Console(stderr=True),
            )
            self._bar.start()
            self._task = self._bar.add_task(self._what, total=total)
        self._bar.update(self._task, completed=done, total=total)

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()
