"""Where settings come from: defaults, the files of system, user and `--config`, the environment, flags.

The later takes precedence, key by key; a list is replaced whole. A table `[cameras.NAME]` is merged with the
one of that name. A file that stands twice, by two names too, is one layer.
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from vision.home import home_folder

if TYPE_CHECKING:
    from companion.settings.settings import Settings

SYSTEM_FILE = Path("/etc/companion/companion.toml")
"""The settings of this computer."""
SYSTEM_VARIABLE = "COMPANION_SYSTEM_FILE"
"""The variable that has another path for it."""
_FORMER_FILE = "companion.toml"  # of the working folder, read until version 0.1


def system_file() -> Path:
    """Return where the computer's settings are read, whether or not there is a file."""
    return Path(os.environ.get(SYSTEM_VARIABLE) or SYSTEM_FILE)


def user_file() -> Path:
    """Return where the user's settings are, whether or not there is a file.

    `$XDG_CONFIG_HOME/companion/companion.toml`, or below `~/.config` where that is unset or relative, by the
    XDG Base Directory Specification 0.8.
    """
    base = Path(os.environ.get("XDG_CONFIG_HOME", ""))
    return (base if base.is_absolute() else home_folder() / ".config") / "companion" / "companion.toml"


class NotRead(NamedTuple):
    """A file that is there and is not read: `found` says why, `advice` what to do."""

    found: str
    advice: str


class SettingsFiles(NamedTuple):
    """The files in force.

    Attributes:
        files: the later takes precedence.
    """

    files: tuple[Path, ...] = ()
    not_read: tuple[NotRead, ...] = ()


NO_FILES = SettingsFiles()


def settings_files(config: Path | None = None, *, only_config: bool = False) -> SettingsFiles:
    """Find the files of settings, each once.

    A file that is there and cannot be read is among them: reading it is an error. Left out are a user's file
    in a home that is hidden, as by ProtectHome= of systemd, and one that belongs to another user.

    Args:
        config: the file of `--config`, which need not exist; `/dev/null`: no file at all is read.
        only_config: without the files of system and user.
    """
    if config is not None and os.path.realpath(config) == os.devnull:
        return NO_FILES
    files: list[Path] = []
    not_read: list[NotRead] = []
    if not only_config:
        files += [path] if _is_there(path := system_file(), hidden=True) else []
        user = user_file()
        if _is_there(user, hidden=False):
            if (owner := _other_owner(user)) is None:
                files.append(user)
            elif config is None or os.path.realpath(config) != os.path.realpath(user):
                found = f"{user} is not read: it belongs to {owner}"
                not_read.append(NotRead(found, f"--config {shlex.quote(str(user))} reads it"))
    if config is not None:
        files.append(config)
    # At its last place: there it decides.
    last = {os.path.realpath(path): index for index, path in enumerate(files)}
    files = [files[index] for index in sorted(last.values())]
    if config is None and os.path.isfile(_FORMER_FILE) and os.path.realpath(_FORMER_FILE) not in last:
        move = "" if only_config else f", or move it to {user_file()}"
        found = f"{os.path.abspath(_FORMER_FILE)} is not read"
        not_read.append(NotRead(found, f"give --config {_FORMER_FILE}{move}"))
    return SettingsFiles(tuple(files), tuple(not_read))


def _is_there(path: Path, *, hidden: bool) -> bool:
    """Whether there is a file. `hidden`: what is returned where a folder above it may not be searched."""
    try:
        path.lstat()
    except (FileNotFoundError, NotADirectoryError):
        return False
    except PermissionError:
        return hidden
    except OSError:
        return True
    return True


def _other_owner(path: Path) -> int | str | None:
    """Return who owns a file, if it is neither this user nor root; a root service reads no user's file."""
    try:
        uid = path.stat().st_uid
    except OSError:
        return None  # reading it says why
    if uid in (0, os.geteuid()):
        return None
    try:
        return path.owner()
    except KeyError:
        return uid


class Origin(NamedTuple):
    """Where a value was given, printed as the end of a message: `in FILE, line 3`, `given as VARIABLE`.

    Attributes:
        name: the file or the variable; else as it is printed.
    """

    kind: Literal["file", "variable", "flag", "other"]
    name: str
    line: int | None = None

    def __str__(self) -> str:
        if self.kind == "file":
            return f"in {self.name}" + ("" if self.line is None else f", line {self.line}")
        return f"given as {self.name}" if self.kind in ("variable", "flag") else self.name


FLAG = Origin("flag", "a flag")


class Given(NamedTuple):
    """A value as a layer gave it, and where."""

    value: Any
    origin: Origin


class LayeredSettings(NamedTuple):
    """The settings in effect, and how they came about.

    Attributes:
        given: dotted key → what the layers gave, the last one in effect; without keys that none gave.
    """

    settings: Settings
    given: Mapping[str, tuple[Given, ...]]
    files: SettingsFiles = NO_FILES
