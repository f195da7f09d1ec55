"""Reads checkpoints in a separate process and reports the outcome, memory and time.

Run as `python checkpoint_memory.py WARM_UP FILE…`: prints one line of JSON per file with the outcome, the
growth of the process's peak memory, and its processor time, s. An attempt to run code ends the process. The
trial of a file is made in a copy of the process: importing torch for each takes seconds.
"""

from __future__ import annotations

import ctypes
import gc
import json
import os
import subprocess
import sys
import time
from pathlib import Path


def peak_bytes() -> int:
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) * 1024


def forbid(event: str, arguments: tuple[object, ...]) -> None:
    if event.startswith(("os.system", "subprocess", "os.exec", "os.posix_spawn", "socket", "pty.spawn")):
        print(json.dumps({"outcome": f"RAN {event} {arguments!r}"}), flush=True)
        os._exit(3)


def tried_in_a_copy(command: list[str], **_: object) -> subprocess.CompletedProcess[bytes]:
    from vision.runtimes import load_trial

    if (child := os.fork()) == 0:
        code = 1
        try:
            code = load_trial.main(*command[-2:])
        finally:
            os._exit(code)
    return subprocess.CompletedProcess(command, os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), b"", b"")


def main(warm_up: str, *paths: str) -> None:
    from vision.runtimes import load_trial
    from vision.yolo.checkpoint import CheckpointError, load_checkpoint

    setattr(subprocess, "run", tried_in_a_copy)  # noqa: B010  # this process runs no other
    load_trial.CHECKPOINT_S = 1
    # Memory of torch's first use is not counted.
    load_checkpoint(warm_up)
    # Collecting torch's own objects for every file takes most of the time.
    gc.collect()
    gc.freeze()
    sys.addaudithook(forbid)
    for path in paths:
        # The heap of an earlier file must not hide this one's memory.
        gc.collect()
        ctypes.CDLL(None).malloc_trim(0)
        # Writing 5 resets the peak to the current value (proc(5)).
        Path("/proc/self/clear_refs").write_text("5")
        before, started = peak_bytes(), time.process_time()
        try:
            outcome = f"loaded {len(load_checkpoint(path).class_names)} classes"
        except CheckpointError as error:
            outcome = f"{type(error).__name__}: {error}"
        took_s = time.process_time() - started
        print(json.dumps({"outcome": outcome, "bytes": peak_bytes() - before, "seconds": took_s}), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
