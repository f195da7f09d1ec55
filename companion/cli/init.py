"""The command line of `companion init`."""

from __future__ import annotations

import os
import shlex
import shutil
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from companion.cli.flags import EXIT_BAD_INPUT, EXIT_FAILED, is_terminal, plain_errors, refuse
from vision.redaction import redacted

if TYPE_CHECKING:
    from companion.setup.init import Asking
    from companion.setup.target import Target

_WIDTH = 80


def init(
    yes: Annotated[bool, typer.Option("--yes", help="Ask nothing: take the surest, and say so.")] = False,
    output: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Settings file. Default: the user's; the system's for root."),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print what would be written, and write nothing.")
    ] = False,
    serial: Annotated[
        list[Path] | None,
        typer.Option("--serial", metavar="DEVICE", help="Look at this serial device too; may be repeated."),
    ] = None,
) -> None:
    """Find autopilot, cameras, runtime, and write the settings.

    Only what differs from the defaults is written. It listens, and sends nothing to the autopilot; what
    another program has open is left alone. A file that is there is kept under a name with the time.
    Exit code 1: no autopilot was found.
    """
    if not yes and not (is_terminal(sys.stdin) and is_terminal(sys.stdout)):
        refuse("init asks, and this is no terminal: add --yes, which takes the surest")
    from companion.doctor.facts import Facts, Machine
    from companion.doctor.service_query import find_service
    from companion.settings.reading import ConfigurationError
    from companion.setup.init import propose
    from companion.setup.settings_file import MergeError, merged
    from companion.setup.target import default_target, read_target

    path = output if output is not None else default_target()
    with plain_errors(ConfigurationError):
        target = read_target(path)
    if not dry_run:
        _check_writable(path)
    began_s = time.monotonic()
    settings = target.settings
    found = find_service(settings.zenoh, None)
    service = found.service if found.service is not None and found.service.here else None
    proposal = propose(
        target,
        Facts(settings, Machine()),
        _asking(yes=yes),
        service=service,
        service_settings=found.settings,
        devices=serial or (),
    )
    with plain_errors(MergeError):
        text = merged(target.text, proposal.changes)
    if text != target.text:
        _finish(target, text, yes=yes, dry_run=dry_run)
    elif text:
        typer.echo(f"{path} stays as it is")
    elif proposal.has_autopilot:
        typer.echo("the defaults fit: no settings file is needed")
    typer.echo(f"{time.monotonic() - began_s:.1f} s")
    if not proposal.has_autopilot:
        typer.echo(
            "companion: no autopilot found: see above, mend it, and run companion init again", err=True
        )
        raise typer.Exit(EXIT_FAILED)
    if not text or path.resolve() == default_target().resolve():
        user = "" if os.geteuid() == 0 else " --user"
        typer.echo(f"next: companion doctor; companion run, or companion install{user}")
    else:
        given = f"--config {shlex.quote(str(path))}"
        typer.echo(f"next: companion doctor {given}; companion run {given}")


def _finish(target: Target, text: str, *, yes: bool, dry_run: bool) -> None:
    """Show the changes and write them."""
    from companion.settings.reading import ConfigurationError
    from companion.setup.settings_file import difference, write
    from companion.setup.target import check_text

    path = target.path
    with plain_errors(ConfigurationError, OSError):
        check_text(path, text)
    for line in difference(target.text, text, path):
        typer.echo(redacted(line))
    if dry_run:
        typer.echo(f"{path} is not written: --dry-run")
        return
    if not yes and not typer.confirm(f"write {path}?", default=True):
        raise typer.Exit(EXIT_FAILED)
    with plain_errors(OSError, code=EXIT_FAILED):
        kept = write(path, text)
    typer.echo(f"written: {path}" + (f"; before: {kept}" if kept is not None else ""))


def _asking(*, yes: bool) -> Asking:
    from companion.setup.init import Asking
    from companion.setup.tried import Tried

    width = shutil.get_terminal_size((_WIDTH, 24)).columns if is_terminal(sys.stdout) else _WIDTH

    def say(line: str) -> None:
        typer.echo(redacted(line))

    def report(tried: Tried) -> None:  # also from threads
        typer.echo(redacted("\n".join(tried.lines(width))))

    def choose(what: str, choices: Sequence[str]) -> int:
        for number, choice in enumerate(choices, 1):
            say(f"  {number}  {choice}")
        if yes:
            say(f"{what}: --yes takes 1")
            return 0
        while True:
            number = typer.prompt(f"which {what}?", default=1, type=int)
            if 1 <= number <= len(choices):
                return int(number) - 1
            say(f"1 to {len(choices)}")

    return Asking(choose, say, report)


def _check_writable(path: Path) -> None:
    """Refuse a file that could not be replaced: that needs its folder, or one above it."""
    place = next(each for each in path.resolve().parents if each.exists())
    if not os.access(place, os.W_OK | os.X_OK) or not place.is_dir():
        typer.echo(f"companion: {path}: this user may not write {place}; give another --output", err=True)
        raise typer.Exit(EXIT_BAD_INPUT)
