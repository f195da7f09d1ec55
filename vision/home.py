"""The home folder, where there may be none: a user id without an entry in passwd, with HOME unset."""

from __future__ import annotations

import os
from pathlib import Path

NO_HOME = Path("/nonexistent")
"""The home of users without one (Debian Policy 9.2.3): what is below it is absent, and cannot be written."""


def home_folder() -> Path:
    """The user's home, `NO_HOME` if it cannot be determined."""
    try:
        return Path.home()
    except RuntimeError:
        return NO_HOME


def expanded(path: str | Path) -> Path:
    """The path with `~` and `~USER` replaced; as it is if that home cannot be determined."""
    return Path(os.path.expanduser(path))
