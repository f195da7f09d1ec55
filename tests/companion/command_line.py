"""Runs `companion` as a separate process, with its output and exit code."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

COLUMNS = {"COLUMNS": "200", "NO_COLOR": "1"}


def companion(*arguments: str | Path, cwd: Path, timeout_s: float = 60.0) -> subprocess.CompletedProcess[str]:
    """Run `companion` in a given folder and without COMPANION_ variables."""
    command = [sys.executable, "-m", "companion.cli", *(str(argument) for argument in arguments)]
    environment = {key: value for key, value in os.environ.items() if not key.startswith("COMPANION_")}
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
