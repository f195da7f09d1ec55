"""`companion detect`: run the detector on a source's frames, one line per frame."""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from vision.annotate import annotate
from vision.detections import TRACK_CONFIRMED, DetectionRecord, Detections
from vision.frame import Frame
from vision.pipeline import FrameDetector
from vision.sources import Source
from vision.tracking import Tracker

logger = logging.getLogger(__name__)

TRACK_FIELDS = ("track_id", "track_score", "track_state")


def detect_source(
    source: Source,
    detector: FrameDetector,
    *,
    every: int = 1,
    limit: int | None = None,
    save: Path | None = None,
    as_json: bool = False,
    tracker: Tracker | None = None,
    write: Callable[[str], None],
) -> int:
    """Detect in every `every`-th frame, at most `limit` of them.

    Args:
        tracker: assigns tracks; a recording is tracked by its own time.
        save: folder for `<sequence>.jpg` (the input) and `<sequence>_detections.jpg` (annotated).
        as_json: one JSON object per frame instead of a readable line.
        write: called with each line.

    Returns:
        Number of processed frames.

    Raises:
        OSError: an image cannot be written.
    """
    if save is not None:
        save.mkdir(parents=True, exist_ok=True)
    processed = 0
    with _progress(source, every, limit) as advance:
        for index, frame in enumerate(source):
            if index % every:
                continue
            detections = detector.detect(frame.image)
            if tracker is not None:
                detections = tracker.update(detections, _stamp_ns(frame)).detections
            write(_line(frame, detections, detector, as_json))
            if save is not None:
                _save(save, frame, detections)
            processed += 1
            advance()
            if processed == limit:
                break
    statistics = source.statistics
    if statistics.dropped or statistics.unreadable:
        logger.warning("%d frames dropped, %d unreadable", statistics.dropped, statistics.unreadable)
    return processed


def _stamp_ns(frame: Frame) -> int:
    return frame.captured_ns if frame.media_s is None else round(frame.media_s * 1e9)


def _line(frame: Frame, detections: Detections, detector: FrameDetector, as_json: bool) -> str:
    timing = detector.last_timing
    assert timing is not None
    if not as_json:
        total_ms = timing.preprocess_ms + timing.inference_ms + timing.postprocess_ms
        objects = ", ".join(_label(record) for record in detections.records())
        return f"{frame.sequence:6d}  {total_ms:6.1f} ms  {objects or 'no objects detected'}"
    # There are no ranges here, and without a tracker no tracks.
    omitted = (
        ("depth_m", "nearest_camera_m")
        if detections.track_id is not None
        else ("depth_m", "nearest_camera_m", *TRACK_FIELDS)
    )
    message: dict[str, Any] = {
        "sequence": frame.sequence,
        "captured_ns": frame.captured_ns,
        "width": frame.width,
        "height": frame.height,
        "inference_ms": round(timing.inference_ms, 2),
        "detections": [
            {key: value for key, value in record.items() if key not in omitted}
            for record in detections.records()
        ],
    }
    return json.dumps(message)


def _label(record: DetectionRecord) -> str:
    """Return `car 0.83 #7`, with a question mark if the track is not confirmed."""
    label = f"{record['class_name']} {record['confidence']:.2f}"
    if (track_id := record.get("track_id")) is None:
        return label
    return f"{label} #{track_id}{'' if record.get('track_state') == TRACK_CONFIRMED else '?'}"


def _save(folder: Path, frame: Frame, detections: Detections) -> None:
    _write_image(folder / f"{frame.sequence:06d}.jpg", frame.image)
    _write_image(folder / f"{frame.sequence:06d}_detections.jpg", annotate(frame.image, detections))


def _write_image(path: Path, image: NDArray[np.uint8]) -> None:
    if not cv2.imwrite(str(path), image):
        raise OSError(f"cannot write {path}: check free disk space and write permission")


def _progress(source: Source, every: int, limit: int | None) -> AbstractContextManager[Callable[[], None]]:
    """Return a progress bar on standard error for finite sources, if it is a terminal."""
    if source.total_frames is None or not sys.stderr.isatty():
        return nullcontext(lambda: None)
    frames = -(-source.total_frames // every)
    return _Bar(frames if limit is None else min(frames, limit))


class _Bar:
    """A progress bar as a context manager that returns its advance function."""

    def __init__(self, total: int) -> None:
        self._progress = Progress(
            TextColumn("detecting"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            console=Console(stderr=True),
            transient=True,
        )
        self._task = self._progress.add_task("detecting", total=total)

    def __enter__(self) -> Callable[[], None]:
        self._progress.start()
        return lambda: self._progress.advance(self._task)

    def __exit__(self, *_: object) -> None:
        self._progress.stop()
