"""`make test`: what runs by the clock, and beside it, on what it leaves of the processors, what computes.

Flights in real time mostly wait, and must not be made to. So what only computes runs at the lowest priority:
it fills every pause and takes nothing. The demonstration comes first, with no other flight beside it.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile

PYTEST = [sys.executable, "-m", "pytest"]
ALONE = "tests/alone"
# What computes stands still while others need the processors; what hangs is found all the same.
COMPUTING_TIMEOUT_S = 480


def main(processors: int) -> int:
    """The first exit code that is not 0; 0 if all have passed. The report on what computed comes last."""
    parts = [*PYTEST, "--ignore", ALONE, "-n", str(processors), "--dist", "worksteal"]
    clocked = [*parts, "-m", "clocked"]
    computing = [*parts, "-m", "not clocked", "--timeout", str(COMPUTING_TIMEOUT_S)]
    with tempfile.TemporaryFile() as said:
        with subprocess.Popen(["nice", "-n", "19", *computing], stdout=said, stderr=said) as beside:
            try:
                codes = [subprocess.call([*PYTEST, ALONE]), subprocess.call(clocked), beside.wait()]
            finally:
                beside.terminate()
        said.seek(0)
        sys.stdout.write(said.read().decode(errors="replace"))
    return next((code for code in codes if code != 0), 0)


if __name__ == "__main__":
    sys.exit(main(int(os.environ.get("PROCESSORS") or os.cpu_count() or 1)))
