"""Removes what `install` wrote. Settings and recordings are kept unless they are to go too."""

from __future__ import annotations

import os
import pwd
import shlex
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

from companion.host.state_folder import state_folder
from companion.settings.layers import SYSTEM_FILE, user_file
from companion.settings.reading import ConfigurationError
from companion.setup.files import (
    INSTALLATIONS,
    RULES,
    SYSTEM_UNITS,
    SYSUSERS,
    UNIT,
    Entry,
    below,
    system_entries,
    user_entries,
    user_units,
)
from companion.setup.flight import check_not_flying, settings_of_unit
from companion.setup.install import terminals
from companion.setup.systemctl import Host, SetupError, as_root

USER = "companion"
STATE, CACHE = Path("/var/lib/companion"), Path("/var/cache/companion")
# Deepest first: each is removed where nothing is in it.
_FOLDERS = (STATE / "models", STATE, CACHE, SYSTEM_FILE.parent, SYSUSERS.parent)


def uninstall(
    host: Host,
    say: Callable[[str], None],
    *,
    purge: bool = False,
    dry_run: bool = False,
    force: bool = False,
) -> None:
    """Stop the service and remove its files.

    Args:
        say: prints a line. purge: also settings, recordings, models, caches, and the user `companion`, of a
            service of the system.
        dry_run: print what would be done, and change nothing. force: also while the vehicle is armed.

    Raises:
        SetupError: it cannot be removed now, or by this user.
    """
    if purge and host.user:
        raise SetupError(
            "--purge is for the service of the system; without it the lines for yours are printed"
        )
    if not dry_run:
        if not host.user and os.geteuid() != 0:
            raise SetupError(f"this needs root: {as_root('uninstall')}")
        host.check_manager()
        if not force:
            check_not_flying(host)

    def do(words: tuple[str, ...]) -> None:
        say(f"run        {shlex.join(words)}")
        if not dry_run:
            host.run(words)

    def remove(path: Path) -> None:
        say(f"remove     {path}")
        if dry_run:
            return
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()

    entries: tuple[Entry, ...] = user_entries() if host.user else system_entries(Path(sys.prefix), host.root)
    disabled = list(_disabled_terminals(host))
    there = [entry.path for entry in entries if entry.found() is not None]
    if entries[0].path in there:  # the unit
        do(host.systemctl("disable", "--now", *host.units()))
    for path in there:
        remove(path)
    do(host.systemctl("daemon-reload"))
    if below(host.root, RULES) in there and below(host.root, Path("/run/udev/control")).exists():
        do(("udevadm", "control", "--reload"))
    if host.user:
        folders: tuple[Path, ...] = (user_units(), user_units().parent)
    else:
        if purge:
            for folder in (STATE, CACHE, SYSTEM_FILE.parent):
                if (path := below(host.root, folder)).is_dir():
                    remove(path)
            if _has_user():
                do(("userdel", USER))
        folders = tuple(below(host.root, folder) for folder in _FOLDERS)
    for folder in folders:
        if folder.is_dir() and not any(folder.iterdir()):
            remove(folder)
    for line in _kept_of_user() if host.user else _kept(host, disabled, purge=purge):
        say(line)


def _disabled_terminals(host: Host) -> Iterator[str]:
    """Yield the login terminals that `install` may have disabled."""
    if host.user:
        return
    try:
        settings = settings_of_unit(host, UNIT)
    except (ConfigurationError, OSError):
        return
    for unit in terminals(host, settings):
        if host.show(unit).get("UnitFileState") == "disabled":
            yield unit


def _kept(host: Host, disabled: list[str], *, purge: bool) -> Iterator[str]:
    """Yield what is left, and the line that removes it."""
    if not purge:
        there = [
            str(folder) for folder in (SYSTEM_FILE.parent, STATE, CACHE) if below(host.root, folder).is_dir()
        ]
        users = [f"user {USER}"] if _has_user() else []
        if kept := [*there, *users]:
            yield f"kept       {', '.join(kept)}: uninstall --purge removes them"
    for folder in below(host.root, SYSTEM_UNITS).glob("companion*.service.d"):
        yield f"kept       {folder}: your own changes of the unit: {_removing('sudo', folder)}"
    environments = below(host.root, INSTALLATIONS)
    if environments.is_dir():
        for folder in sorted(environments.iterdir()):
            yield f"kept       {folder}: {_removing('sudo', folder)}"
    for unit in disabled:
        yield f"kept       {unit} is disabled: sudo systemctl enable --now {unit}"


def _kept_of_user() -> Iterator[str]:
    for what, folder in (("settings", user_file().parent), ("state", state_folder())):
        if folder.is_dir():
            yield f"kept       {folder}: {what}: {_removing(folder)}"
    for folder in user_units().glob("companion*.service.d"):
        yield f"kept       {folder}: your own changes of the unit: {_removing(folder)}"


def _removing(*words: str | Path) -> str:
    *before, folder = map(str, words)
    return shlex.join((*before, "rm", "-r", folder))


def _has_user() -> bool:
    """Whether there is the user that sysusers.d(5) has made, and no person's of that name."""
    try:
        return pwd.getpwnam(USER).pw_dir == str(STATE)
    except KeyError:
        return False
