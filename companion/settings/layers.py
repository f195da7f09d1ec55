"""The files of settings: of the system, of the user, and the one that `--config` names."""

from __future__ import annotations

import os
from pathlib import Path

from vision.home import home_folder

SYSTEM_FILE = Path("/etc/companion/companion.toml")
"""The settings of this computer."""


def user_file() -> Path:
    """Return where the user's settings are, whether or not there is a file.

    `$XDG_CONFIG_HOME/companion/companion.toml`, or below `~/.config` where that is unset or relative, by the
    XDG Base Directory Specification 0.8.
    """
    base = Path(os.environ.get("XDG_CONFIG_HOME", ""))
    return (base if base.is_absolute() else home_folder() / ".config") / "companion" / "companion.toml"
