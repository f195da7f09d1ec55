"""The command line of `companion markers`."""

from __future__ import annotations

import functools
import logging
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from companion.cli.flags import EXIT_BAD_INPUT, plain_errors
from vision.gc_pause import gc_paused

if TYPE_CHECKING:
    from companion.settings import Settings
    from companion.settings.perception import MarkersSection

MARKER_SETTINGS = ("camera", "markers.others", "markers.boards_file")


def markers(
    settings: Settings,
    source: Annotated[
        str, typer.Argument(help="File, folder, /dev/video0, FIFO, - (standard input), shm:// or URL.")
    ],
    dictionary: Annotated[
        str | None, typer.Option(help="OpenCV's dictionary: APRILTAG_36h11. Default: markers.dictionary.")
    ] = None,
    size: Annotated[
        float | None, typer.Option(help="Side of the black square, metres. Default: markers.size_m.")
    ] = None,
    limit: Annotated[int | None, typer.Option(min=1, help="Maximum number of frames.")] = None,
    width: Annotated[
        int | None, typer.Option(min=16, help="Width of raw frames or a camera, pixels.")
    ] = None,
    height: Annotated[int | None, typer.Option(min=16, help="Height of the same, pixels.")] = None,
    pixel_format: Annotated[str | None, typer.Option(help="Pixel format: bgr24, gray8, YUYV…")] = None,
    save: Annotated[Path | None, typer.Option(help="Folder for annotated images.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object per frame.")] = False,
) -> None:
    """Print the markers in the frames of a source.

    With range, bearing, pose and their one-sigma errors. Directions and poses are in the body frame
    (forward, right, down), as the camera is mounted.
    """
    with gc_paused():
        from companion.markers import print_markers
        from vision.sources import SourceError, SourceSettings, open_source

    logging.basicConfig(level=logging.WARNING, format="companion: %(message)s", stream=sys.stderr)
    with plain_errors(ValueError):
        section = _section(settings.markers, dictionary, size)
        if settings.camera.on_gimbal:
            raise ValueError("camera.on_gimbal: without a vehicle the gimbal's attitude is unknown; unset it")
        reading = SourceSettings(width=width, height=height, pixel_format=pixel_format, every_frame=True)
    # ValueError: the lens is of images of another aspect.
    with plain_errors(SourceError, OSError, ValueError), open_source(source, reading) as frames:
        frames_read = print_markers(
            frames,
            settings.model_copy(update={"markers": section}),
            limit=limit,
            save=save,
            as_json=as_json,
            write=functools.partial(print, flush=True),
        )
    if not frames_read:
        typer.echo(f"companion: {source}: contains no frames", err=True)
        raise typer.Exit(EXIT_BAD_INPUT)


def _section(section: MarkersSection, dictionary: str | None, size_m: float | None) -> MarkersSection:
    """The settings with the options. Raises ValueError."""
    given = {"dictionary": dictionary, "size_m": size_m}
    section = section.model_copy(update={key: value for key, value in given.items() if value is not None})
    if section.kind() is None:
        raise ValueError(
            "no dictionary: give --dictionary, for example APRILTAG_36h11, or markers.dictionary"
        )
    return section
