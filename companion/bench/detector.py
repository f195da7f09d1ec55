"""Measuring the detector: every runtime in a separate process, in turn, under the same load.

`python -m companion.bench.detector` is that process. It takes its order as a line of JSON, says when its
first detection is done, then for each number it reads detects in so many images and reports how long each
took. Whoever measures something else beside it (`tools/bench_ultralytics.py`) speaks the same lines.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vision.file_kinds import explained
from vision.text_file import read_text

ROUNDS = 5
_WARM_UP = 8
_IMAGES = 8
# Columns of the table, with their widths.
_TABLE = {
    "runtime": 12,
    "precision": 9,
    "threads": 7,
    "fastest_ms": 10,
    "p50_ms": 9,
    "p99_ms": 9,
    "around_p50_ms": 13,
    "processor_ms": 12,
    "frames_per_s": 12,
    "memory_mb": 9,
    "first_detection_s": 17,
}


class BenchError(Exception):
    """A measured process failed; the message has its last output."""


class Measured:
    """A process that detects on request. A context manager: leaving it ends the process.

    Attributes:
        label: how messages name it.
        answer: what it said of itself after its first detection.
        first_detection_s: from the process's start to the end of its first detection.
    """

    def __init__(self, label: str, command: Sequence[str], order: dict[str, Any]) -> None:
        self.label = label
        self._errors = tempfile.TemporaryFile("w+")  # noqa: SIM115 - closed with the process
        started = time.perf_counter()
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._errors, text=True
        )
        try:
            self.answer = self._ask(json.dumps(order))
        except BaseException:
            self.close()
            raise
        self.first_detection_s = time.perf_counter() - started
        self._times: list[list[float]] = []
        self._processor_s = 0.0

    def __enter__(self) -> Measured:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        if self._process.poll() is None:
            self._process.kill()
        self._process.communicate()
        self._errors.close()

    def detect(self, images: int, *, count: bool = True) -> None:
        """Detect in so many images; `count` False: only to get warm."""
        answer = self._ask(str(images))
        self.answer |= {"memory_mb": answer["memory_mb"]}
        if count:
            self._times += answer["times_ms"]
            self._processor_s += answer["processor_s"]

    def figures(self) -> dict[str, Any]:
        """All that was measured, milliseconds of one image, pixels in, boxes out.

        `processor_ms` is the mean processor time of all threads: other load changes it far less.
        """
        table = np.asarray(self._times)
        total = table.sum(axis=1)
        return {
            **{name: value for name, value in self.answer.items() if name != "memory_mb"},
            "frames": len(total),
            "fastest_ms": round(float(total.min()), 3),
            "p50_ms": round(float(np.percentile(total, 50)), 3),
            "p99_ms": round(float(np.percentile(total, 99)), 3),
            "max_ms": round(float(total.max()), 3),
            "network_p50_ms": round(float(np.percentile(table[:, 1], 50)), 3),
            "around_p50_ms": round(float(np.percentile(table[:, 0] + table[:, 2], 50)), 3),
            "processor_ms": round(1e3 * self._processor_s / len(total), 3),
            "frames_per_s": round(1e3 * len(total) / float(total.sum()), 1),
            "memory_mb": self.answer["memory_mb"],
            "first_detection_s": round(self.first_detection_s, 2),
        }

    def _ask(self, line: str) -> dict[str, Any]:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        try:
            self._process.stdin.write(line + "\n")
            self._process.stdin.flush()
            answer: dict[str, Any] = json.loads(self._process.stdout.readline())
        except (OSError, ValueError):
            self._process.wait(timeout=10)
            self._errors.seek(0)
            last = (self._errors.read().strip().splitlines() or ["no output"])[-1]
            raise BenchError(f"{self.label}: {last}") from None
        if "error" in answer:
            raise BenchError(f"{self.label}: {answer['error']}")
        return answer


def measure_detectors(
    model: str,
    *,
    runtimes: Sequence[str],
    image_size: int,
    frames: int,
    threads: int | None,
    precision: str = "auto",
    device: str = "cpu",
    classes: Sequence[str | int] | None = None,
    width: int = 640,
    height: int = 480,
) -> dict[str, Any]:
    """Every runtime in `runtimes`, in turn, on the same drawn images of `width` × `height`.

    Returns:
        `machine`, what was asked, and `rows`, one a runtime.
    """
    order = {
        "model": model,
        "image_size": image_size,
        "threads": threads,
        "precision": precision,
        "device": device,
        "classes": None if classes is None else list(classes),
    }
    with tempfile.TemporaryDirectory() as folder:
        images = draw_images(Path(folder) / "images.npy", width, height)
        command = [sys.executable, "-m", "companion.bench.detector"]
        measured: list[Measured] = []
        try:
            for runtime in runtimes:
                one = Measured(runtime, command, {**order, "runtime": runtime, "images": str(images)})
                measured.append(one)
            in_turn(measured, frames)
            rows = [one.figures() for one in measured]
        finally:
            for one in measured:
                one.close()
    return {"machine": machine(), **order, "frame": f"{width}x{height}", "rows": rows}


def in_turn(measured: Sequence[Measured], frames: int) -> None:
    """Let each detect in `frames` images, a part of them each time it is its turn."""
    for one in measured:
        one.detect(_WARM_UP, count=False)
    parts = [frames // ROUNDS + (number < frames % ROUNDS) for number in range(ROUNDS)]
    for part in filter(None, parts):
        for one in measured:
            one.detect(part)


def draw_images(path: Path, width: int, height: int) -> Path:
    """A few images of the built-in world, (N, height, width, 3) uint8 BGR, as a numpy file."""
    from mavlink_sim.datasets.training_scenes import random_scene

    rng = np.random.default_rng(0)
    np.save(path, np.stack([random_scene(rng, width, height)[0] for _ in range(_IMAGES)]))
    return path


def machine() -> dict[str, Any]:
    """Conditions that affect the figures."""
    from vision.runtimes.stored_choice import board

    return {"board": board(), "processors": len(os.sched_getaffinity(0)), "python": platform.python_version()}


def table(result: dict[str, Any], against: dict[str, Any] | None = None) -> list[str]:
    """The rows as lines; with an earlier result, how each compares."""
    longest = max(len(str(row["runtime"])) for row in result["rows"])
    columns = _TABLE | {"runtime": max(longest, _TABLE["runtime"])}
    lines = ["  ".join(f"{name:>{width}}" for name, width in columns.items())]
    before = {_key(row): row for row in (against or {}).get("rows", [])}
    for row in result["rows"]:
        line = "  ".join(f"{row[name]!s:>{width}}" for name, width in columns.items())
        earlier = before.get(_key(row))
        if earlier is not None:
            line += f"   p50 was {earlier['p50_ms']} ms: {row['p50_ms'] / earlier['p50_ms']:.2f} of it"
        elif against is not None:
            line += "   not measured before"
        lines.append(line)
    return lines


def read_result(path: Path) -> dict[str, Any]:
    """An earlier result, as `--json` printed it. Raises `BenchError`."""
    try:
        result = json.loads(read_text(path))
    except OSError as error:
        raise BenchError(f"{path}: cannot be read: {error.strerror}") from error
    except ValueError as error:
        problem = f"{path}: is no result of `companion bench detector --json` ({error})"
        raise BenchError(explained(path, problem)) from error
    rows = result.get("rows") if isinstance(result, dict) else None
    if not isinstance(rows, list) or not all(isinstance(row, dict) and "p50_ms" in row for row in rows):
        raise BenchError(f"{path}: is no result of `companion bench detector --json`: it has no rows")
    found: dict[str, Any] = result
    return found


def memory_mb() -> float:
    """Of this process, resident now."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return round(int(line.split()[1]) / 1024, 1)
    raise BenchError("/proc/self/status has no memory figures")


