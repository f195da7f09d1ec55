"""The load of the computer, for messages about what was too slow."""

from __future__ import annotations

import os


def busy_text() -> str:
    """Return `; the computer is busy (2 cores, load 18)` for the end of a message; empty: it is not busy.

    The load is the number of threads that ran or waited for a core in the last minute, for a disk too.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    load = os.getloadavg()[0]
    return f"; the computer is busy ({cores} cores, load {load:.0f})" if load > cores else ""
