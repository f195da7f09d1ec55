"""The command line of `companion dashboard`."""

from __future__ import annotations

import asyncio
import os
from typing import TYPE_CHECKING, Annotated

import typer

from companion.cli.flags import EXIT_BAD_INPUT, plain_errors

if TYPE_CHECKING:
    from companion.settings import Settings


def dashboard(
    settings: Settings,
    connect: Annotated[str | None, typer.Option(help="Zenoh endpoint of the service or its router.")] = None,
    listen: Annotated[
        str | None, typer.Option(help="HOST:PORT of the page. Default: 127.0.0.1:8088.")
    ] = None,
) -> None:
    """Serve the web page of a running service. Ends on Ctrl-C."""
    from companion.bus.client import NoAnswerError, client_settings
    from companion.bus.config import BusError
    from companion.dashboard.access import DashboardError
    from companion.dashboard.server import NICENESS, DashboardOptions, serve

    address = settings.dashboard.listen if listen is None else listen
    if not address:
        typer.echo("companion: dashboard.listen is empty: set --listen to HOST:PORT", err=True)
        raise typer.Exit(EXIT_BAD_INPUT)
    with plain_errors(NoAnswerError, DashboardError, BusError):
        zenoh = client_settings(settings.zenoh, (connect,) if connect else ())
        options = DashboardOptions(
            address,
            settings.dashboard.token_file,
            zenoh,
            settings.vehicle.name,
            settings.language,
            settings.plugins.modules,
        )
        os.nice(NICENESS)
        try:
            asyncio.run(serve(options, lambda url: print(f"dashboard: {url}", flush=True), "--listen"))
        except KeyboardInterrupt:
            return
