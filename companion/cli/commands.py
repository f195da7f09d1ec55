"""The command line: `companion view`, `play`, `run`, `detect`, `send`, `echo` and the others.

Heavy modules are imported when their command runs, so that `companion send` starts quickly.
Invalid input prints one line on standard error and exits with code 2; a failed operation exits with code 1,
and `run` with 75 if another start may succeed.
"""

from __future__ import annotations

import signal
import sys
from typing import Annotated

import typer

from companion.cli.ask import ASK_SETTINGS, ask
from companion.cli.bench import bench
from companion.cli.calibrate import calibrate
from companion.cli.client import echo, known_commands, send
from companion.cli.console import console
from companion.cli.demo import demo
from companion.cli.describe import describe
from companion.cli.detect import DETECT_SETTINGS, detect
from companion.cli.doctor import doctor, status
from companion.cli.flags import CLIENT_SETTINGS, EXIT_FAILED, Command, CompanionCommands, settings_command
from companion.cli.init import init
from companion.cli.install import install, uninstall
from companion.cli.learn import learn
from companion.cli.log import log
from companion.cli.markers import MARKER_SETTINGS, markers
from companion.cli.mcp import MCP_SETTINGS, mcp
from companion.cli.models import models
from companion.cli.play import play
from companion.cli.ros2 import ros2
from companion.cli.run import run
from companion.cli.signing import signing
from companion.cli.view import view
from companion.host.journal import is_journal, redact_last_resort
from vision.redaction import print_traceback

app = typer.Typer(
    name="companion",
    cls=CompanionCommands,
    help="Companion-computer service for PX4 and ArduPilot: detection, offboard flight, zenoh.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

# In the order of the help: by use.
settings_command(app)(view)
settings_command(app, only_config=True)(play)
settings_command(app)(run)
app.command(cls=Command)(demo)
settings_command(app, *DETECT_SETTINGS, optional_values=("--markers",))(detect)
settings_command(app, *CLIENT_SETTINGS, "plugins", "detector", epilog=known_commands)(send)
settings_command(app, *ASK_SETTINGS)(console)
settings_command(app, *CLIENT_SETTINGS)(echo)
app.command(cls=Command)(init)
settings_command(app, *CLIENT_SETTINGS)(status)
settings_command(app)(doctor)
app.command(cls=Command)(install)
app.command(cls=Command)(uninstall)
settings_command(app, *ASK_SETTINGS)(ask)
settings_command(app, *MCP_SETTINGS)(mcp)
settings_command(app)(describe)
settings_command(app, *MARKER_SETTINGS)(markers)
for name, group in (
    ("log", log),
    ("learn", learn),
    ("models", models),
    ("calibrate", calibrate),
    ("signing", signing),
    ("bench", bench),
    ("ros2", ros2),
):
    app.add_typer(group, name=name)


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(f"companion {version('mavlink-companion')}")
        raise typer.Exit


@app.callback()
def every_command(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version."),
    ] = False,
) -> None:
    """Options of every command."""


def main() -> None:
    """Run the console script."""
    redact_last_resort()
    if is_journal(2):
        from companion.operator.line_output import use_for_standard_error

        use_for_standard_error()
    # End quietly when the reader of a pipe has gone (`| head`).
    if sys.argv[1:2] in (["detect"], ["echo"]):
        signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    try:
        app()
    except Exception:  # a bug: its traceback may have an address
        print_traceback()
        sys.exit(EXIT_FAILED)
