"""Removes what `install` wrote. Settings and recordings are kept unless they are to go too."""

from __future__ import annotations

import os
import pwd
import shlex
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

from companion.settings.layers import SYSTEM_FILE
from companion.settings.reading import ConfigurationError
from companion.setup.files import (
    INSTALLATIONS,
    RULES,
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
from companion.setup.systemctl import Host, SetupError

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
        say: prints a line. purge: also settings, recordings, models, caches, and the user `companion`.
        dry_run: print what would be done, and change nothing. force: also while the vehicle is armed.

    Raises:
        SetupError: it cannot be removed now, or by this user.
    """
    if not dry_run:
        if not host.user and os.geteuid() != 0:
            raise SetupError(f"this needs root: sudo {sys.argv[0]} uninstall")
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
    if host.user:
        return
    for line in _kept(host, disabled, purge=purge):
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
    drop_ins = below(host.root, Path("/etc/systemd/system")).glob("companion*.service.d")
    for folder in drop_ins:
        yield f"kept       {folder}: your own changes of the unit"
    environments = below(host.root, INSTALLATIONS)
    if environments.is_dir():
        for folder in sorted(environments.iterdir()):
            yield f"kept       {folder}: sudo rm -r {folder}"
    for unit in disabled:
        yield f"kept       {unit} is disabled: sudo systemctl enable --now {unit}"


def _has_user() -> bool:
    try:
        pwd.getpwnam(USER)
    except KeyError:
        return False
    return True
