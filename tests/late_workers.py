"""Workers of pytest-xdist that begin later: when what computes beside has ended, or an early one is idle.

Whatever they wait for holds a lock on a file while it goes on (flock(2)): nobody has to tell its end, and
nobody has to ask again and again. Meanwhile the early workers take from the late ones what waits there,
all but the last two of each. A worker that takes the place of one that crashed is neither.
"""

from __future__ import annotations

import fcntl
import os
import threading
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO

import pytest

# "EARLY LATE FOLDER": how many there are of each, the early ones first; in the folder lie the files.
LATE_WORKERS = "COMPANION_TEST_LATE_WORKERS"
COMPUTES = "computes"
GOES_ON = pytest.StashKey[IO[bytes]]()
BEGAN = pytest.StashKey[bool]()


def held(path: Path) -> IO[bytes]:
    """The file, locked until it is closed here and by whoever inherited it.

    Raises BlockingIOError if somebody holds it: two runs were given one folder.
    """
    file = path.open("wb")
    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    return file


def pytest_configure(config: pytest.Config) -> None:
    folder, early, _ = _workers()
    worker = _worker(config)
    if folder is not None and worker in early:
        config.stash[GOES_ON] = held(folder / worker)


def pytest_sessionfinish(session: pytest.Session) -> None:
    """An early worker finds nothing more to do."""
    if GOES_ON in session.config.stash:
        session.config.stash[GOES_ON].close()


@pytest.hookimpl(wrapper=True, tryfirst=True)  # the wait is no part of a test's time
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    folder, early, late = _workers()
    if folder is not None and _worker(item.config) in late and BEGAN not in item.config.stash:
        item.config.stash[BEGAN] = True
        _until_one_has_ended(folder / name for name in (COMPUTES, *early))
    return (yield)


def told(early: int, late: int, folder: Path) -> str:
    """What the variable `LATE_WORKERS` is to say."""
    return f"{early} {late} {folder}"


def _workers() -> tuple[Path | None, list[str], list[str]]:
    """The folder of locks, None if nobody is late, and the names of the early and of the late ones."""
    if LATE_WORKERS not in os.environ:
        return None, [], []
    early, late, folder = os.environ[LATE_WORKERS].split(" ", 2)
    names = [f"gw{index}" for index in range(int(early) + int(late))]
    return Path(folder), names[: int(early)], names[int(early) :]


def _worker(config: pytest.Config) -> str:
    return str(getattr(config, "workerinput", {}).get("workerid", ""))


def _until_one_has_ended(paths: Iterable[Path]) -> None:
    over = threading.Event()

    def wait(path: Path) -> None:
        try:
            with path.open("rb") as file:
                fcntl.flock(file, fcntl.LOCK_SH)
        finally:
            over.set()

    for path in paths:
        threading.Thread(target=wait, args=(path,), name=f"waits for {path.name}", daemon=True).start()
    over.wait()
