"""The programs that the tests of the page need beyond Python. `make browser` installs them.

`python -m tests.companion.dashboard.programs` says in one line what is left out where one is missing.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path

import pytest

AXE = Path(__file__).parent / "node_modules" / "axe-core" / "axe.min.js"
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
NODE = shutil.which("node")

needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="no chromium on the PATH: make browser")
needs_node = pytest.mark.skipif(NODE is None, reason="no node on the PATH")
needs_axe = pytest.mark.skipif(not AXE.is_file(), reason="no axe-core: make browser")

# What is left out without each.
TESTS = {
    "chromium": "the page in a browser",
    "node": "the page's functions in node",
    "axe-core": "the page's accessibility",
}


def left_out(here: Mapping[str, bool]) -> str:
    """One line on the tests that were left out, and how to get them; empty if none was."""
    missing = [name for name in TESTS if not here[name]]
    if not missing:
        return ""
    tests = ", ".join(f"{TESTS[name]} (no {name})" for name in missing)
    return f"left out: {tests}; `make browser` installs chromium (on Debian, as root) and axe-core (with npm)"


if __name__ == "__main__":
    found = {"chromium": CHROMIUM is not None, "node": NODE is not None, "axe-core": AXE.is_file()}
    if line := left_out(found):
        print(line)
