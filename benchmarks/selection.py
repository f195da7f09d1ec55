"""How long the correlation filters keep a selected object, on rendered sequences with known truth.

Each object that is at least 70 % visible at the start of a sequence is selected by its true box, alone; no
detector looks. Scenes and cameras are those of `benchmarks.tracking`, at 15 frames a second, a tenth of them
missing; the attitude arrives with noise.

python -m benchmarks.selection [--seeds 210..219] [--seconds 10] [--json]
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from benchmarks.scenes import CLASS_NAMES, MOTIONS, Motion, SceneFrame, scene_frames
from benchmarks.tracking import attitudes_of, view_of
from vision.detections import Detections
from vision.frame import Frame
from vision.tracking import ObjectSelection, SelectRequest, TrackedFrame, TrackerSettings
from vision.tracking.association import overlaps

MIN_VISIBLE, RATE_HZ, DROPPED = 0.7, 15.0, 0.1
# A box with less overlap is on something else; reported so in this many frames in a row, the object is lost.
WRONG_IOU, WRONG_FRAMES = 0.1, 3


@dataclass(frozen=True, slots=True)
class Kept:
    """One selected object.

    Attributes:
        kept_s: until the box was on something else, or the track ended. of_s: length of the sequence.
        wrong: share of the frames in which a box on something else was reported.
        median_iou: of the reported frames with the object visible, until it was lost.
    """

    camera: str
    class_name: str
    kept_s: float
    of_s: float
    wrong: float
    median_iou: float


def selected(motion: Motion, seed: int, seconds: float, timing_ms: list[float] | None = None) -> list[Kept]:
    """Every object of one sequence."""
    frames = list(scene_frames(motion, seconds=seconds, rate_hz=RATE_HZ, seed=seed, drop=DROPPED))
    first = frames[0]
    chosen = np.flatnonzero(first.counts & (first.visible >= MIN_VISIBLE))
    return [_one(motion, frames, int(index), seed, seconds, timing_ms) for index in chosen]


def _one(
    motion: Motion,
    frames: Sequence[SceneFrame],
    index: int,
    seed: int,
    seconds: float,
    timing_ms: list[float] | None,
) -> Kept:
    first = frames[0]
    height, width = first.image.shape[:2]
    left, top, right, bottom = first.xyxy[index].tolist()
    attitudes = attitudes_of(motion, seconds, seed)
    ids = iter(range(1, 1000))
    selection = ObjectSelection(TrackerSettings(), lambda: next(ids))
    rectangle = (left / width, top / height, (right - left) / width, (bottom - top) / height)
    selection.request(SelectRequest(rectangle))
    nothing = Detections.empty(CLASS_NAMES)
    nothing = Detections(
        nothing.xyxy,
        nothing.confidence,
        nothing.class_id,
        CLASS_NAMES,
        track_id=np.zeros(0, np.int64),
        track_score=np.zeros(0, np.float32),
        track_confirmed=np.zeros(0, np.bool_),
    )
    ious: list[float] = []
    kept_s = frames[-1].time_s
    wrong, in_a_row, over = 0, 0, False
    for number, frame in enumerate(frames):
        image = Frame(frame.image, frame.captured_ns, number)
        begun_ns = time.thread_time_ns()
        shown = selection.update(image, TrackedFrame(nothing, ()), view_of(attitudes, frame.captured_ns))
        if timing_ms is not None and number:
            timing_ms.append((time.thread_time_ns() - begun_ns) / 1e6)
        if any(event.kind.value == "end" for event in shown.events):
            kept_s = kept_s if over else frame.time_s
            break
        truth = np.flatnonzero(frame.identity == first.identity[index])
        if not len(shown.detections):
            continue
        iou = float(overlaps(shown.detections.xyxy, frame.xyxy[truth]).max(initial=0.0))
        hidden = not len(truth) or not frame.counts[truth[0]]
        if iou < WRONG_IOU:
            wrong, in_a_row = wrong + 1, in_a_row + 1
        else:
            in_a_row = 0
        if in_a_row == WRONG_FRAMES and not over:
            over, kept_s = True, frame.time_s
        if not over and not hidden:
            ious.append(iou)
    name = CLASS_NAMES[int(first.class_id[index])]
    median = float(np.median(ious)) if ious else math.nan
    return Kept(motion.name, name, kept_s, frames[-1].time_s, wrong / len(frames), median)


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.selection")
    parser.add_argument("--seeds", default="210..219", help="first..last seed")
    parser.add_argument("--seconds", type=float, default=10.0, help="length of each rendered sequence")
    parser.add_argument("--json", action="store_true", help="print each object as one JSON line")
    given = parser.parse_args(arguments)
    cv2.setNumThreads(1)
    lowest, _, highest = given.seeds.partition("..")
    timing_ms: list[float] = []
    kept = [
        one
        for seed in range(int(lowest), int(highest or lowest) + 1)
        for motion in MOTIONS
        for one in selected(motion, seed, given.seconds, timing_ms)
    ]
    if given.json:
        for one in kept:
            print(json.dumps({name: getattr(one, name) for name in Kept.__slots__}))
    print(table(kept))
    print(
        "per frame, ms of processor time: p50 {:.1f}, p95 {:.1f}".format(*np.percentile(timing_ms, (50, 95)))
    )


def table(kept: Sequence[Kept]) -> str:
    """The figures by camera and class, as Markdown."""
    lines = [
        "| camera | object | n | kept to the end | kept, median | frames on something else | median IoU |",
        "|---|---|---|---|---|---|---|",
    ]
    groups = [*sorted({(one.camera, one.class_name) for one in kept}), ("all", "all")]
    for camera, name in groups:
        of_group = [one for one in kept if name == "all" or (one.camera, one.class_name) == (camera, name)]
        whole = sum(one.kept_s >= one.of_s for one in of_group)
        seconds = float(np.median([one.kept_s for one in of_group]))
        wrong = float(np.mean([one.wrong for one in of_group]))
        iou = float(np.nanmedian([one.median_iou for one in of_group]))
        lines.append(
            f"| {camera} | {name} | {len(of_group)} | {whole} | {seconds:.1f} s | {wrong:.1%} | {iou:.2f} |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