def _key(row: dict[str, Any]) -> tuple[Any, ...]:
    return tuple(row.get(name) for name in ("runtime", "precision", "threads"))


def main() -> int:
    order = json.loads(sys.stdin.readline())
    try:
        from vision.detector import Detector

        detector = Detector(
            order["model"],
            image_size=order["image_size"],
            threads=order["threads"],
            precision=order["precision"],
            device=order.get("device", "cpu"),
            classes=order["classes"],
            runtime=order["runtime"],
        )
        images = np.load(order["images"])
        detector.detect(images[0])
    except (ValueError, OSError, RuntimeError) as error:  # sent to the caller
        print(json.dumps({"error": " ".join(str(error).split())}), flush=True)
        return 1
    said = {"runtime": detector.runtime, "precision": detector.precision, "threads": detector.threads}
    print(json.dumps({**said, "memory_mb": memory_mb()}), flush=True)
    for line in sys.stdin:
        times = []
        before = time.process_time()
        for number in range(int(line)):
            detector.detect(images[number % len(images)])
            timing = detector.last_timing
            assert timing is not None
            times.append([timing.preprocess_ms, timing.inference_ms, timing.postprocess_ms])
        spent = {"processor_s": time.process_time() - before, "memory_mb": memory_mb()}
        print(json.dumps({"times_ms": times, **spent}), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
