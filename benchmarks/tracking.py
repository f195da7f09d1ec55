"""What tracking is worth: the same detections with and without it, on rendered sequences with known truth.

python -m benchmarks.tracking [--seconds 12] [--rate-hz 30] [--model yolov8n.pt] [--json]
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from benchmarks.clear_mot import Labelled, MotScore, clear_mot
from benchmarks.scenes import (
    CAMERA,
    MOTIONS,
    MOUNT,
    Motion,
    SceneFrame,
    SyntheticDetector,
    scene_frames,
)
from companion.bench.percentiles import percentiles
from vision.detections import NO_TRACK, Detections
from vision.tracking import AttitudeHistory, CameraView, Tracker, TrackerSettings, TrackState
from vision.tracking.association import overlaps
from vision.tracking.tracks import XYXY

ATTITUDE_RATE_HZ = 50.0
# Of the attitudes, one sigma: an autopilot's estimate against the image of a camera that is well mounted.
ATTITUDE_NOISE_RAD = 0.002
SAME_IOU = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """One frame's truth and what a detector made of it."""

    frame: SceneFrame
    detections: Detections


def measure_tracking(
    seconds: float, *, rate_hz: float, model: str | None, seed: int = 0, drop: float = 0.1
) -> dict[str, object]:
    """Every motion's sequence, without tracking, with it, and with the camera's turning removed.

    Args:
        rate_hz: of the camera; `drop` of its frames are missing.
        model: a checkpoint that looks at the rendered images; None: boxes made of the truth, with faults.

    Raises:
        CheckpointError: the model cannot be read.
    """
    detect = _looking(model) if model is not None else SyntheticDetector(seed).detect
    settings = TrackerSettings()
    timing_ms: list[float] = []
    figures: dict[str, object] = {"detector": model or "drawn", "rate_hz": rate_hz, "dropped_share": drop}
    for motion in MOTIONS:
        sequence = [
            Seen(frame, detect(frame))
            for frame in scene_frames(motion, seconds=seconds, rate_hz=rate_hz, seed=seed, drop=drop)
        ]
        attitudes = attitudes_of(motion, seconds, seed)
        ways = {
            "last frame": no_tracking(sequence, settings.keep_confidence),
            "tracker": tracked(sequence, settings, None),
            "tracker, attitude": tracked(sequence, settings, attitudes),
            "tracker, attitude, image": tracked(sequence, settings, attitudes, timing_ms, look=True),
            "tracks, attitude": believed(sequence, settings, attitudes),
        }
        for way, labelled in ways.items():
            figures[f"{motion.name}: {way}"] = _rounded(clear_mot(labelled))
    figures["tracker_ms"] = percentiles(timing_ms)
    return figures


def _looking(model: str) -> Callable[[SceneFrame], Detections]:
    from vision.detector import Detector

    detector = Detector(model, confidence=TrackerSettings().low_confidence)
    return lambda frame: detector.detect(frame.image)


def _rounded(score: MotScore) -> dict[str, float]:
    return {name: round(value, 3) for name, value in score.as_dict().items()}


def tracking_table(figures: dict[str, object]) -> Table:
    """The same for people."""
    table = Table(title=f"detector: {figures['detector']}, {figures['rate_hz']:g} frames a second")
    columns = {
        "MOTA": "mota",
        "switches": "switches",
        "fragments": "fragmentations",
        "misses": "misses",
        "false": "false_positives",
        "IDF1": "idf1",
    }
    table.add_column("camera")
    table.add_column("identities")
    for heading in columns:
        table.add_column(heading, justify="right")
    for name, score in figures.items():
        if isinstance(score, dict) and "mota" in score:
            table.add_row(*name.split(": "), *(f"{score[value]:g}" for value in columns.values()))
    return table


def no_tracking(sequence: Iterable[Seen], confidence: float) -> list[tuple[Labelled, Labelled]]:
    """The truth, and identities as they come without a tracker.

    A box takes the identity of the box of its class in the frame before that it overlaps most.
    """
    labelled = []
    next_identity = 1
    identities: list[int] = []
    before: Detections | None = None
    for seen in sequence:
        detections = seen.detections[seen.detections.confidence >= confidence]
        identities, known = [0] * len(detections), identities
        if before is not None and len(before) and len(detections):
            iou = overlaps(before.xyxy, detections.xyxy)
            iou[before.class_id[:, None] != detections.class_id[None, :]] = 0.0
            while iou.max() >= SAME_IOU:
                row, column = np.unravel_index(int(iou.argmax()), iou.shape)
                identities[column] = known[row]
                iou[row, :] = iou[:, column] = 0.0
        for index, identity in enumerate(identities):
            if not identity:
                identities[index] = next_identity
                next_identity += 1
        before = detections
        labelled.append(_against_truth(seen.frame, identities, detections.xyxy))
    return labelled


