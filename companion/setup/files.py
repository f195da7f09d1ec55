"""The files and the link of an installation, which `install` writes and `uninstall` removes."""

from __future__ import annotations

import difflib
import os
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

from vision.home import home_folder

INSTALLATIONS = Path("/opt/companion")
"""Each folder in it is a virtual environment of one version."""
CURRENT = INSTALLATIONS / "current"
UNIT = "companion.service"
TEMPLATE = "companion@.service"
SYSTEM_UNITS = Path("/etc/systemd/system")
SYSUSERS = Path("/etc/sysusers.d/companion.conf")
TMPFILES = Path("/etc/tmpfiles.d/companion.conf")
RULES = Path("/etc/udev/rules.d/70-companion.rules")

# What a unit of a user's manager keeps of the system's: the rest needs privileges, or its folders.
_OF_USERS = (
    *("Description", "StartLimitIntervalSec", "Type", "NotifyAccess", "ExecStart", "WatchdogSec"),
    *("WatchdogSignal", "Restart", "RestartPreventExitStatus", "RestartSec", "TimeoutStartSec"),
    *("TimeoutStopSec", "KillMode", "UMask"),
)


@dataclass(frozen=True, slots=True)
class TextFile:
    """A file of an installation."""

    path: Path
    text: str

    def found(self) -> str | None:
        """Return what is there; None: nothing."""
        return self.path.read_text("utf-8", "surrogateescape") if self.path.is_file() else None

    def is_there(self) -> bool:
        """Whether it is there with this text."""
        return self.found() == self.text

    def write(self) -> None:
        """Write it whole, or not at all; all may read it."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        new = self.path.with_name(f".{self.path.name}.new")
        try:
            # A path of another encoding, in the user's unit, stays as it is.
            new.write_text(self.text, "utf-8", "surrogateescape")
            new.chmod(0o644)
            new.replace(self.path)
        finally:
            new.unlink(missing_ok=True)

    def lines(self) -> Iterator[str]:
        """Yield the text if it is new, else what changes, as a unified diff."""
        before = self.found()
        if before is None:
            yield from self.text.splitlines()
        else:
            name, new = str(self.path), self.text.splitlines()
            yield from difflib.unified_diff(before.splitlines(), new, name, name, lineterm="")


@dataclass(frozen=True, slots=True)
class Link:
    """A symbolic link of an installation."""

    path: Path
    target: Path

    def found(self) -> str | None:
        """Return where it leads; None: it is not there."""
        return str(self.path.readlink()) if self.path.is_symlink() else None

    def is_there(self) -> bool:
        """Whether it is there with this target."""
        return self.found() == str(self.target)

    def write(self) -> None:
        """Move it in one step: a service that starts meanwhile has the one or the other."""
        new = self.path.with_name(f".{self.path.name}.new")
        new.unlink(missing_ok=True)
        new.symlink_to(self.target)
        try:
            new.replace(self.path)
        finally:
            new.unlink(missing_ok=True)

    def lines(self) -> Iterator[str]:
        """Yield where it leads, before and after."""
        if (before := self.found()) is not None:
            yield f"-{before}"
        yield f"+{self.target}"


Entry = TextFile | Link


def packaged(name: str) -> str:
    """Return the text of a file of the folder `systemd`."""
    return resources.files("companion.setup").joinpath("systemd", name).read_text()


def system_entries(environment: Path, root: Path = Path("/")) -> tuple[Entry, ...]:
    """Return the files of a service of the system.

    Args:
        environment: the virtual environment in INSTALLATIONS. root: a folder in place of `/`.
    """
    files = {
        SYSTEM_UNITS / UNIT: UNIT,
        SYSTEM_UNITS / TEMPLATE: TEMPLATE,
        SYSUSERS: "sysusers.conf",
        TMPFILES: "tmpfiles.conf",
        RULES: "70-companion.rules",
    }
    texts = [TextFile(below(root, path), packaged(name)) for path, name in files.items()]
    return (*texts, Link(below(root, CURRENT), environment))


def user_entries() -> tuple[Entry, ...]:
    """Return the file of a service of this user, which runs this Python."""
    return (TextFile(user_units() / UNIT, user_unit(Path(sys.executable))),)


def below(root: Path, path: Path) -> Path:
    """Return an absolute path with a folder in place of `/`."""
    return root / path.relative_to("/")


def user_units() -> Path:
    """Return the folder of this user's units: systemd.unit(5)."""
    base = Path(os.environ.get("XDG_CONFIG_HOME", ""))
    return (base if base.is_absolute() else home_folder() / ".config") / "systemd" / "user"


def user_unit(python: Path) -> str:
    """Return the unit of a user's manager: the system's without what needs privileges.

    Args:
        python: of the environment.
    """
    quoted = str(python).replace("%", "%%").replace("\\", "\\\\").replace('"', '\\"')
    own = {
        "ExecStart": f'"{quoted}" -m companion.cli run',
        "NoNewPrivileges": "yes",
        "WorkingDirectory": "%h",
        "WantedBy": "default.target",
    }
    lines = ["# `companion install --user` writes this file. Changes: `systemctl --user edit companion`."]
    comments: list[str] = []
    for line in packaged(UNIT).partition("\n")[2].splitlines():
        key = line.partition("=")[0]
        if line.startswith("#"):
            comments.append(line)
            continue
        if key in own:
            lines.append(f"{key}={own[key]}")
        elif key in _OF_USERS:
            lines += [*comments, line]
        elif line.startswith("["):
            lines += ["", line]
        comments = []
    return "\n".join(line for line in lines if not re.match(r"#\w+=", line)).strip() + "\n"
