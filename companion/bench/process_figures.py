"""Memory, descriptors and threads of a process and its descendants, by /proc."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

_PROC = Path("/proc")
_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")


@dataclass(frozen=True, slots=True)
class Figures:
    """Of one process, or the sum of several.

    Attributes:
        rss_mb: resident memory in 10^6 bytes; what several share counts for each of them.
    """

    rss_mb: float = 0.0
    descriptors: int = 0
    threads: int = 0

    def __add__(self, other: Figures) -> Figures:
        return Figures(
            self.rss_mb + other.rss_mb, self.descriptors + other.descriptors, self.threads + other.threads
        )


def tree_of(pid: int) -> list[int]:
    """Return a process and all of its descendants."""
    children: dict[int, list[int]] = {}
    for each in _PROC.iterdir():
        if each.name.isdecimal():
            with suppress(OSError, ValueError, IndexError):  # it has ended
                parent = int((each / "stat").read_text(errors="replace").rpartition(")")[2].split()[1])
                children.setdefault(parent, []).append(int(each.name))
    found = [pid]
    for one in found:
        found += children.get(one, [])
    return found


def figures_of(pid: int) -> dict[str, Figures]:
    """Return the figures of a process and its descendants by their names; of the same name as their sum."""
    found: dict[str, Figures] = {}
    for each in tree_of(pid):
        with suppress(OSError, ValueError, IndexError):
            folder = _PROC / str(each)
            words = (folder / "cmdline").read_text(errors="replace").split("\0")
            rss = int((folder / "statm").read_text().split()[1]) * _PAGE_BYTES / 1e6
            own = Figures(rss, len(os.listdir(folder / "fd")), len(os.listdir(folder / "task")))
            name = "service" if each == pid else _name(words)
            found[name] = found.get(name, Figures()) + own
    return found


def _name(words: list[str]) -> str:
    """A process of Python by its module or what it was spawned for, any other by its program."""
    modules = [after for word, after in pairwise(words) if word in ("-m", "-c")]
    named = modules[0] if modules else Path(words[0]).name
    return named.split("(")[0].split(";")[0].strip()[:40] or "unnamed"


def total(found: Iterable[Figures]) -> Figures:
    """Return the sum."""
    return sum(found, Figures())


def settled_figures(pid: int, *, seconds: float, period_s: float = 0.5) -> dict[str, Figures]:
    """Return the figures of the moment with the least memory: requests that pass by are left out."""
    least = figures_of(pid)
    until_s = time.monotonic() + seconds
    while time.monotonic() < until_s:
        time.sleep(period_s)
        now = figures_of(pid)
        if total(now.values()).rss_mb < total(least.values()).rss_mb:
            least = now
    return least
