"""The command line of `companion view`: the page of a source, or of a running service."""

from __future__ import annotations

import asyncio
import logging
import os
import re
import sys
import threading
import webbrowser
from collections.abc import Mapping
from contextlib import suppress
from typing import TYPE_CHECKING, Annotated

import typer

from companion.cli.download import Pull
from companion.cli.flags import plain_errors, refuse, vehicle_of
from companion.cli.run import after_pull, run_service

if TYPE_CHECKING:
    from companion.settings import Settings


def view(
    settings: Settings,
    given: Mapping[str, str],
    source: Annotated[
        str | None,
        typer.Argument(
            help="File, folder, /dev/video0, csi://0, FIFO, - (standard input) or URL. Without: the page "
            "of a running service."
        ),
    ] = None,
    pull: Pull = False,
) -> None:
    """Show a source, or a running service, live in the browser.

    A source is shown with its detections. It has no vehicle; the rest is as companion run: topics on zenoh,
    recording, several cameras. A file is repeated. Without SOURCE the page is that of the service which
    --connect reaches, at --dashboard-listen. Ctrl-C ends it.
    """
    from companion.settings.perception import NO_SOURCE
    from companion.settings.vehicle import NO_VEHICLE

    if not settings.dashboard.listen:
        refuse("dashboard.listen is empty: view shows the page; set it to HOST:PORT such as 127.0.0.1:8088")
    if "source.uri" in given:
        refuse("source.uri: view takes the source without a flag: companion view SOURCE")
    if source is None:
        if pull:
            refuse("--pull is for a source, and none is given: companion view SOURCE --pull")
        _serve_page(settings)
        return
    if "vehicle.url" in given:
        refuse("vehicle.url: view has no vehicle; use companion run --source SOURCE --vehicle-url URL")
    if source == NO_SOURCE:
        refuse("view none: expected a source to show")
    loop = settings.source.loop or ("source.loop" not in given and settings.source.depth is None)
    shown = settings.source.model_copy(update={"uri": source, "loop": loop})
    vehicle = settings.vehicle.model_copy(update={"url": NO_VEHICLE})
    settings = settings.model_copy(update={"source": shown, "vehicle": vehicle})
    run_service(after_pull(settings) if pull else settings, _open_page)


def _serve_page(settings: Settings) -> None:
    """Serve the page of a running service until Ctrl-C."""
    from companion.bus.client import NoAnswerError, client_settings, open_client
    from companion.bus.config import BusError
    from companion.dashboard.access import DashboardError
    from companion.dashboard.server import NICENESS, DashboardOptions, serve

    with plain_errors(NoAnswerError, DashboardError, BusError):
        zenoh, vehicle = client_settings(settings.zenoh), settings.vehicle.name
        # The page lists all vehicles and waits for the service: it needs neither.
        with suppress(NoAnswerError, ValueError), open_client(zenoh, timeout_s=0.0) as session:
            vehicle = vehicle_of(session, settings)
        options = DashboardOptions(
            settings.dashboard.listen,
            settings.dashboard.token_file,
            zenoh,
            vehicle,
            settings.language,
            settings.plugins.modules,
            settings.dashboard.hosts,
        )
        os.nice(NICENESS)
        try:
            asyncio.run(
                serve(options, lambda url: print(f"dashboard: {url}", flush=True), "--dashboard-listen")
            )
        except KeyboardInterrupt:
            return


def _open_page(line: str) -> None:
    """Open the page's address where there is a display; without one it was only printed."""
    logging.getLogger("companion").info("Ctrl-C ends it")
    has_display = sys.platform == "darwin" or "DISPLAY" in os.environ or "WAYLAND_DISPLAY" in os.environ
    if has_display and (address := re.search(r"http://\S+", line)) is not None:
        # It may wait for the browser.
        threading.Thread(target=webbrowser.open, args=(address[0],), name="browser", daemon=True).start()
