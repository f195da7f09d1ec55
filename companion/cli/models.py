"""The command line of `companion models show|pull|export`."""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import Annotated

import typer

from companion.cli.download import pull_named
from companion.cli.flags import (
    EXIT_FAILED,
    AsJson,
    Command,
    ImageSize,
    Runtime,
    check_belonging,
    plain_errors,
)

models = typer.Typer(help="List, inspect, compare, download and export models.", no_args_is_help=True)

_of_comparison = functools.partial(typer.Option, rich_help_panel="Comparison (--compare)")
_FOLDER = Annotated[
    Path | None,
    typer.Option(
        help="Models folder. Default: $COMPANION_MODELS_FOLDER, else /var/lib/companion/models where you may "
        "write it, else one in your data folder; the last two are both read."
    ),
]


@models.command(cls=Command)
def show(
    context: typer.Context,
    file: Annotated[
        str | None,
        typer.Argument(
            help="Checkpoint, exported file, `default`, or name in the models folder. Without: the bundled, "
            "local and official models."
        ),
    ] = None,
    folder: _FOLDER = None,
    image_size: ImageSize = 640,
    runtime: Runtime = None,
    compare: Annotated[
        str | None,
        _of_comparison(
            metavar="EXPORT",
            help="Compare this file from `companion models export` with FILE, a checkpoint. Exit code 1 if "
            "they differ.",
        ),
    ] = None,
    images: Annotated[
        Path | None, _of_comparison(help="Folder of images to compare on. Default: rendered scenes.")
    ] = None,
    count: Annotated[int, _of_comparison(min=1, help="Number of images.")] = 8,
    map_tolerance: Annotated[float, _of_comparison(min=0, help="Tolerance of raw maps, logits.")] = 0.02,
    box_tolerance: Annotated[float, _of_comparison(min=0, help="Tolerance of box sides, pixels.")] = 0.5,
    threads: Annotated[int | None, _of_comparison(min=1, help="CPU threads.")] = None,
    as_json: AsJson = False,
) -> None:
    """List the models, or show what a file is.

    Of a file: family, classes, GFLOPs at the image size, licence, runtime and precision; with --compare
    whether an exported model gives the same boxes.
    """
    of_compare = ("images", "count", "map_tolerance", "box_tolerance", "threads")
    check_belonging(context, "--compare EXPORT", of_compare, chosen=compare is not None)
    check_belonging(context, "a FILE", ("image_size", "runtime", "compare"), chosen=file is not None)
    check_belonging(context, "the list, without FILE", ("folder",), chosen=file is None)
    check_belonging(context, "one FILE, without --compare", ("runtime",), chosen=compare is None)
    if file is None:
        _list(folder, as_json=as_json)
    elif compare is None:
        _describe(file, image_size, runtime, as_json=as_json)
    else:
        tolerances = (map_tolerance, box_tolerance)
        _compare(file, compare, images, count, image_size, tolerances, threads, as_json=as_json)


def _list(folder: Path | None, *, as_json: bool) -> None:
    """The bundled, local and official models."""
    from companion.models.info import list_rows
    from vision.model_files import models_folders

    searched = (folder,) if folder is not None else models_folders()
    rows = list_rows(*searched)
    if as_json:
        typer.echo(json.dumps({"folders": list(map(str, searched)), "models": rows}))
        return
    typer.echo(f"models folders: {', '.join(map(str, searched))}")
    width = max(len(row["name"]) for row in rows)
    for row in rows:
        size = "       " if row["size_bytes"] is None else f"{row['size_bytes'] / 1e6:5.1f} MB"
        typer.echo(
            f"{row['licence'] or 'licence unknown':<15}  {row['name']:<{width}}  {row['state']:<13}  "
            f"{size:>8}  {row['about']}"
        )


def _describe(file: str, image_size: int, runtime: str | None, *, as_json: bool) -> None:
    """What a model file is."""
    from companion.models.export_info import export_info, export_lines
    from companion.models.info import info_lines, model_info
    from vision.detector import model_path
    from vision.runtimes.selection import check_runtime_name
    from vision.runtimes.source import read_source
    from vision.yolo.checkpoint_error import CheckpointError

    with plain_errors(CheckpointError, ValueError):
        check_runtime_name(runtime)
        source = read_source(model_path(file, runtime))  # type: ignore[arg-type]  # checked above
        if source.kind is not None or source.foreign is not None:
            export = export_info(source, image_size, runtime)  # type: ignore[arg-type]  # checked there
            plain, lines = export.plain(), export_lines(export)
        else:
            found = model_info(source.path, image_size, runtime)  # type: ignore[arg-type]
            plain, lines = found.plain(), info_lines(found)
    if as_json:
        typer.echo(json.dumps(plain))
        return
    for line in lines:
        typer.echo(line)


