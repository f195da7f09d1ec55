"""Runs `companion` with its output and exit code: as a separate process, or in this one."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from contextlib import chdir
from pathlib import Path

from typer.testing import CliRunner

from companion.cli.commands import app
from companion.settings.layers import SYSTEM_VARIABLE

COLUMNS = {"COLUMNS": "200", "NO_COLOR": "1"}
# `companion`, whose simulated vehicles take off and land quickly: for `python -c`.
QUICK = """
from companion import cli
from companion.simulation import session
from mavlink_sim.testing import QUICK_FLIGHT
session.SIMULATOR_PARAMETERS.update(QUICK_FLIGHT)
cli.main()
"""


def companion(*arguments: str | Path, cwd: Path, timeout_s: float = 60.0) -> subprocess.CompletedProcess[str]:
    """Run `companion` in a given folder and without COMPANION_ variables."""
    command = [sys.executable, "-m", "companion.cli", *(str(argument) for argument in arguments)]
    environment = {key: value for key, value in os.environ.items() if key not in _unset()}
    return subprocess.run(
        command,
        cwd=cwd,
        env=environment | COLUMNS,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=timeout_s,
        check=False,
    )


def companion_here(*arguments: str | Path, cwd: Path) -> subprocess.CompletedProcess[str]:
    """The same in this process, which saves half a second of imports.

    Not for commands that keep running (`run`, `play`, `record`…), unless they are refused before: they set
    signal handlers and replace standard error of the process.
    """
    command = [str(argument) for argument in arguments]
    # pytest's handlers would make the command's `logging.basicConfig` do nothing.
    root = logging.getLogger()
    handlers, level = root.handlers, root.level
    root.handlers = []
    root.setLevel(logging.WARNING)
    try:
        with chdir(cwd):
            done = CliRunner().invoke(app, command, env={**dict.fromkeys(_unset()), **COLUMNS})
    finally:
        root.handlers = handlers
        root.setLevel(level)
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    return subprocess.CompletedProcess(command, done.exit_code, done.stdout, done.stderr)


def _unset() -> list[str]:
    """All variables of settings; the settings of this computer stay left out."""
    return [key for key in os.environ if key.startswith("COMPANION_") and key != SYSTEM_VARIABLE]
