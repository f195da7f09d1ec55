"""Reads one checkpoint in a process of its own, and tells what that took.

Run as `python checkpoint_memory.py WARM_UP FILE…`: for each file one line of JSON with the outcome, the
growth of the process's peak memory, and the seconds. Whatever tries to run something ends the process.
"""

from __future__ import annotations

import ctypes
import gc
import json
import os
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


def main(warm_up: str, *paths: str) -> None:
    from vision.yolo.checkpoint import CheckpointError, load_checkpoint

    # Torch's own first-time needs are not the file's.
    load_checkpoint(warm_up)
    sys.addaudithook(forbid)
    for path in paths:
        # What an earlier file left in the heap must not hide what this one takes.
        gc.collect()
        ctypes.CDLL(None).malloc_trim(0)
        # Writing 5 resets the peak to what is held now (proc(5)).
        Path("/proc/self/clear_refs").write_text("5")
        before, started = peak_bytes(), time.monotonic()
        try:
            outcome = f"loaded {len(load_checkpoint(path).class_names)} classes"
        except CheckpointError as error:
            outcome = f"{type(error).__name__}: {error}"
        took_s = time.monotonic() - started
        print(json.dumps({"outcome": outcome, "bytes": peak_bytes() - before, "seconds": took_s}), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
