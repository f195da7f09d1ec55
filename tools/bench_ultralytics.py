"""Ultralytics and this detector on the same images in the same run, in turn; for development only.

Each contestant is a process of its own (`companion.bench.detector`), and they take turns, so that whatever
else the machine does falls on all alike. Ultralytics is measured as anybody calls it, `predict` on an image:
as installed (it chooses its threads), with the threads forced, and on its own OpenVINO export.

    python -m tools.bench_ultralytics --model yolov8n.pt --python OTHER_VENV/bin/python --threads 2

Ultralytics (AGPL-3.0) runs in its own environment, `OTHER_VENV`, which needs nothing of this project but
numpy. At the end are ratios of wall time and of processor time; a busy machine changes the latter less.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

os.environ.setdefault("YOLO_OFFLINE", "1")
os.environ.setdefault("YOLO_AUTOINSTALL", "false")

CONTESTANTS = ("as-installed", "forced-threads", "own-openvino")
OURS = ("torch", "onnxruntime", "openvino")


def contestant() -> int:
    """The process that is measured; see `companion.bench.detector`."""
    sys.path.insert(0, str(Path(__file__).parents[1]))
    from companion.bench.detector import memory_mb

    order = json.loads(sys.stdin.readline())
    sys.stdout = sys.stderr  # their messages must not mix with the answers
    import torch
    from ultralytics import YOLO

    images = np.load(order["images"])
    model = YOLO(order["model"], task="detect")
    size = list(images.shape[1:3])

    def predict(image: Any) -> list[float]:
        started = time.perf_counter()
        result = model.predict(image, imgsz=size, device="cpu", verbose=False)[0]
        total_ms = (time.perf_counter() - started) * 1e3
        before, network = result.speed["preprocess"], result.speed["inference"]
        return [before, network, total_ms - before - network]

    predict(images[0])
    # After the first call: it sets its own number then.
    if order["threads"] is not None:
        torch.set_num_threads(order["threads"])
    name = f"ultralytics {order['name']}"
    # What OpenVINO takes inside Ultralytics is its own affair.
    threads = "own" if order["name"] == "own-openvino" else torch.get_num_threads()
    _say({"runtime": name, "precision": "float32", "threads": threads, "memory_mb": memory_mb()})
    for line in sys.stdin:
        before = time.process_time()
        times = [predict(images[number % len(images)]) for number in range(int(line))]
        spent = {"processor_s": time.process_time() - before, "memory_mb": memory_mb()}
        _say({"times_ms": times, **spent})
    return 0


def _say(what: dict[str, Any]) -> None:
    sys.__stdout__.write(json.dumps(what) + "\n")  # type: ignore[union-attr]
    sys.__stdout__.flush()  # type: ignore[union-attr]


_EXPORT = """
import sys
from ultralytics import YOLO
size = [int(number) for number in sys.argv[2:]]
YOLO(sys.argv[1]).export(format="openvino", imgsz=size, half=False, verbose=False)
"""


def export_openvino(python: Path, model: Path, folder: Path, size: tuple[int, int]) -> Path:
    """Their export of a copy of the checkpoint, for one size (height, width)."""
    copy = folder / model.name
    shutil.copyfile(model, copy)
    command = [str(python), "-c", _EXPORT, str(copy), *map(str, size)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    exported = copy.with_name(f"{copy.stem}_openvino_model")
    if done.returncode or not exported.is_dir():
        raise RuntimeError(f"{python}: cannot export {model}: {done.stderr.strip()[-300:]}")
    return exported


def ratios(rows: list[dict[str, Any]]) -> list[str]:
    """Each of ours against each of theirs: the share of the time and of the processor time."""
    theirs = [row for row in rows if row["runtime"].startswith("ultralytics")]
    return [
        f"{ours['runtime']}: {ours['p50_ms'] / other['p50_ms']:.2f} of the time (p50), "
        f"{ours['processor_ms'] / other['processor_ms']:.2f} of the processor time of {other['runtime']}"
        for other in theirs
        for ours in rows
        if ours not in theirs
    ]


def main() -> int:
    parser = argparse.ArgumentParser(description="Ultralytics and ours, measured in turn.")
    parser.add_argument("--model", type=Path, required=True)
    parser.add_argument("--python", type=Path, default=Path(sys.executable), help="has ultralytics")
    parser.add_argument("--threads", type=int, default=2, help="ours, and theirs where forced")
    parser.add_argument("--frames", type=int, default=50)
    parser.add_argument("--frame", default="640x480")
    parser.add_argument("--only", default="", help="of " + ", ".join((*CONTESTANTS, *OURS)))
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    from companion.bench.detector import Measured, draw_images, in_turn, machine, table

    width, height = (int(number) for number in arguments.frame.split("x"))
    wanted = arguments.only.split(",") if arguments.only else [*CONTESTANTS, *OURS]
    measured: list[Measured] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        order: dict[str, Any] = {
            "model": str(arguments.model),
            "images": str(draw_images(folder / "images.npy", width, height)),
            "image_size": max(width, height),
            "precision": "auto",
            "classes": None,
        }
        try:
            for one in wanted:
                if one in OURS:
                    command = [sys.executable, "-m", "companion.bench.detector"]
                    asked = {"runtime": one, "threads": arguments.threads}
                else:
                    command = [str(arguments.python), __file__, "--contestant"]
                    asked = {"name": one, "threads": arguments.threads if one == "forced-threads" else None}
                    if one == "own-openvino":
                        asked["model"] = str(
                            export_openvino(arguments.python, arguments.model, folder, (height, width))
                        )
                measured.append(Measured(one, command, order | asked))
            in_turn(measured, arguments.frames)
            rows = [one.figures() for one in measured]
        finally:
            for one in measured:
                one.close()
    result = {"machine": machine(), "frame": arguments.frame, "rows": rows}
    if arguments.json:
        print(json.dumps(result))
        return 0
    for line in table(result):
        print(line)
    for line in ratios(rows):
        print(line)
    return 0


if __name__ == "__main__":
    sys.exit(contestant() if "--contestant" in sys.argv else main())
