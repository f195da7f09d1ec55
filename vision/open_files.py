"""Which programs have a file or a socket open, by /proc."""

from __future__ import annotations

import os
import stat
from collections.abc import Callable, Iterator
from pathlib import Path

PROC = Path("/proc")
_PSEUDO_TERMINALS = range(136, 144)  # major numbers of their near ends, by Linux's devices.txt


def processes(proc: Path = PROC) -> list[int]:
    """Return the ids of all processes that are seen, in order."""
    return sorted(int(path.name) for path in proc.iterdir() if path.name.isdecimal())


def processes_with_file(file: Path, proc: Path = PROC) -> Iterator[int]:
    """Yield the processes that have a file or device open, without this one.

    Other users' descriptors are visible to root only.
    """
    try:
        wanted, own = str(file.resolve(strict=True)), file.stat()
    except OSError:
        return

    def matches(target: str, descriptor: str) -> bool:
        # The same path may be another file in a container.
        return target == wanted and _same(own, os.stat(descriptor))

    yield from processes_with_open(matches, proc)


def _same(one: os.stat_result, other: os.stat_result) -> bool:
    # A pseudo-terminal of a container has the number of another one here.
    pseudo = os.major(one.st_rdev) in _PSEUDO_TERMINALS
    if stat.S_ISCHR(one.st_mode) and stat.S_ISCHR(other.st_mode) and not pseudo:
        return one.st_rdev == other.st_rdev
    return os.path.samestat(one, other)


def processes_with_open(matches: Callable[[str, str], bool], proc: Path = PROC) -> Iterator[int]:
    """Yield the processes with a descriptor that matches, without this one.

    Args:
        matches: called with what a descriptor refers to, a path or for example `socket:[1234]`, and with its
            own path.

    Other users' descriptors are visible to root only.
    """
    for process in processes(proc):
        if process == os.getpid():
            continue
        try:
            if any(
                matches(os.readlink(each.path), each.path) for each in os.scandir(proc / str(process) / "fd")
            ):
                yield process
        except OSError:  # it has ended, or belongs to another user
            continue


def program_name(process: int, proc: Path = PROC) -> str:
    """Return the name of a process's program; empty: it has ended."""
    try:
        return (proc / str(process) / "comm").read_text(errors="replace").strip()
    except OSError:
        return ""
