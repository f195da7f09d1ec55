"""Downloads an official model, for `models pull` and the option `--pull` of commands that use one."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from companion.cli.flags import EXIT_BAD_INPUT, is_terminal, plain_errors
from companion.host.passing import EXIT_PASSING

if TYPE_CHECKING:
    from vision.model_download import Pulled

Pull = Annotated[
    bool,
    typer.Option(
        "--pull",
        help="Download the model first if it is not there; without --model yolox_s, Apache-2.0.",
    ),
]


def pull_named(
    name: str, folder: Path | None = None, url: str | None = None, *, failed: int = EXIT_BAD_INPUT
) -> Pulled:
    """Download an official model, as `companion models pull`. Exits with code `failed` if that fails."""
    import difflib

    from vision.catalog import KNOWN, LICENCE_NOTES
    from vision.model_download import PullError, at_address
    from vision.model_download import pull as download
    from vision.model_files import models_folder

    known = KNOWN.get(name.removesuffix(".pt").removesuffix(".onnx"))
    if known is None:
        nearest = difflib.get_close_matches(name.lower(), KNOWN, n=3, cutoff=0.0)
        typer.echo(f"companion: unknown official model {name!r}; nearest: {', '.join(nearest)}", err=True)
        raise typer.Exit(2)
    licence = f"{known.name}: {LICENCE_NOTES[known.licence]}"
    with plain_errors(PullError, code=failed), _DownloadBar(known.file, licence) as progress:
        pulled = download(
            known if url is None else at_address(known, url), folder or models_folder(), progress=progress
        )
    if not pulled.fetched:
        typer.echo(licence, err=True)
    return pulled


def model_after_pull(model: str, sources: Iterable[str]) -> str:
    """Return the model to use with `--pull`: this one, downloaded if it is not there.

    Instead of the bundled one, which knows rendered scenes only, it is `CAMERA_MODEL` where a source is no
    rendered camera of the simulator. A mistyped file is said before the download.
    """
    from vision.catalog import CAMERA_MODEL
    from vision.detector import DEFAULT_MODEL
    from vision.model_files import find_model
    from vision.sources import SourceError, SourceUnavailableError, check_there

    sources = tuple(sources)
    if model == DEFAULT_MODEL:
        if all(source.startswith("shm://") for source in sources):
            return model
        model = CAMERA_MODEL
    if not find_model(model).exists():
        with plain_errors(SourceError):
            for source in sources:
                with suppress(SourceUnavailableError):  # it may come
                    check_there(source)
        pull_named(model, failed=EXIT_PASSING)  # the network may be there at the next start
    return model


class _DownloadBar:
    """A line once the server has answered; on a terminal also bytes, speed and remaining time."""

    def __init__(self, what: str, first_line: str) -> None:
        self._what = what
        self._first_line: str | None = first_line
        self._bar: Any = None
        self._task: Any = None

    def __enter__(self) -> _DownloadBar:
        return self

    def __call__(self, done: int, total: int | None) -> None:
        if self._first_line is not None:
            typer.echo(self._first_line, err=True)
            self._first_line = None
        if not is_terminal(sys.stderr):
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
