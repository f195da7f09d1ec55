"""The rule for files that hold a secret: a MAVLink signing key, a token, a private key of TLS."""

from __future__ import annotations

import os
import stat
from pathlib import Path


class KeyFileError(ValueError):
    """Others can read a secret. The message is one line, without the name of what the file is for."""


def check_private(path: Path, status: os.stat_result) -> None:
    """Check that only the owner can read a file. Raises KeyFileError."""
    if status.st_mode & 0o077:
        mode = stat.S_IMODE(status.st_mode)
        raise KeyFileError(f"{path}: others can read it (mode {mode:o}): chmod 600 {path}")
