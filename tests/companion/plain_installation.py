"""An environment for child processes in which the modules of extras are not installed."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from companion.settings.layers import SYSTEM_VARIABLE
from vision.extras import EXTRA_OF


def environment_without(folder: Path, modules: Iterable[str] = EXTRA_OF) -> dict[str, str]:
    """The environment of this process, in which no Python process finds these modules.

    Args:
        folder: an empty one; it is the first on the path of the processes, and of those that they start.
    """
    folder.mkdir()
    # Python imports it at the start. None: an import of it fails, and `find_spec` finds nothing.
    hide = f"import sys\nsys.modules.update(dict.fromkeys({sorted(modules)!r}))\n"
    (folder / "sitecustomize.py").write_text(hide)
    path = os.pathsep.join(filter(None, (str(folder), os.environ.get("PYTHONPATH"))))
    own = {key for key in os.environ if key.startswith("COMPANION_")} - {SYSTEM_VARIABLE}
    return {key: text for key, text in os.environ.items() if key not in own} | {
        "PYTHONPATH": path,
        "COLUMNS": "200",
        "NO_COLOR": "1",
    }
