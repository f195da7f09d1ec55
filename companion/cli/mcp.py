"""The command line of `companion mcp`."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from companion.cli.flags import CLIENT_SETTINGS, named_vehicle, plain_errors, say_vehicle

if TYPE_CHECKING:
    from companion.dashboard.access import Access
    from companion.settings import Settings

MCP_SETTINGS = (*CLIENT_SETTINGS, "plugins")


def mcp(
    settings: Settings,
    allow: Annotated[
        str,
        typer.Option(
            help="Commands that may be executed, such as takeoff,land. Default: none; stop and hold only end "
            "a command that this server started."
        ),
    ] = "",
    listen: Annotated[
        str | None,
        typer.Option(help="HOST:PORT of this computer, for HTTP. Default: standard input and output."),
    ] = None,
    token_file: Annotated[
        Path | None, typer.Option(help="File with the token of the clients; required with --listen.")
    ] = None,
) -> None:
    """Serve commands and state to language models (MCP).

    Nobody confirms: only the commands of --allow are executed. Without it, `stop` and `hold` are sent only
    while a command that this server started is active; they end it. After a pilot took over, nothing is
    executed until an operator has commanded in another way, or this server is restarted.
    """
    import mcp.server  # noqa: F401 - before anything is read: it is of an extra

    from companion.bus.client import NoAnswerError
    from companion.bus.session import BusError
    from companion.dashboard.access import DashboardError
    from companion.language.tools import check_words
    from companion.settings.plugins import PluginError, load_plugins

    with plain_errors(NoAnswerError, BusError, DashboardError, PluginError, ValueError):
        load_plugins(settings.plugins.modules)
        allowed = [word.strip() for word in allow.split(",") if word.strip()]
        check_words("--allow", allowed, for_models=True)
        access = None if listen is None else _access(listen, token_file)
        try:
            asyncio.run(_serve(settings, allowed, listen, access))
        except KeyboardInterrupt:
            return


def _access(listen: str, token_file: Path | None) -> Access:
    """Who may use HTTP. Raises DashboardError."""
    from companion.dashboard.access import Access, DashboardError, read_token
    from companion.dashboard.server import split_listen
    from companion.settings.key_files import is_loopback

    host, _ = split_listen(listen, "--listen")
    if not is_loopback(host):
        raise DashboardError(
            f"--listen {listen}: expected an address of this computer, such as 127.0.0.1:8089"
        )
    if token_file is None:
        raise DashboardError(
            "--listen needs --token-file FILE; make one: (umask 77; openssl rand -hex 16 > FILE)"
        )
    return Access(host, read_token(token_file, "--token-file"), page=False)


async def _serve(settings: Settings, allowed: list[str], listen: str | None, access: Access | None) -> None:
    from companion.bus.client import client_settings
    from companion.client import connect as connect_to
    from companion.dashboard.server import Guard, http_server, listening_socket, split_listen
    from companion.language.live import LiveVehicle
    from companion.language.mcp_server import PATH, FlightTools, http_app, serve_stdio, server_of

    where = client_settings(settings.zenoh).connect[0]
    name, file = named_vehicle(settings), settings.zenoh.config_file
    async with connect_to(where, name, config_file=file) as drone:
        say_vehicle(settings, drone.name)
        camera = (await drone.query("config"))["guidance"]["camera"]
        vehicle = LiveVehicle(drone, (), camera)
        await vehicle.forget_loss()  # an operator starts this program
        tools = FlightTools(vehicle, lambda: drone.query("commands"), allowed)
        server = server_of(tools)
        try:
            if listen is None or access is None:
                await serve_stdio(server)
                return
            host, port = split_listen(listen)
            with listening_socket(host, port, "--listen") as listener:
                async with http_app(server) as application:
                    print(f"mcp: http://{host}:{port}{PATH}", flush=True)
                    await http_server(Guard(application, access)).serve(sockets=[listener])
        finally:
            await tools.close()
