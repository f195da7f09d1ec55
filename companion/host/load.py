"""The load of the computer, in every message about what was too slow."""

from __future__ import annotations

import os

# What such messages contain, those of packages that do not know this one too. They get the load where they
# are shown: as events, as ends of commands, in `status`, in the log, and as errors of the command line. A
# recording of guidance has them without it.
SLOWNESS = (
    "guidance loop paused for",
    "stood still for",
    "this computer is too slow",
    "setpoint expired",
    "setpoint stream interrupted",
    "no fresh setpoint",
    "no setpoint sent within",
    "no image was processed within",
    "no image within",
    "no frame within",
    "no camera frames for",
    "no frame for",
    "no whole answer within",
    "partial frame dropped after",
    "no result for",
    "no result within",
    "no data for",
    "is stuck: no message for",
    "no sign of life for",
    "the encoder was too slow",
    "not read within",
    "not ready within",
    "not ready to arm within",
    "has not loaded it within",
    "has not ended yet",
    "did not end within",
)
_BUSY = "; the computer is busy ("


def with_load(text: str) -> str:
    """Return a message, with the load at its end if it is about slowness and the computer is busy."""
    if _BUSY in text or not any(words in text for words in SLOWNESS):
        return text
    return text + busy_text()


def busy_text() -> str:
    """Return `; the computer is busy (2 cores, load 18)` for the end of a message; empty: it is not busy.

    The load is the number of threads that ran or waited for a core in the last minute, for a disk too.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    load = os.getloadavg()[0]
    return f"{_BUSY}{cores} cores, load {load:.0f})" if load > cores else ""
