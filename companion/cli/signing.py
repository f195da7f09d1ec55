"""The command line of `companion signing new|send`: MAVLink 2 signing keys."""

from __future__ import annotations

import asyncio
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from companion.cli.flags import EXIT_FAILED, Command, is_terminal, plain_errors, refuse, settings_command

if TYPE_CHECKING:
    from companion.settings import Settings

signing = typer.Typer(
    help="Make a MAVLink 2 signing key, and give it to the autopilot.", no_args_is_help=True
)


@signing.command("new", cls=Command)
def new_key(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Of the key. It must not exist.")],
) -> None:
    """Make a signing key: a random passphrase in a file that only its owner can read.

    Ground stations take the same text: its SHA-256 is the key.
    """
    from companion.vehicle.signing import SigningKeyError, write_new_key

    with plain_errors(SigningKeyError):
        write_new_key(file)
    typer.echo(f"{file}: a new key. Next: companion signing send --key-file {shlex.quote(str(file))}")


@settings_command(signing, "vehicle.url", "vehicle.system_id")
def send(
    settings: Settings,
    key_file: Annotated[
        Path | None, typer.Option(help="Of the key. Default: vehicle.signing_key_file.")
    ] = None,
    present_key_file: Annotated[
        Path | None, typer.Option(help="Of the key that the autopilot has, if it refuses what is unsigned.")
    ] = None,
    off: Annotated[bool, typer.Option("--off", help="Remove the autopilot's key: signing ends.")] = False,
    yes: Annotated[bool, typer.Option("--yes", help="The link is a wire: do not ask.")] = False,
) -> None:
    """Give the disarmed autopilot a signing key, and check that it signs and answers what is signed.

    The key travels as it is: use USB or the wire to the autopilot, no radio and no network. PX4 takes a key
    by its USB port alone, from 1.17 on. The service must not have the link open. Exit code 1: it has not
    taken it.
    """
    from companion.doctor.examine import link_holders
    from companion.doctor.facts import Facts, Machine
    from companion.doctor.processes import listed
    from companion.host.state_folder import state_folder
    from companion.settings.fields import toml_value
    from companion.vehicle.driver import LinkError
    from companion.vehicle.kept_timestamp import KeptTimestamp
    from companion.vehicle.link_url import parse_link_url
    from companion.vehicle.signing import SigningKeyError, read_key
    from companion.vehicle.signing_setup import set_up_signing
    from companion.vehicle.vehicle_type import PX4, autopilot_text

    path = key_file or settings.vehicle.signing_key_file
    if off and key_file is not None:
        refuse("--off and --key-file were given: --off needs --present-key-file alone, if any")
    if not off and path is None:
        refuse(
            "no key: give --key-file FILE, or set vehicle.signing_key_file; companion signing new makes one"
        )
    if not settings.vehicle.expected:
        refuse("vehicle.url is none: give --vehicle-url")
    with plain_errors(SigningKeyError, LinkError):
        key = None if off or path is None else read_key(path)
        present = None if present_key_file is None else read_key(present_key_file)
        url = parse_link_url(settings.vehicle.url)
        if holders := link_holders(Facts(settings, Machine())):
            lines = "; ".join(dict.fromkeys(each.stopping for each in holders))
            refuse(f"{url} is in use by {listed(holders)}. Stop it, on the ground: {lines}")
        if not yes:
            _confirm(
                f"{url}: the key travels as it is. Is this a wire to the autopilot, no radio and no network?"
            )
        kept = KeptTimestamp(state_folder())
    with plain_errors(LinkError, code=EXIT_FAILED):
        found = asyncio.run(
            set_up_signing(url, key, system_id=settings.vehicle.system_id, present_key=present, kept=kept)
        )
    kept.flush()
    name = f"system {found.system_id}, {autopilot_text(found.autopilot)}"
    if off:
        typer.echo(f"{name}: signing is off")
        return
    typer.echo(f"{name}: signs with this key, and answers what is signed with it")
    if found.autopilot == PX4:
        typer.echo("restart it: its other ports read the key when they start")
    if found.takes_unsigned:
        advice = (
            "set MAV_SIGN_CFG 2 (1: all but USB) to refuse it"
            if found.autopilot == PX4
            else "ArduPilot takes it by its first serial port, USB, and refuses it by the others"
        )
        typer.echo(f"it takes what is unsigned on this link too: {advice}")
    if settings.vehicle.signing_key_file is None:
        typer.echo(f"next: set vehicle.signing_key_file = {toml_value(str(Path(path or '').absolute()))}")


def _confirm(question: str) -> None:
    if not is_terminal(sys.stdin):
        refuse(f"{question} Then give --yes")
    if not typer.confirm(question, default=False):
        raise typer.Exit(EXIT_FAILED)
