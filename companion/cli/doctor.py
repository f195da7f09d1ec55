"""The command lines of `companion doctor` and `companion status`."""

from __future__ import annotations

import json
import os
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from companion.cli.flags import EXIT_FAILED, AsJson, is_terminal, named_vehicle, plain_errors, vehicle_of
from vision.redaction import redacted

if TYPE_CHECKING:
    from companion.doctor.facts import Service
    from companion.settings import Settings
    from companion.settings.layers import LayeredSettings, SettingsFiles

_WIDTH = 80
_COLOURS = {"fault": "red", "error": "red", "warning": "yellow"}
_REDRAW_S = 1.0
_CLEAR = "\x1b[H\x1b[2J"


def doctor(
    read_settings: Callable[[], LayeredSettings], layer_files: SettingsFiles, as_json: AsJson = False
) -> None:
    """Find faults of link, ports, camera, model and board.

    Give it the settings of the service. A running service is asked, and nothing of its own is opened. Without
    one the link is listened to for 2 s and cameras are opened for a moment; nothing is sent.
    Exit code 0: sound; 1: warnings; 2: faults.
    """
    from companion.cli.config_check import check_settings
    from companion.doctor.check import exit_code
    from companion.doctor.examine import examine
    from companion.doctor.screens import doctor_lines
    from companion.settings.reading import ConfigurationError

    wrong: Sequence[str] = ()
    missing: Sequence[str] = ()
    settings = None
    try:
        settings = read_settings().settings
        missing = check_settings(settings)
    except ConfigurationError as error:
        wrong = error.problems
    named = None if settings is None else named_vehicle(settings)
    checks = examine(settings, named, wrong=wrong, missing=missing, files=layer_files)
    if as_json:
        typer.echo(redacted(json.dumps([asdict(check) for check in checks], indent=2, ensure_ascii=False)))
    else:
        _print(doctor_lines(checks, _width()))
    raise typer.Exit(exit_code(checks))


def status(
    settings: Settings,
    watch: Annotated[bool, typer.Option("--watch", help="Once a second, until Ctrl-C.")] = False,
) -> None:
    """Print the state of a running service on one screen.

    Exit code 0: it is healthy; 1: it is not, or there is none. `companion echo status` prints all of it.
    """
    from companion.bus.client import SILENT_S, NoAnswerError, client_settings, open_client
    from companion.bus.session import BusError
    from companion.doctor.service_query import ServiceWatch, settings_of

    with (
        plain_errors(NoAnswerError, BusError, ValueError, code=EXIT_FAILED),
        open_client(client_settings(settings.zenoh)) as session,
        ServiceWatch(session, vehicle_of(session, settings), here=True) as watched,
    ):
        own = settings_of(session, watched.vehicle)
        service = watched.now()
        try:
            service = watched.collect()
            _print(_screen(service, own))
            while watch:
                time.sleep(_REDRAW_S)
                service = watched.now()
                lines = list(_screen(service, own))
                if (silent_s := watched.silent_s) is None or silent_s > SILENT_S:
                    lines.insert(0, f"error    no status for {silent_s or 0:.0f} s: what follows is old")
                if is_terminal(sys.stdout):
                    typer.echo(_CLEAR, nl=False)
                _print(lines)
        except KeyboardInterrupt:
            service = watched.now()
    newest = service.status
    raise typer.Exit(0 if newest is not None and newest["healthy"] else EXIT_FAILED)


def _screen(service: Service, own: Settings | None) -> Iterable[str]:
    from companion.doctor.check import worst_first
    from companion.doctor.facts import Facts, Machine, checks_of
    from companion.doctor.running import CHECKS
    from companion.doctor.screens import status_lines
    from companion.settings import Settings as AllSettings

    facts = Facts(own or AllSettings(), Machine(), service, settings_known=own is not None)
    return status_lines(facts, worst_first(checks_of(facts, CHECKS)), _width())


def _width() -> int:
    return shutil.get_terminal_size((_WIDTH, 24)).columns if is_terminal(sys.stdout) else _WIDTH


def _print(lines: Iterable[str]) -> None:
    """Print lines; in colour on a terminal, by their first word."""
    colours = is_terminal(sys.stdout) and "NO_COLOR" not in os.environ
    for line in lines:
        word = line.partition(" ")[0]
        if colours and word in _COLOURS:
            line = typer.style(word, fg=_COLOURS[word], bold=True) + line[len(word) :]
        typer.echo(redacted(line))
