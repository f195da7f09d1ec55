"""Notes when the computer stands still: a process on each processor that only sleeps, and then wakes up late.

A virtual machine whose host takes its processors away stops for a second or more. Our own code cannot be
taken for that: a program that hangs, or holds its interpreter's lock, keeps no sleeper in another process
from waking.
"""

from __future__ import annotations

import os
import select
import subprocess
import sys
import time
from pathlib import Path

# Over half of how long a setpoint lives (0.5 s): what a busy but running computer takes comes on top of it.
STANDSTILL_S = 0.3
PERIOD_S = 0.05


class Watch:
    """Sleepers, one on each processor, that note to `notes` until `close()` or until this process ends."""

    def __init__(self, notes: Path) -> None:
        self.notes = notes
        notes.touch()
        self.processes = [
            subprocess.Popen(
                [sys.executable, "-I", "-S", __file__, str(notes), str(processor)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
            )
            for processor in _processors()
        ]
        for process in self.processes:
            assert process.stdout is not None
            if not process.stdout.readline():
                self.close()
                raise RuntimeError(f"the watch for standstills did not start: code {process.returncode}")

    def close(self) -> None:
        for process in self.processes:
            process.communicate()


def _processors() -> list[int]:
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else [0]


def visit_all_processors() -> None:
    """Run a moment on each: a standstill that has begun is then over, and noted."""
    allowed = _processors()
    if hasattr(os, "sched_setaffinity"):
        for processor in allowed:
            os.sched_setaffinity(0, {processor})
        os.sched_setaffinity(0, allowed)
    time.sleep(2 * PERIOD_S)  # the sleepers wake, too


def longest_standstill_s(notes: Path, since_ns: int) -> float:
    """How long a processor stood still at most, in what ended after `since_ns` (monotonic); 0.0: none did."""
    spans_ns = [[int(number) for number in line.split()] for line in notes.read_text().splitlines()]
    return max((end_ns - begin_ns for begin_ns, end_ns in spans_ns if end_ns > since_ns), default=0) / 1e9


def sleep_and_note(notes: Path, processor: int) -> None:
    """Sleep on this processor until stdin ends; a line for each standstill: begin and end (monotonic, ns)."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {processor})
    with notes.open("a", buffering=1) as output:
        asleep_ns = time.monotonic_ns()
        print("keeps watch", flush=True)
        while not select.select([sys.stdin], [], [], PERIOD_S)[0]:
            awake_ns = time.monotonic_ns()
            if awake_ns - asleep_ns > (PERIOD_S + STANDSTILL_S) * 1e9:
                output.write(f"{asleep_ns} {awake_ns}\n")
            asleep_ns = awake_ns


if __name__ == "__main__":
    sleep_and_note(Path(sys.argv[1]), int(sys.argv[2]))
