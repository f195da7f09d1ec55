"""The command line of `companion models list|info|pull|export|verify`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from companion.cli.download import pull_named
from companion.cli.flags import plain_errors

if TYPE_CHECKING:
    pass

models = typer.Typer(help="List, inspect, download, export and verify models.", no_args_is_help=True)

_JSON = Annotated[bool, typer.Option("--json", help="Print JSON.")]
_FOLDER = Annotated[
    Path | None,
    typer.Option(
        help="Models folder. Default: $COMPANION_MODELS_FOLDER, else /var/lib/companion/models where you may "
        "write it, else one in your data folder; the last two are both read."
    ),
]


@models.command("list")
def list_models(folder: _FOLDER = None, as_json: _JSON = False) -> None:
    """List bundled, local and official models."""
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


@models.command()
def info(
    file: Annotated[
        str, typer.Argument(help="Checkpoint, exported file, `default`, or name in the models folder.")
    ],
    image_size: Annotated[int, typer.Option(min=32, help="Image size for the GFLOPs, pixels.")] = 640,
    runtime: Annotated[
        str | None,
        typer.Option(
            help="Runtime: torch, onnxruntime, openvino, tensorrt or auto. Default: that of the file, "
            "torch for a checkpoint."
        ),
    ] = None,
    as_json: _JSON = False,
) -> None:
    """Describe a model file. Prints family, classes, GFLOPs, licence, runtime and precision."""
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


@models.command()
def pull(
    name: Annotated[
        str, typer.Argument(help="Model name, for example yolov8n; see `companion models list`.")
    ],
    folder: _FOLDER = None,
    url: Annotated[str | None, typer.Option(help="Mirror URL of the same file.")] = None,
) -> None:
    """Download an official model. Verifies its SHA-256 and resumes an interrupted download."""
    pulled = pull_named(name, folder, url)
    typer.echo(
        f"{pulled.path} ({'downloaded' if pulled.fetched else 'already present'}), SHA-256 {pulled.sha256}"
    )


@models.command()
def export(
    file: Annotated[str, typer.Argument(help="Checkpoint, `default`, or name in the models folder.")],
    to: Annotated[str, typer.Option(help="Format: onnx, openvino, tensorrt or torchscript.")],
    output: Annotated[
        Path | None,
        typer.Option(
            help="Output file. Default: beside the checkpoint; of the bundled model in the models folder."
        ),
    ] = None,
    image_size: Annotated[
        int, typer.Option(min=32, help="Image size for tuning and checking, pixels.")
    ] = 640,
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
    from vision.weights import DEFAULT_WEIGHTS
    from vision.yolo.checkpoint import CheckpointError, load_checkpoint
    from vision.yolo.published import model_family_of

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


@models.command()
def verify(
    source: Annotated[str, typer.Argument(help="Checkpoint.")],
    exported: Annotated[str, typer.Argument(help="File from `companion models export`.")],
    images: Annotated[
        Path | None, typer.Option(help="Folder of images to compare on. Default: rendered scenes.")
    ] = None,
    count: Annotated[int, typer.Option(min=1, help="Number of images.")] = 8,
    image_size: Annotated[
        int, typer.Option(min=32, help="Longer side of the network's input, pixels.")
    ] = 640,
    map_tolerance: Annotated[float, typer.Option(min=0, help="Tolerance of raw maps, logits.")] = 0.02,
    box_tolerance: Annotated[float, typer.Option(min=0, help="Tolerance of box sides, pixels.")] = 0.5,
    threads: Annotated[int | None, typer.Option(min=1, help="CPU threads.")] = None,
    as_json: _JSON = False,
) -> None:
    """Compare an exported model with its source. Exit code 1 if they differ."""
    from companion.models.verify import parity_lines, sample_images, verify
    from vision.model_files import find_model
    from vision.runtimes.base import RuntimeUnusableError
    from vision.yolo.checkpoint_error import CheckpointError

    with plain_errors(CheckpointError, RuntimeUnusableError, ValueError, OSError):
        samples = sample_images(images, count)
        parity = verify(_checkpoint(source), find_model(exported), samples, image_size, threads=threads)
    holds = parity.holds(map_tolerance, box_tolerance)
    if as_json:
        typer.echo(json.dumps({**parity.plain(), "holds": holds}))
    else:
        for line in parity_lines(parity, map_tolerance, box_tolerance):
            typer.echo(line)
        typer.echo("equivalent" if holds else "NOT equivalent")
    if not holds:
        raise typer.Exit(1)


def _checkpoint(model: str) -> Path:
    from vision.detector import DEFAULT_MODEL
    from vision.model_files import find_model
    from vision.weights import DEFAULT_WEIGHTS

    return DEFAULT_WEIGHTS if model == DEFAULT_MODEL else find_model(model)
