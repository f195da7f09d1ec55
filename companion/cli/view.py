"""The command line of `companion view`: the service without a vehicle, for its page."""

from __future__ import annotations

import logging
import os
import re
import sys
import threading
import webbrowser
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated

import typer

from companion.cli.download import Pull
from companion.cli.flags import EXIT_BAD_INPUT
from companion.cli.run import after_pull, run_service

if TYPE_CHECKING:
    from companion.settings import Settings


def view(
    settings: Settings,
    given: Mapping[str, str],
    source: Annotated[
        str, typer.Argument(help="File, folder, /dev/video0, csi://0, FIFO, - (standard input) or URL.")
    ],
    pull: Pull = False,
) -> None:
    """Show a source live in the browser, with its detections.

    Without a vehicle; the rest is as companion run: topics on zenoh, recording, several cameras. A file is
    repeated.
    """
    from companion.settings.perception import NO_SOURCE
    from companion.settings.vehicle import NO_VEHICLE

    if (refused := _refused(settings, given, is_none=source == NO_SOURCE)) is not None:
        typer.echo(f"companion: {refused}", err=True)
        raise typer.Exit(EXIT_BAD_INPUT)
    loop = settings.source.loop or ("source.loop" not in given and settings.source.depth is None)
    shown = settings.source.model_copy(update={"uri": source, "loop": loop})
    vehicle = settings.vehicle.model_copy(update={"url": NO_VEHICLE})
    settings = settings.model_copy(update={"source": shown, "vehicle": vehicle})
    run_service(after_pull(settings) if pull else settings, _open_page)


def _refused(settings: Settings, given: Mapping[str, str], *, is_none: bool) -> str | None:
    if "source.uri" in given:
        return "source.uri: view takes the source without a flag: companion view SOURCE"
    if "vehicle.url" in given:
        return "vehicle.url: view has no vehicle; use companion run --source SOURCE --vehicle-url URL"
    if is_none:
        return "view none: expected a source to show"
    if not settings.dashboard.listen:
        return "dashboard.listen is empty: view shows the page; set it to HOST:PORT such as 127.0.0.1:8088"
    return None


def _open_page(line: str) -> None:
    """Open the page's address where there is a display; without one it was only printed."""
    logging.getLogger("companion").info("Ctrl-C ends it")
    has_display = sys.platform == "darwin" or "DISPLAY" in os.environ or "WAYLAND_DISPLAY" in os.environ
    if has_display and (address := re.search(r"http://\S+", line)) is not None:
        # It may wait for the browser.
        threading.Thread(target=webbrowser.open, args=(address[0],), name="browser", daemon=True).start()
