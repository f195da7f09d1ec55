"""The command lines of `companion install` and `companion uninstall`."""

from __future__ import annotations

from typing import Annotated

import typer

from companion.cli.flags import EXIT_FAILED, plain_errors
from vision.redaction import redacted

User = Annotated[
    bool, typer.Option("--user", help="Of this user alone, without privileges: systemctl --user.")
]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Print every file and command, and change nothing.")]
Force = Annotated[bool, typer.Option("--force", help="Also while the vehicle is armed.")]


def install(user: User = False, dry_run: DryRun = False, force: Force = False) -> None:
    """Install the service of systemd, or update it.

    The environment that this is called from is /opt/companion/VERSION; the link /opt/companion/current leads
    to it. Another version's `companion install` moves the link and restarts the service; the old one's goes
    back. Settings are never changed. Exit code 0: the service is ready, or waits for the autopilot; 1: it
    says why not.
    """
    from companion.setup.install import install as set_up
    from companion.setup.systemctl import Host, SetupError

    with plain_errors(SetupError, OSError, code=EXIT_FAILED):
        up = set_up(Host(user), _say, dry_run=dry_run, force=force)
    raise typer.Exit(0 if up else EXIT_FAILED)


def uninstall(
    user: User = False,
    purge: Annotated[
        bool,
        typer.Option(
            "--purge", help="Also the system's settings, recordings, models, and the user companion."
        ),
    ] = False,
    dry_run: DryRun = False,
    force: Force = False,
) -> None:
    """Remove the service of systemd.

    What is kept is printed, with the line that removes it.
    """
    from companion.setup.systemctl import Host, SetupError
    from companion.setup.uninstall import uninstall as remove

    with plain_errors(SetupError, OSError, code=EXIT_FAILED):
        remove(Host(user), _say, purge=purge, dry_run=dry_run, force=force)


def _say(line: str) -> None:
    typer.echo(redacted(line))
