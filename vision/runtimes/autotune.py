"""A short measured trial of the installed runtimes, for `auto`; its outcome is kept.

It runs in a process of its own: a runtime that breaks on this board breaks there, and the memory of those
that lose is given back. `python -m vision.runtimes.autotune` is that process.
"""

from __future__ import annotations

import ctypes
import hashlib
import json
import logging
import os
import platform
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vision.runtimes.base import Precision, RuntimeName, RuntimeUnusableError, version
from vision.runtimes.source import ModelSource, read_source
from vision.yolo.checkpoint_pair import weights_sha256

logger = logging.getLogger(__name__)

_RUNS = 12
# Within this of the fastest, torch is taken: it needs no second copy of the network on disk.
_WORTH = 0.95
# A TensorRT plan takes minutes to build on a small board.
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
    """The fastest of `candidates` for this model on this board, and why in words.

    Measured once for each model, size, board and set of versions, and remembered in the cache folder.

    Raises:
        RuntimeUnusableError: none of them runs it; the message has each one's reason.
    """
    from vision.runtimes.selection import cache_folder

    question = {
        "model": weights_sha256(source.path),
        "class_ids": None if class_ids is None else list(class_ids),
        "board": board(),
        "versions": {name: version(name) for name in candidates},
        "image_size": image_size,
        "precision": precision,
        "threads": threads,
    }
    key = hashlib.sha256(json.dumps(question, sort_keys=True).encode()).hexdigest()[:24]
    kept = cache_folder() / f"trial-{key}.json"
    answer = _remembered(kept, question)
    when = "measured before"
    if answer is None:
        when = "measured now"
        answer = _measured(source, candidates, class_ids, precision, threads, image_size)
        # What failed may work next time: a missing package, a full disk.
        if all(isinstance(value, float) for value in answer.values()):
            _remember(kept, {"question": question, "answer": answer})
    times = {name: value for name, value in answer.items() if isinstance(value, float)}
    for name, value in answer.items():
        if name not in times:
            logger.warning("runtime auto: %s does not run this model: %s", name, value)
    if not times:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in answer.items())
        raise RuntimeUnusableError(f"{source.path}: no installed runtime runs it: {reasons}")
    best = min(times, key=lambda name: times[name])
    if "torch" in times and times[best] > _WORTH * times["torch"]:
        best = "torch"
    listed = ", ".join(f"{name} {times[name]:.1f} ms" for name in sorted(times, key=lambda name: times[name]))
    reason = f"{when}: {listed}"
    logger.info("runtime auto: %s (%s)", best, reason)
    return best, reason  # type: ignore[return-value]


def board() -> list[str]:
    """What this computer is, as far as speed depends on it."""
    device_tree = Path("/proc/device-tree/model")
    try:
        model = device_tree.read_bytes().rstrip(b"\0").decode(errors="replace")
    except OSError:
        model = ""
    names = {"model name", "Hardware", "CPU part"}
    try:
        lines = Path("/proc/cpuinfo").read_text(errors="replace").splitlines()
    except OSError:
        lines = []
    parts = sorted({line for line in lines if line.partition(":")[0].strip() in names})
    return [platform.machine(), model, str(len(os.sched_getaffinity(0))), *parts]


def _measured(
    source: ModelSource,
    candidates: Sequence[RuntimeName],
    class_ids: Sequence[int] | None,
    precision: Precision,
    threads: int | None,
    image_size: int,
) -> dict[str, Any]:
    """Each candidate's milliseconds, or why it does not run."""
    answer: dict[str, Any] = {}
    for name in candidates:
        order = {
            "asked_by": os.getpid(),
            "path": str(source.path),
            "runtime": name,
            "class_ids": None if class_ids is None else list(class_ids),
            "precision": precision,
            "threads": threads,
            "image_size": image_size,
        }
        # One process each: thread pools of one would slow the next.
        command = [sys.executable, "-m", "vision.runtimes.autotune", json.dumps(order)]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=_TIMEOUT_S, check=False)
        except subprocess.TimeoutExpired:
            answer[name] = f"gave no answer in {_TIMEOUT_S} s"
            continue
        try:
            answer[name] = json.loads(done.stdout.splitlines()[-1])
        except (IndexError, ValueError):
            last = (done.stderr.strip().splitlines() or ["it said nothing"])[-1]
            answer[name] = f"ended with {done.returncode}: {last[:300]}"
    return answer


def measure(
    source: ModelSource,
    runtime: RuntimeName,
    class_ids: Sequence[int] | None,
    precision: Precision,
    threads: int | None,
    image_size: int,
) -> float:
    """Milliseconds of one inference of a 4:3 input: the fastest, as other work will not always be there."""
    from vision.runtimes.selection import start_runtime

    started = start_runtime(
        source,
        runtime,
        class_ids=class_ids,
        precision=precision,
        threads=threads,
        image_size=image_size,
        sparse_boxes=True,
    ).runtime
    stride = max(started.head.strides)
    height = max(stride, image_size * 3 // 4 // stride * stride)
    picture = np.random.default_rng(0).integers(0, 256, (height, image_size, 3), np.uint8)
    started.prepare(height, image_size)
    times = []
    for _ in range(_RUNS):
        before = time.perf_counter()
        started.infer(picture)
        times.append((time.perf_counter() - before) * 1e3)
    return min(times[2:])


def _remembered(path: Path, question: dict[str, Any]) -> dict[str, Any] | None:
    try:
        kept = json.loads(path.read_text())
    except (OSError, ValueError):
        return None
    if not isinstance(kept, dict) or kept.get("question") != question:
        return None
    answer = kept.get("answer")
    return answer if isinstance(answer, dict) and set(answer) == set(question["versions"]) else None


def _remember(path: Path, content: dict[str, Any]) -> None:
    partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.write_text(json.dumps(content))
        os.replace(partial, path)
    except OSError as error:
        logger.warning("the choice of a runtime cannot be kept, and is measured again next time: %s", error)


def _end_with_parent(parent: int) -> None:
    """Whoever asked may be killed; nobody waits for the answer then, and the processor is wanted."""
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it died before the kernel was asked to tell
        os._exit(1)


def main(text: str) -> int:
    order = json.loads(text)
    _end_with_parent(order.pop("asked_by"))
    try:
        source = read_source(Path(order.pop("path")))
        answer: float | str = measure(source, **order)
    except (ValueError, RuntimeError, OSError, ImportError) as error:  # told to who asked
        answer = " ".join(str(error).split())
    print(json.dumps(answer), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
