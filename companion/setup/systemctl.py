"""Asks and commands systemd, by its programs."""

from __future__ import annotations

import shlex
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from companion.setup.files import SYSTEM_UNITS, UNIT, below

_INSTANCES = "companion@*.service"
_LONGEST_S = 90.0  # of a stop: TimeoutStopSec of the unit, and a margin
UP_OR_STARTING = ("active", "reloading", "activating")
"""States of a unit that a restart stops. One that has crashed, and is started again soon, is `activating`."""


class SetupError(Exception):
    """The computer was not set up. The message has one line each: what, and what to do."""


def run_program(command: Sequence[str]) -> str:
    """Run a program and return what it prints. Raises SetupError with its last line."""
    try:
        done = subprocess.run(
            command,
            capture_output=True,
            encoding="utf-8",
            errors="replace",  # of a journal
            timeout=_LONGEST_S,
            check=False,
        )
    except FileNotFoundError as error:
        raise SetupError(f"{command[0]}: no such program; this needs a Linux with systemd") from error
    except subprocess.TimeoutExpired as error:
        raise SetupError(f"{' '.join(command)}: no end yet, given up") from error
    if done.returncode:
        said = (done.stderr or done.stdout).strip().splitlines() or [f"exit code {done.returncode}"]
        raise SetupError(f"{' '.join(command)}: {said[-1]}")
    return done.stdout


def as_root(word: str) -> str:
    """Return the line that runs a command of this program as root. `word`: its name."""
    program = sys.argv[0]
    # `python -m companion.cli`: its first word is a file that is no program.
    words = (sys.executable, "-m", "companion.cli") if program.endswith("__main__.py") else (program,)
    return shlex.join(("sudo", *words, word))


@dataclass(frozen=True, slots=True)
class Host:
    """The computer that is set up. A test has a folder, and notes what is run.

    Attributes:
        user: the service is of this user's manager, not of the system.
        root: a folder in place of `/`. run: runs a program and returns what it prints, or raises SetupError.
    """

    user: bool = False
    root: Path = Path("/")
    run: Callable[[Sequence[str]], str] = run_program

    def systemctl(self, *words: str) -> tuple[str, ...]:
        """Return a command of systemctl."""
        return ("systemctl", *(("--user",) if self.user else ()), *words)

    def check_manager(self) -> None:
        """Raise SetupError if the manager of this user cannot be reached; the system's is not asked."""
        if not self.user:
            return
        try:
            self.run(self.systemctl("show-environment"))
        except SetupError as error:
            raise SetupError(
                f"{error}; no systemd manager of this user runs: log in as this user, not by su or sudo, or "
                "sudo loginctl enable-linger $USER; both need the package libpam-systemd"
            ) from error

    def journal(self, unit: str, since_s: float, lines: int) -> str:
        """Return the newest lines of a unit since a time of day, seconds since 1970."""
        of_unit = "--user-unit" if self.user else "--unit"
        options = (f"--since=@{int(since_s)}", f"--lines={lines}", "--no-pager", "--output=cat")
        return self.run(("journalctl", of_unit, unit, *options))

    def show(self, unit: str) -> Mapping[str, str]:
        """Return the state of a unit, as `systemctl show` names it; of one that is not there too."""
        names = (
            *("ActiveState", "SubState", "UnitFileState", "NRestarts", "StatusText", "InvocationID"),
            *("ExecMainCode", "ExecMainStatus", "Result"),
            *("ExecMainStartTimestampMonotonic", "NeedDaemonReload"),
        )
        printed = self.run(self.systemctl("show", unit, f"--property={','.join(names)}"))
        return dict(line.split("=", 1) for line in printed.splitlines() if "=" in line)

    def instances(self) -> list[str]:
        """Return the instances of the template that are loaded or enabled, sorted."""
        words = self.systemctl("list-units", "--all", "--plain", "--no-legend", _INSTANCES)
        found = {line.split()[0] for line in self.run(words).splitlines() if line.strip()}
        wants = below(self.root, SYSTEM_UNITS) / "multi-user.target.wants"
        return sorted(found | {path.name for path in wants.glob(_INSTANCES)})

    def units(self) -> list[str]:
        """Return the service's unit, and its instances."""
        return [UNIT, *(() if self.user else self.instances())]

    def is_running(self, unit: str) -> bool:
        """Whether a unit runs: ready, starting, ending, or started again soon after a crash."""
        return self.show(unit).get("ActiveState") in (*UP_OR_STARTING, "deactivating")
