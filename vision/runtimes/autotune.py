"""Measures the installed runtimes for `auto`; the result is cached.

Each measurement runs in a separate process (`python -m vision.runtimes.autotune`): a runtime that crashes on
this board does not affect the service, and its memory is released.
"""

from __future__ import annotations

import ctypes
import json
import logging
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vision.runtimes.base import Precision, RuntimeName, RuntimeUnusableError, required, version
from vision.runtimes.source import ModelSource, read_source
from vision.runtimes.start import start_named
from vision.runtimes.stored_choice import StoredChoice
from vision.yolo.checkpoint_pair import weights_sha256

logger = logging.getLogger(__name__)

_RUNS = 12
# torch is preferred within this factor of the fastest: it needs no second copy of the network on disk.
_WORTH = 0.95
# Building a TensorRT plan takes minutes on a small board.
_TIMEOUT_S = 1800
_PR_SET_PDEATHSIG = 1  # linux/prctl.h


def fastest_runtime(
    source: ModelSource,
    candidates: Sequence[RuntimeName],
    *,
    class_ids: Sequence[int] | None,
    precision: Precision,
    threads: int | None,
    image_size: int,
) -> tuple[RuntimeName, str]:
    """The fastest of `candidates` for this model on this board, and the reason in words.

    Measured once per model, size, board and set of versions, and cached in the cache folder.

    Raises:
        RuntimeUnusableError: none of them runs the model; the message has each one's reason.
    """
    question = {
        "class_ids": None if class_ids is None else list(class_ids),
        "versions": {name: version(name) for name in candidates},
        "image_size": image_size,
        "precision": precision,
        "threads": threads,
    }
    stored = StoredChoice(weights_sha256(source.weights_path), question)
    answer = stored.read(set(candidates))
    when = "measured before"
    if answer is None:
        when = "measured now"
        answer = _measure_all(source, candidates, class_ids, precision, threads, image_size)
        # A failure may be temporary: a missing package, a full disk.
        if all(isinstance(value, float) for value in answer.values()):
            stored.write(answer)
    times = {name: value for name, value in answer.items() if isinstance(value, float)}
    for name, value in answer.items():
        if name not in times:
            logger.warning("runtime auto: %s cannot run this model: %s", name, value)
    if not times:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in answer.items())
        raise RuntimeUnusableError(f"{source.path}: no installed runtime can run it: {reasons}")
    best = min(times, key=lambda name: times[name])
    if "torch" in times and times[best] > _WORTH * times["torch"]:
        best = "torch"
    listed = ", ".join(f"{name} {times[name]:.1f} ms" for name in sorted(times, key=lambda name: times[name]))
    reason = f"{when}: {listed}"
    logger.info("runtime auto: %s (%s)", best, reason)
    return best, reason  # type: ignore[return-value]


def _measure_all(
    source: ModelSource,
    candidates: Sequence[RuntimeName],
    class_ids: Sequence[int] | None,
    precision: Precision,
    threads: int | None,
    image_size: int,
) -> dict[str, Any]:
    """Each candidate's milliseconds, or why it cannot run."""
    answer: dict[str, Any] = {}
    for name in candidates:
        request = {
            "parent_pid": os.getpid(),
            "path": str(source.path),
            "runtime": name,
            "class_ids": None if class_ids is None else list(class_ids),
            "precision": precision,
            "threads": threads,
            "image_size": image_size,
        }
        # A process each: the thread pools of one would slow the next.
        command = [sys.executable, "-m", "vision.runtimes.autotune", json.dumps(request)]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=_TIMEOUT_S, check=False)
        except subprocess.TimeoutExpired:
            answer[name] = f"no result within {_TIMEOUT_S} s"
            continue
        try:
            answer[name] = json.loads(done.stdout.splitlines()[-1])
        except (IndexError, ValueError):
            last = (done.stderr.strip().splitlines() or ["no output"])[-1]
            answer[name] = f"exit code {done.returncode}: {last[:300]}"
    return answer


def measure(
    source: ModelSource,
    runtime: RuntimeName,
    class_ids: Sequence[int] | None,
    precision: Precision,
    threads: int | None,
    image_size: int,
) -> float:
    """Milliseconds of one inference of a 4:3 input: the minimum, which excludes other load."""
    started = start_named(source, runtime, class_ids, precision, threads, image_size, sparse_boxes=True)
    stride = max(source.strides)
    height, width = max(stride, image_size * 3 // 4 // stride * stride), image_size
    if source.foreign is not None and source.foreign.fixed_size is not None:
        height, width = source.foreign.fixed_size
    image = np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)
    started.prepare(height, width)
    times = []
    for _ in range(_RUNS):
        before = time.perf_counter()
        started.infer(image)
        times.append((time.perf_counter() - before) * 1e3)
    return min(times[2:])


def _end_with_parent(parent: int) -> None:
    """Exit when the parent process is killed: the result is no longer needed."""
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it exited before prctl was called
        os._exit(1)


def main(text: str) -> int:
    request = json.loads(text)
    _end_with_parent(request.pop("parent_pid"))
    try:
        required(request["runtime"])  # before torch is imported to read a checkpoint
        source = read_source(Path(request.pop("path")))
        answer: float | str = measure(source, **request)
    except (ValueError, RuntimeError, OSError, ImportError) as error:  # reported to the parent process
        answer = " ".join(str(error).split())
    print(json.dumps(answer), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
