"""`python -m companion.bench.stepped_clock FILE …`: the companion's command line with a clock that steps.

FILE has the seconds that are added to the wall clock, and is read again when it changes. The monotonic clock
and the clocks of child processes stay. Permission to set the computer's clock is not needed.
"""

from __future__ import annotations

import runpy
import sys
import time
from collections.abc import Callable
from pathlib import Path


def set_step(offset_file: Path, seconds: float) -> None:
    """Write the file at once: a process that reads the time meanwhile has the one or the other."""
    new = offset_file.with_name(f"{offset_file.name}.new")
    new.write_text(str(seconds))
    new.replace(offset_file)


def step_clock(offset_file: Path) -> None:
    """Let `time.time` and `time.time_ns` of this process follow the file, from now on."""
    time_s, time_ns, stat = time.time, time.time_ns, offset_file.stat
    read: tuple[tuple[int, int], float] = ((-1, -1), 0.0)

    def offset_s() -> float:
        nonlocal read
        about = stat()
        version = (about.st_ino, about.st_mtime_ns)
        if read[0] != version:
            read = (version, float(offset_file.read_text()))
        return read[1]

    def stepped_s() -> float:
        return time_s() + offset_s()

    def stepped_ns() -> int:
        return time_ns() + round(offset_s() * 1e9)

    replaced: dict[str, Callable[[], float]] = {"time": stepped_s, "time_ns": stepped_ns}
    for name, function in replaced.items():
        setattr(time, name, function)


if __name__ == "__main__":
    step_clock(Path(sys.argv.pop(1)))
    runpy.run_module("companion.cli", run_name="__main__", alter_sys=True)
