"""The command line of `companion markers`: `detect` (SOURCE) and `print`."""

from __future__ import annotations

import builtins
import functools
import logging
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from companion.cli.flags import EXIT_BAD_INPUT, check_folder, plain_errors, settings_command, with_default
from companion.host.journal import log_to_standard_error
from vision.gc_pause import gc_paused

if TYPE_CHECKING:
    from companion.settings import Settings
    from companion.settings.perception import MarkersSection

markers = typer.Typer(
    cls=with_default("detect"),
    help="Detect printed markers, or print them.\n\n"
    "`companion markers SOURCE` is `companion markers detect SOURCE`.",
    no_args_is_help=True,
)
_DICTIONARY = Annotated[
    str | None, typer.Option(help="Dictionary: 4X4_50, tag36h11. Default: markers.dictionary.")
]
_SIZE = Annotated[
    float | None, typer.Option(help="Side of the black square, metres. Default: markers.size_m.")
]


@settings_command(markers, "camera", "markers.others", "markers.boards_file", "markers.print")
def detect(
    settings: Settings,
    source: Annotated[
        str, typer.Argument(help="File, folder, /dev/video0, FIFO, - (standard input), shm:// or URL.")
    ],
    dictionary: _DICTIONARY = None,
    size: _SIZE = None,
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
        from companion.camera_tools.markers import print_markers
        from vision.sources import SourceError, SourceSettings, open_source

    log_to_standard_error(logging.WARNING, "companion: %(message)s")
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
            write=functools.partial(builtins.print, flush=True),
        )
    if not frames_read:
        typer.echo(f"companion: {source}: contains no frames", err=True)
        raise typer.Exit(EXIT_BAD_INPUT)


@settings_command(markers, "markers.others", "markers.boards_file", "markers.map_file", "markers.print")
def print(
    settings: Settings,
    identifiers: Annotated[str, typer.Argument(metavar="IDS", help="Ids of the markers: 0..9 or 3,7.")],
    dictionary: _DICTIONARY = None,
    size: _SIZE = None,
    paper: Annotated[
        str, typer.Option(help="A4, A3, A2, A1, A0, letter, or WIDTHxHEIGHT in millimetres.")
    ] = "A4",
    output: Annotated[Path, typer.Option("--output", "-o", help="PDF file to write.")] = Path("markers.pdf"),
) -> None:
    """Write printable sheets of markers.

    Each with an arrow to its upper edge, its dictionary, id and size. Print at 100 %, and measure the line at
    the foot of the page.
    """
    with gc_paused():
        from companion.simulation.campaign import numbers_of
        from vision.calibration.marker_sheets import marker_sheets, paper_of
        from vision.markers import markers_in

    with plain_errors(ValueError, OSError):
        check_folder(output)
        kind = _section(settings.markers, dictionary, size).kind()
        assert kind is not None
        wanted = numbers_of(identifiers, "ids", markers_in(kind.dictionary) - 1)
        output.write_bytes(marker_sheets(kind, wanted, paper_of(paper)))
    typer.echo(f"written: {output}, {len(wanted)} markers")


def _section(section: MarkersSection, dictionary: str | None, size_m: float | None) -> MarkersSection:
    """The settings with the options. Raises ValueError."""
    from vision.marker_dictionaries import dictionary_named

    given = {"dictionary": dictionary and dictionary_named(dictionary), "size_m": size_m}
    section = section.model_copy(update={key: value for key, value in given.items() if value is not None})
    if section.kind() is None:
        raise ValueError(
            "no dictionary: give --dictionary, for example APRILTAG_36h11, or markers.dictionary"
        )
    return section
