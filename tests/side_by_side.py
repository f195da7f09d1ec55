"""`make test`: what runs by the clock, and beside it, on what it leaves of the processors, what computes.

Flights in real time mostly wait, and must not be made to. So what only computes runs at the lowest priority,
in their pauses. The demonstration comes first: no other flight is beside it, only what computes. When that is
done, or nothing more waits for one that flies, more fly at once (`tests/late_workers.py`).

Everything is run, whatever fails. The report on what computed comes last.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import BinaryIO

from tests import late_workers
from tests.run_again import NOTES
from tests.standstill import Watch

PYTEST = [sys.executable, "-m", "pytest"]
ALONE = "tests/alone"
# What computes stands still while others need the processors; what hangs is found all the same.
COMPUTING_TIMEOUT_S = 480
LOOKS_EVERY_S = 0.5
INTERRUPTED = 130
# A worker that is in the middle of a test may take 15 s.
ENDS_WITHIN_S = 30.0


def main(workers: int) -> int:
    """The first exit code that is not 0; 0 if all have passed.

    Args:
        workers: how many tests run at once, of each kind; of those that fly half as many more at the end.
    """
    parts = [*PYTEST, "--ignore", ALONE, "--dist", "worksteal"]
    late = max(1, workers // 2)
    clocked = [*parts, "-n", str(workers + late), "-m", "clocked"]
    # the failures that `--lf` knows are those of the clock: two at once cannot write them down
    beside = ["nice", "-n", "19", *parts, "-n", str(workers), "-m", "not clocked", "-p", "no:cacheprovider"]
    beside += ["--timeout", str(COMPUTING_TIMEOUT_S)]
    codes: dict[str, int] = {}
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs have it ignored
    with tempfile.TemporaryDirectory(prefix="tests-") as folder:
        # one watch for all: what runs at the lowest priority would take the others for a standstill
        watch = Watch(Path(folder) / "standstills")
        os.environ[NOTES] = str(watch.notes)
        report = Path(folder) / "computing"
        os.environ.pop(late_workers.LATE_WORKERS, None)  # of a run that this one is a test of
        try:
            with (
                late_workers.held(Path(folder) / late_workers.COMPUTES) as lock,
                report.open("wb") as said,
                report.open("rb") as heard,
                subprocess.Popen(beside, stdout=said, stderr=said, pass_fds=[lock.fileno()]) as computing,
            ):
                lock.close()  # held by what computes alone, which must not wait for itself
                os.environ[late_workers.LATE_WORKERS] = late_workers.told(workers, late, Path(folder))
                try:
                    codes["the demonstration"] = _run([*PYTEST, ALONE])
                    codes["what runs by the clock"] = _run(clocked)
                    print("\nbeside these ran what computes:\n", flush=True)
                    codes["what computes"] = _follow(computing, heard)
                except BaseException as error:
                    _end(computing, error)
                    raise
        except KeyboardInterrupt:
            return INTERRUPTED
        finally:
            watch.close()
    failed = {part: code for part, code in codes.items() if code != 0}
    print("\nnot all have passed: see " + ", ".join(failed) if failed else "\nall have passed", flush=True)
    return next(iter(failed.values()), 0)


def _run(command: list[str]) -> int:
    with subprocess.Popen(command) as process:
        try:
            return process.wait()
        except BaseException as error:
            _end(process, error)
            raise


def _end(process: subprocess.Popen[bytes], error: BaseException) -> None:
    """Interrupt it, as a Ctrl-C has: its workers and what its tests have started end with it."""
    if process.poll() is None and not isinstance(error, KeyboardInterrupt):
        process.send_signal(signal.SIGINT)
    try:
        process.wait(ENDS_WITHIN_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _follow(process: subprocess.Popen[bytes], heard: BinaryIO) -> int:
    """Show what it says, and has said, until it ends."""
    while True:
        code = process.poll()
        shutil.copyfileobj(heard, sys.stdout.buffer)
        sys.stdout.buffer.flush()
        if code is not None:
            return code
        time.sleep(LOOKS_EVERY_S)


if __name__ == "__main__":
    sys.exit(main(int(os.environ.get("WORKERS") or len(os.sched_getaffinity(0)))))
