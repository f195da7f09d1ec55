"""Runs expressions with a module of the page in node."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

import companion.dashboard
from tests.programs import NODE

PAGE = Path(companion.dashboard.__file__).parent / "page"


def evaluate(module: str, expression: str, given: Any) -> Any:
    """The value of a JavaScript expression of `given` and what the module exports as `module`, as JSON."""
    assert NODE is not None
    program = (
        f"import * as module from {json.dumps((PAGE / module).as_uri())};"
        f"const given = {json.dumps(given)};"
        f"console.log(JSON.stringify({expression}));"
    )
    command = [NODE, "--input-type=module", "--eval", program]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)