def tracked(
    sequence: Iterable[Seen],
    settings: TrackerSettings,
    attitudes: AttitudeHistory | None,
    timing_ms: list[float] | None = None,
    *,
    look: bool = False,
) -> list[tuple[Labelled, Labelled]]:
    """The truth, and the confirmed tracks."""
    tracker = Tracker(settings)
    labelled = []
    for seen in sequence:
        view = view_of(attitudes, seen.frame.captured_ns)
        image = seen.frame.image if look else None
        started_s = time.perf_counter()
        detections = tracker.update(seen.detections, seen.frame.captured_ns, view, image).detections
        if timing_ms is not None:
            timing_ms.append((time.perf_counter() - started_s) * 1e3)
        assert detections.track_id is not None
        assert detections.track_confirmed is not None
        shown = detections[detections.track_confirmed & (detections.track_id != NO_TRACK)]
        assert shown.track_id is not None
        labelled.append(_against_truth(seen.frame, shown.track_id.tolist(), shown.xyxy))
    return labelled


def believed(
    sequence: Iterable[Seen], settings: TrackerSettings, attitudes: AttitudeHistory | None
) -> list[tuple[Labelled, Labelled]]:
    """The truth, and the predicted positions of confirmed tracks until they are lost."""
    tracker = Tracker(settings)
    labelled = []
    for seen in sequence:
        stamp_ns = seen.frame.captured_ns
        tracker.update(seen.detections, stamp_ns, view_of(attitudes, stamp_ns))
        tracks = [
            track
            for track in tracker.tracks
            if track.state is TrackState.CONFIRMED
            and stamp_ns - track.last_ns < settings.coast_timeout_s * 1e9
            and _in_image(track.xyxy)
        ]
        boxes = np.array([track.xyxy for track in tracks]).reshape(-1, 4)
        labelled.append(_against_truth(seen.frame, [track.track_id for track in tracks], boxes))
    return labelled


def attitudes_of(motion: Motion, seconds: float, seed: int = 0) -> AttitudeHistory:
    """The attitude the autopilot reports during a sequence, with noise."""
    rng = np.random.default_rng((seed, 14))
    history = AttitudeHistory(keep_s=seconds + 2.0)
    for index in range(round(-0.5 * ATTITUDE_RATE_HZ), round((seconds + 0.5) * ATTITUDE_RATE_HZ)):
        time_s = index / ATTITUDE_RATE_HZ
        noise = rng.normal(0.0, ATTITUDE_NOISE_RAD / 2, 3)
        w, x, y, z = np.array(motion.attitude_wxyz(time_s)) + np.array([0.0, *noise])
        history.add(1_000_000_000 + round(time_s * 1e9), (float(w), float(x), float(y), float(z)))
    return history


def _in_image(xyxy: XYXY) -> bool:
    left, top, right, bottom = xyxy
    return 0 <= (left + right) / 2 < CAMERA.width and 0 <= (top + bottom) / 2 < CAMERA.height


def view_of(attitudes: AttitudeHistory | None, stamp_ns: int) -> CameraView | None:
    """The camera's orientation by the reported attitude; None: unknown."""
    ned_from_body = None if attitudes is None else attitudes.at(stamp_ns)
    return None if ned_from_body is None else CameraView(CAMERA, MOUNT.ned_from_optical(ned_from_body))


def _against_truth(
    frame: SceneFrame, identities: Sequence[int], xyxy: NDArray[np.floating]
) -> tuple[Labelled, Labelled]:
    """The frame's truth and its tracked boxes; a box on an object that need not be seen counts as neither."""
    truth = Labelled(frame.identity[frame.counts].tolist(), frame.xyxy[frame.counts])
    needless = overlaps(xyxy, frame.xyxy[~frame.counts]).max(axis=1, initial=0.0) >= 0.5
    needed = overlaps(xyxy, truth.xyxy).max(axis=1, initial=0.0) >= 0.5
    kept = ~needless | needed
    shown = [identity for identity, keep in zip(identities, kept, strict=True) if keep]
    return truth, Labelled(shown, xyxy[kept])


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.tracking")
    parser.add_argument("--seconds", type=float, default=12.0, help="length of each rendered sequence")
    parser.add_argument("--rate-hz", type=float, default=30.0, help="frame rate")
    parser.add_argument("--model", help="a checkpoint; default: boxes from ground truth")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    given = parser.parse_args(arguments)
    figures = measure_tracking(given.seconds, rate_hz=given.rate_hz, model=given.model, seed=given.seed)
    if given.json:
        print(json.dumps(figures))
        return
    Console().print(tracking_table(figures))
    print(f"tracker: {figures['tracker_ms']}")


if __name__ == "__main__":
    main()
