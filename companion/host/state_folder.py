"""The folder of what is kept over a restart."""

from __future__ import annotations

import os
from pathlib import Path

from vision.home import home_folder


def state_folder() -> Path:
    """Return the folder of kept state; it may not exist yet.

    `$STATE_DIRECTORY` of a unit of systemd with StateDirectory=, its first one; else `companion` in
    `$XDG_STATE_HOME`, `~/.local/state` by default (XDG Base Directory Specification 0.8).
    """
    if unit := os.environ.get("STATE_DIRECTORY", "").partition(":")[0]:
        return Path(unit)
    base = os.environ.get("XDG_STATE_HOME", "")
    return (Path(base) if os.path.isabs(base) else home_folder() / ".local" / "state") / "companion"
