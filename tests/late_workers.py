"""Workers of pytest-xdist that begin when something else has ended: here, what computes beside what flies.

That holds a lock on a file for as long as it lives (flock(2)), so nobody has to tell its end, and a wait for
it needs no polling. Meanwhile the other workers take from the late ones what is waiting there, all but the
last two of each. One that takes the place of a worker that crashed is not late.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import pytest

# "N PATH": of 2 N workers the second half begin when nobody has the file locked any more.
WAITING = "COMPANION_TEST_LATE_WORKERS"


def held(path: Path) -> IO[bytes]:
    """The file, locked for whoever inherits it too."""
    file = path.open("wb")
    fcntl.flock(file, fcntl.LOCK_EX)
    return file


@pytest.hookimpl(wrapper=True, tryfirst=True)  # the wait is no part of a test's time
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    worker = getattr(item.config, "workerinput", {}).get("workerid", "")
    early, _, path = os.environ.get(WAITING, "").partition(" ")
    if worker and path and int(early) <= int(worker.removeprefix("gw")) < 2 * int(early):
        with Path(path).open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_SH)
    return (yield)
