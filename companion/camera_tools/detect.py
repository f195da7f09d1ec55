"""`companion detect`: run the detector on a source's frames, one line per frame, and a summary."""

from __future__ import annotations

import json
import logging
import sys
import time
from collections import Counter
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
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
from vision.image_file import is_image
from vision.pipeline import FrameDetector
from vision.sources import Source
from vision.tracking import Tracker, TrackerSettings

logger = logging.getLogger(__name__)

TRACK_FIELDS = ("track_id", "track_score", "track_state")
# Subfolder of `--save` for the annotated images, so that no name of the source is taken twice.
ANNOTATED = "detections"
# Weaker detections do not confirm a track by default, so the service does not act on them.
FAINT_BELOW = TrackerSettings().confirm_score


@dataclass
class Summary:
    """What `detect_source` processed."""

    frames: int = 0
    elapsed_s: float = 0.0
    objects: Counter[str] = field(default_factory=Counter)
    """class name → number of detections in all frames"""

    def __str__(self) -> str:
        found = ", ".join(f"{count} {name}" for name, count in self.objects.most_common())
        return (
            f"{self.frames} frame{'' if self.frames == 1 else 's'}, "
            f"{self.frames / max(self.elapsed_s, 1e-9):.1f} frames/s: {found or 'no objects detected'}"
        )


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
) -> Summary:
    """Detect in every `every`-th frame, at most `limit` of them.

    Args:
        tracker: assigns tracks; a recording is tracked by its own time.
        save: folder for each input; its subfolder `detections` gets the annotated image of the same name. An
            image keeps its file name; the frames of a video are `<name>_<sequence>.jpg`, others
            `<sequence>.jpg`.
        as_json: one JSON object per frame instead of a readable line.
        write: called with each line.

    Raises:
        OSError: an image cannot be written.
    """
    summary = Summary()
    started_s = time.monotonic()
    with _progress(source, every, limit) as advance:
        for index, frame in enumerate(source):
            if index % every:
                continue
            detections = detector.detect(frame.image)
            if tracker is not None:
                detections = tracker.update(detections, _stamp_ns(frame), image=frame.image).detections
            write(_line(frame, detections, detector, as_json))
            if save is not None:
                _save(save, frame, detections)
            summary.objects.update(record["class_name"] for record in detections.records())
            summary.frames += 1
            summary.elapsed_s = time.monotonic() - started_s
            advance()
            if summary.frames == limit:
                break
    statistics = source.statistics
    if statistics.dropped or statistics.unreadable:
        logger.warning("%d frames dropped, %d unreadable", statistics.dropped, statistics.unreadable)
    return summary


def make_save_folder(folder: Path, source: str) -> None:
    """Create the folder for `detect_source`'s images.

    Raises:
        ValueError: it is a file, cannot be created, or contains the source's images.
    """
    images = Path(source)
    if images.exists() and folder.resolve() in (images.resolve(), images.resolve().parent):
        raise ValueError(
            f"--save {folder}: this folder contains the source; give another, so that no image is overwritten"
        )
    try:
        (folder / ANNOTATED).mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise ValueError(f"--save {folder}: expected a folder, got a file; give another name") from None
    except OSError as error:
        raise ValueError(f"--save {folder}: the folder cannot be created: {error.strerror}") from error


def _stamp_ns(frame: Frame) -> int:
    return frame.captured_ns if frame.media_s is None else round(frame.media_s * 1e9)


def _line(frame: Frame, detections: Detections, detector: FrameDetector, as_json: bool) -> str:
    timing = detector.last_timing
    assert timing is not None
    if not as_json:
        total_ms = timing.preprocess_ms + timing.inference_ms + timing.postprocess_ms
        objects = ", ".join(_label(record) for record in detections.records())
        return f"{_place(frame)}  {total_ms:6.1f} ms  {objects or 'no objects detected'}"
    # There are no ranges here, and without a tracker no tracks.
    omitted = (
        ("depth_m", "nearest_camera_m")
        if detections.track_id is not None
        else ("depth_m", "nearest_camera_m", *TRACK_FIELDS)
    )
    message: dict[str, Any] = {
        **({"file": frame.file_name} if frame.file_name else {}),
        **({"media_s": round(frame.media_s, 3)} if frame.media_s is not None and _is_video(frame) else {}),
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


def _is_video(frame: Frame) -> bool:
    return bool(frame.file_name) and not is_image(Path(frame.file_name))


def _place(frame: Frame) -> str:
    """Return `photo.jpg`, `street.mp4  12.480 s`, or the sequence number of a frame without a file."""
    name = frame.file_name
    if not name:
        return f"{frame.sequence:6d}"
    if not name.isprintable():  # a line end, or bytes that are not UTF-8
        name = name.encode("unicode_escape").decode()
    if frame.media_s is None or not _is_video(frame):
        return name
    return f"{name}  {frame.media_s:8.3f} s"


def _label(record: DetectionRecord) -> str:
    """Return `car 0.83 #7`, with a question mark if the track is not confirmed."""
    label = f"{record['class_name']} {record['confidence']:.2f}"
    if (track_id := record.get("track_id")) is None:
        return label
    return f"{label} #{track_id}{'' if record.get('track_state') == TRACK_CONFIRMED else '?'}"


def _save(folder: Path, frame: Frame, detections: Detections) -> None:
    name = Path(frame.file_name)
    stem, suffix = f"{frame.sequence:06d}", ".jpg"
    if _is_video(frame):
        stem = f"{name.stem}_{stem}"
    elif frame.file_name:
        stem = name.stem
        suffix = name.suffix if cv2.haveImageWriter(f"image{name.suffix}") else f"{name.suffix}.jpg"
    _write_image(folder / f"{stem}{suffix}", frame.image)
    drawn = annotate(frame.image, detections, faint_below=FAINT_BELOW)
    _write_image(folder / ANNOTATED / f"{stem}{suffix}", drawn)


def _write_image(path: Path, image: NDArray[np.uint8]) -> None:
    # Encoded in memory: OpenCV crashes on a name that is not UTF-8.
    done, data = cv2.imencode(path.suffix, image)
    if not done:
        raise OSError(f"cannot write {path}: OpenCV cannot encode this image as {path.suffix}")
    try:
        path.write_bytes(data.tobytes())
    except OSError as error:
        raise OSError(f"cannot write {path}: {error.strerror}") from error


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
