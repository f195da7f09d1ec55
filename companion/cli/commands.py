"""The command line: `companion view`, `run`, `play`, `detect`, `send`, `echo` and the others in ORDER.

Heavy modules are imported when their command runs, so that `companion send` starts quickly.
Invalid input prints one line on standard error and exits with code 2; a failed operation exits with code 1,
and `run` with 75 if another start may succeed.
"""

from __future__ import annotations

import json
import logging
import signal
import sys
from typing import TYPE_CHECKING, Annotated

import typer

from companion.cli.ask import ASK_SETTINGS, ask
from companion.cli.bench import bench
from companion.cli.calibrate import calibrate
from companion.cli.cameras import cameras, depth, preview
from companion.cli.client import echo, known_commands, send
from companion.cli.cloud import CLOUD_SETTINGS, cloud
from companion.cli.dashboard import dashboard
from companion.cli.demo import demo
from companion.cli.detect import detect
from companion.cli.evaluate import evaluate
from companion.cli.flags import EXIT_FAILED, CompanionCommands, plain_errors, settings_command
from companion.cli.markers import markers
from companion.cli.mcp import MCP_SETTINGS, mcp
from companion.cli.mission import mission
from companion.cli.models import models
from companion.cli.play import play
from companion.cli.recordings import RECORD_SETTINGS, collect, log, record, replay, sightings
from companion.cli.run import run
from companion.cli.topics import topics
from companion.cli.train import train
from companion.cli.train_policy import train_policy
from companion.cli.view import view
from companion.host.journal import is_journal, marked_for_journal, redact_last_resort
from vision.redaction import HIDDEN, print_traceback, redacted

if TYPE_CHECKING:
    from companion.settings import Settings

# Settings of a client of a running service.
CLIENT_SETTINGS = ("zenoh", "vehicle.name")
# Order of the commands in the help: by use.
ORDER = (
    "view",
    "play",
    "run",
    "demo",
    "detect",
    "send",
    "echo",
    "ask",
    "mcp",
    "cameras",
    "preview",
    "depth",
    "dashboard",
    "commands",
    "topics",
    "mission",
    "cloud",
    "record",
    "replay",
    "sightings",
    "config",
    "collect",
    "evaluate",
    "train",
    "train-policy",
)

app = typer.Typer(
    name="companion",
    cls=CompanionCommands,
    help="Companion-computer service for PX4 and ArduPilot: detection, offboard flight, zenoh.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

app.add_typer(models, name="models")
app.add_typer(calibrate, name="calibrate")
app.add_typer(markers, name="markers")
settings_command(app)(run)
settings_command(app)(view)
app.command()(demo)
app.command()(detect)
settings_command(app, *CLIENT_SETTINGS, epilog=known_commands)(send)
settings_command(app, *CLIENT_SETTINGS)(echo)
app.command()(evaluate)
app.command()(train)
app.command()(train_policy)
app.command()(topics)
app.command()(cameras)
settings_command(app, "source", "camera", "vehicle", "plugins")(preview)
settings_command(app, "source", "camera", "detector", "tracker", "vehicle.name", "plugins")(depth)
settings_command(app, *CLIENT_SETTINGS, "plugins", "detector")(mission)
settings_command(app, *CLOUD_SETTINGS)(cloud)
settings_command(app, *ASK_SETTINGS)(ask)
settings_command(app, *MCP_SETTINGS)(mcp)
settings_command(app)(play)
settings_command(app, *CLIENT_SETTINGS, "dashboard", "language", "plugins")(dashboard)
app.add_typer(bench, name="bench")
settings_command(app, *CLIENT_SETTINGS, *RECORD_SETTINGS)(record)
settings_command(app, "plugins")(replay)
app.command()(sightings)
settings_command(app, *CLIENT_SETTINGS)(collect)
app.add_typer(log, name="log")


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


@settings_command(app)
def config(
    settings: Settings,
    check: Annotated[
        bool,
        typer.Option("--check", help="Print only what is wrong: also key files, model, sources, folders."),
    ] = False,
) -> None:
    """Print the effective settings. The output is a TOML file with a comment on every key."""
    from companion.settings.reading import ConfigurationError, to_toml

    if check:
        from companion.cli.config_check import check_settings

        with plain_errors(ConfigurationError):
            for line in check_settings(settings):
                typer.echo(marked_for_journal(f"companion: {line}", logging.WARNING), err=True)
        return
    text = to_toml(settings)
    shown = redacted(text)
    if shown != text:
        typer.echo(f"companion: secrets in addresses are printed as {HIDDEN}", err=True)
    typer.echo(shown, nl=False)


@settings_command(app, "plugins")
def commands(
    settings: Settings,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON Schema.")] = False,
    as_markdown: Annotated[bool, typer.Option("--markdown", help="Print Markdown tables.")] = False,
) -> None:
    """List the flight commands. Prints arguments, units and ranges, including those of plug-ins."""
    from companion.guidance.grammar import describe, json_schema, markdown
    from companion.settings.plugins import PluginError, load_plugins

    with plain_errors(PluginError):
        load_plugins(settings.plugins.modules)
    text = json.dumps(json_schema(), indent=2) if as_json else markdown() if as_markdown else describe()
    typer.echo(text, nl=not as_markdown)


def _help_position(command: typer.models.CommandInfo) -> int:
    name = command.name or getattr(command.callback, "__name__", "")
    return ORDER.index(name) if name in ORDER else len(ORDER)


app.registered_commands.sort(key=_help_position)


def main() -> None:
    """Run the console script."""
    redact_last_resort()
    if is_journal(2):
        from companion.operator.line_output import use_for_standard_error

        use_for_standard_error()
    # End quietly when the reader of a pipe has gone (`| head`).
    if sys.argv[1:2] in (["detect"], ["echo"], ["preview"], ["depth"]):
        signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    try:
        app()
    except Exception:  # a bug: its traceback may have an address
        print_traceback()
        sys.exit(EXIT_FAILED)
