"""The command line of `companion markers`: sheets of markers to print."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from companion.cli.flags import check_folder, plain_errors
from vision.gc_pause import gc_paused

if TYPE_CHECKING:
    from companion.settings import Settings
    from companion.settings.perception import MarkersSection

_DICTIONARY = Annotated[
    str | None, typer.Option(help="Dictionary: 4X4_50, tag36h11. Default: markers.dictionary.")
]
_SIZE = Annotated[
    float | None, typer.Option(help="Side of the black square, metres. Default: markers.size_m.")
]


MARKER_SETTINGS = ("markers.others", "markers.boards_file", "markers.map_file", "markers.print")


def markers(
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
        if not re.match(r"\d", identifiers):
            raise ValueError(
                f"IDS must be numbers such as 0..9 or 3,7, got {identifiers!r}; markers in the images of a "
                "source: companion detect SOURCE --model none --markers"
            )
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