def _compare(
    source: str,
    exported: str,
    images: Path | None,
    count: int,
    image_size: int,
    tolerances: tuple[float, float],
    threads: int | None,
    *,
    as_json: bool,
) -> None:
    """Compare an exported model with its source. Exits with code 1 if they differ."""
    from companion.models.verify import parity_lines, sample_images, verify
    from vision.model_files import find_model
    from vision.runtimes.base import RuntimeUnusableError
    from vision.yolo.checkpoint_error import CheckpointError

    with plain_errors(CheckpointError, RuntimeUnusableError, ValueError, OSError):
        samples = sample_images(images, count)
        parity = verify(_checkpoint(source), find_model(exported), samples, image_size, threads=threads)
    holds = parity.holds(*tolerances)
    if as_json:
        typer.echo(json.dumps({**parity.plain(), "holds": holds}))
    else:
        for line in parity_lines(parity, *tolerances):
            typer.echo(line)
        typer.echo("equivalent" if holds else "NOT equivalent")
    if not holds:
        raise typer.Exit(EXIT_FAILED)


@models.command(cls=Command)
def pull(
    name: Annotated[
        str, typer.Argument(help="Model name, for example yolov8n; see `companion models show`.")
    ],
    folder: _FOLDER = None,
    url: Annotated[str | None, typer.Option(help="Mirror URL of the same file.")] = None,
) -> None:
    """Download an official model. Verifies its SHA-256 and resumes an interrupted download."""
    pulled = pull_named(name, folder, url)
    typer.echo(
        f"{pulled.path} ({'downloaded' if pulled.fetched else 'already present'}), SHA-256 {pulled.sha256}"
    )


@models.command(cls=Command)
def export(
    file: Annotated[str, typer.Argument(help="Checkpoint, `default`, or name in the models folder.")],
    to: Annotated[str, typer.Option(help="Format: onnx, openvino, tensorrt or torchscript.")],
    output: Annotated[
        Path | None,
        typer.Option(
            help="Output file. Default: beside the checkpoint; of the bundled model in the models folder."
        ),
    ] = None,
    image_size: ImageSize = 640,
    precision: Annotated[
        str, typer.Option(help="Precision: float32, or int8 with --calibrate (onnx and openvino).")
    ] = "float32",
    calibrate: Annotated[
        Path | None,
        typer.Option(help="Folder of images, as the camera sees them, from which int8 gets its ranges."),
    ] = None,
) -> None:
    """Export a model for another runtime. The file is compared with the model before it is kept."""
    from vision.exports.export import export
    from vision.model_files import models_folder
    from vision.runtimes.base import RuntimeUnusableError
    from vision.training.published import model_family_of
    from vision.weights import DEFAULT_WEIGHTS
    from vision.yolo.checkpoint import CheckpointError, load_checkpoint

    path = _checkpoint(file)
    with plain_errors(CheckpointError, RuntimeUnusableError, ValueError, OSError):
        if precision not in ("float32", "int8"):
            raise ValueError(f"--precision must be float32 or int8; got {precision!r}")
        if (precision == "int8") != (calibrate is not None):
            raise ValueError("--precision int8 and --calibrate FOLDER go together; give both")
        model_family = model_family_of(load_checkpoint(path).model)
        written = export(
            path,
            to,  # type: ignore[arg-type]  # checked there
            output,
            image_size,
            folder=models_folder() if path == DEFAULT_WEIGHTS else None,
            model_family=model_family,
            calibrate=calibrate,
        )
    typer.echo(f"{written} ({written.stat().st_size} bytes), for --model")


def _checkpoint(model: str) -> Path:
    from vision.detector import DEFAULT_MODEL
    from vision.model_files import find_model
    from vision.weights import DEFAULT_WEIGHTS

    return DEFAULT_WEIGHTS if model == DEFAULT_MODEL else find_model(model)
