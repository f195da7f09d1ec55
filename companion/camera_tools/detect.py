"""`companion detect`: what is found in a source's frames, as lines, JSON and images.

One loop, the service's own pipeline, processes the frames. Parts print what was found in each, and draw it.
"""

from __future__ import annotations

import json
import logging
import math
import sys
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from companion.bus.messages import depth_message, obstacles_message
from companion.perception.assembly import CameraTelemetry, build_pipeline
from companion.settings import Settings
from vision.annotate import annotate, annotate_level
from vision.detections import TRACK_CONFIRMED, DetectionRecord, Detections
from vision.frame import Frame
from vision.image_file import is_image
from vision.levelling import Levelling
from vision.obstacle_sectors import SECTOR_RAD
from vision.pipeline import FrameDetector, PerceptionResult
from vision.sources import EndOfStream, Source, SourceError, SourceStatistics
from vision.tracking import TrackerSettings

logger = logging.getLogger(__name__)

TRACK_FIELDS = ("track_id", "track_score", "track_state")
RANGE_FIELDS = ("depth_m", "nearest_camera_m")
# Subfolder of `--save` for the annotated images, so that no name of the source is taken twice.
ANNOTATED = "detections"
# Weaker detections do not confirm a track by default, so the service does not act on them.
FAINT_BELOW = TrackerSettings().confirm_score
GREY_DIVISOR = 3
_RATE_WINDOW_S = 2.0
# Of a source whose depth is paired with its images, the first frames may have none.
_DEPTH_TIMEOUT_S = 2.0
_READ_TIMEOUT_S = 0.5

Image = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Seen:
    """A frame, and what the pipeline found in it.

    Attributes:
        rate_hz: of the source; None before its second frame.
    """

    frame: Frame
    result: PerceptionResult
    rate_hz: float | None


@dataclass(frozen=True, slots=True)
class Shown:
    """What a part says of a frame: keys of the JSON object, and lines of text."""

    message: dict[str, Any]
    lines: Sequence[str]


class Part(Protocol):
    """What is measured in each frame.

    Attributes:
        needs_depth: frames without depth are left out.
        ends: the loop ends after the first frame.
    """

    needs_depth: bool
    ends: bool

    def show(self, seen: Seen) -> Shown:
        """Say what was found. Raises OSError if a file cannot be written."""
        ...

    def draw(self, seen: Seen, image: Image) -> Image:
        """Draw it onto the frame's image; returns a copy."""
        ...

    def panel(self, seen: Seen) -> Sequence[str]:
        """Lines for the panel at the image's upper left."""
        ...


class PlainPart:
    """A part that draws nothing."""

    needs_depth = False
    ends = False

    def draw(self, seen: Seen, image: Image) -> Image:
        """Return the image as it is."""
        return image

    def panel(self, seen: Seen) -> Sequence[str]:
        """No lines."""
        return ()


class Boxes(PlainPart):
    """The detected objects, and the time that they took.

    Args:
        tracked: there is a tracker. ranged: with the objects' distances.
    """

    def __init__(self, *, tracked: bool, ranged: bool) -> None:
        self._omitted = (*(() if ranged else RANGE_FIELDS), *(() if tracked else TRACK_FIELDS))
        self._ranged = ranged

    def show(self, seen: Seen) -> Shown:
        """The detections."""
        timing_ms, records = seen.result.timing_ms, seen.result.detections.records()
        total_ms = sum(timing_ms[stage] for stage in ("preprocess", "inference", "postprocess"))
        labels = ", ".join(self._label(record) for record in records)
        message = {
            "inference_ms": round(timing_ms["inference"], 2),
            "detections": [
                {key: value for key, value in record.items() if key not in self._omitted}
                for record in records
            ],
        }
        return Shown(message, [f"{total_ms:6.1f} ms  {labels or 'no objects detected'}"])

    def draw(self, seen: Seen, image: Image) -> Image:
        """Boxes with labels."""
        return annotate(image, seen.result.detections, faint_below=FAINT_BELOW)

    def _label(self, record: DetectionRecord) -> str:
        """Return `car 0.83 #7 6.84 m`, with a question mark if the track is not confirmed."""
        label = f"{record['class_name']} {record['confidence']:.2f}"
        if (track_id := record.get("track_id")) is not None:
            label += f" #{track_id}{'' if record.get('track_state') == TRACK_CONFIRMED else '?'}"
        return f"{label} {_metres(record['depth_m'])}" if self._ranged else label


class Distances(PlainPart):
    """The depth at the image's centre, and the obstacles around a vehicle of known attitude."""

    needs_depth = True

    def __init__(self, vehicle: str) -> None:
        self._vehicle = vehicle

    def show(self, seen: Seen) -> Shown:
        """The messages of the topics `depth` and `obstacles`."""
        depth = depth_message(seen.result, self._vehicle, time.monotonic_ns())
        line = f"centre {_metres(depth['centre_m'])}  {depth['valid_share']:6.1%} valid"
        obstacles = seen.result.obstacles
        if obstacles is None:
            return Shown({"depth": depth, "obstacles": None}, [line])
        seen_m = [(value, index) for index, value in enumerate(obstacles.distance_m) if math.isfinite(value)]
        if seen_m:
            nearest_m, index = min(seen_m)
            line += f"  obstacle {nearest_m:.2f} m at {math.degrees(index * SECTOR_RAD):.0f} deg"
        return Shown({"depth": depth, "obstacles": obstacles_message(obstacles, self._vehicle)}, [line])


class SourceStatus(PlainPart):
    """What the source delivers: its topic, size, rate, stamps and losses.

    Args:
        topic: where the service publishes this source's images.
    """

    def __init__(self, source: Source, topic: str) -> None:
        self._source, self._topic = source, topic

    def show(self, seen: Seen) -> Shown:
        """Rate, age and losses."""
        statistics = self._source.statistics
        message = {
            "source": self._source.uri,
            "topic": self._topic,
            "rate_hz": None if seen.rate_hz is None else round(seen.rate_hz, 2),
            "age_ms": round(_age_ms(seen.frame), 1),
            "dropped": statistics.dropped,
            "unreadable": statistics.unreadable,
        }
        return Shown(message, ["  ".join(self.panel(seen))])

    def panel(self, seen: Seen) -> Sequence[str]:
        """Device, topic, size and rate, stamp and losses."""
        frame, statistics = seen.frame, self._source.statistics
        rate = "" if seen.rate_hz is None else f"  {seen.rate_hz:.1f} Hz"
        return (
            self._source.uri,
            self._topic,
            f"{frame.width}x{frame.height}{rate}",
            f"stamp {frame.captured_ns / 1e9:.3f} s, {_age_ms(frame):.0f} ms ago",
            f"frame {frame.sequence}, {statistics.dropped} dropped, {statistics.unreadable} unreadable",
        )


@dataclass(frozen=True, slots=True)
class Output:
    """Where it goes.

    Attributes:
        write: called with each line.
        as_json: one JSON object per frame instead of readable lines.
        save: folder for each input; its subfolder `detections` gets the annotated image of the same name. An
            image keeps its file name; the frames of a video are `<name>_<sequence>.jpg`, others
            `<sequence>.jpg`.
        grey: the annotated image in grey, a third as wide and high. level: levels it.
        period_s: interval of frames that are shown, seconds; 0: every one.
        limit: number of frames that are shown, after which it ends; None: with the source.
    """

    write: Callable[[str], None]
    as_json: bool = False
    save: Path | None = None
    grey: bool = False
    level: Levelling | None = None
    period_s: float = 0.0
    limit: int | None = None


@dataclass
class Summary:
    """What `detect_source` processed."""

    frames: int = 0
    shown: int = 0
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
    settings: Settings,
    detector: FrameDetector | None,
    parts: Sequence[Part],
    output: Output,
    telemetry: CameraTelemetry,
    *,
    every: int = 1,
) -> Summary:
    """Process the frames of an open source as the service does, until it ends, its limit, or Ctrl-C.

    A recording is tracked by its own time.

    Args:
        settings: of the source, detector, tracker, camera and markers. detector: None: no detection.
        every: process every Nth frame.

    Raises:
        SourceError: the source failed, or has no depth though a part needs it.
        OSError: a file cannot be written.
        ValueError: the lens is of images of another aspect.
    """
    writer = _Writer(source, parts, output)
    pipeline = build_pipeline(
        settings, _EveryNth(source, every), detector, telemetry, recorder=writer, tracker_stamp_ns=_stamp_ns
    )
    with (
        _progress(source, every, output.limit) as writer.advance,
        suppress(KeyboardInterrupt),
    ):
        with suppress(EndOfStream):
            while not writer.ended:
                pipeline.step(_READ_TIMEOUT_S, writer.deliver)
                writer.check_depth()
        writer.finish()
    statistics = source.statistics
    if statistics.dropped or statistics.unreadable:
        logger.warning("%d frames dropped, %d unreadable", statistics.dropped, statistics.unreadable)
    return writer.summary


class _EveryNth(Source):
    """The first frame of a source, and every Nth after it."""

    def __init__(self, source: Source, every: int) -> None:
        self.uri, self.live = source.uri, source.live
        self._source, self._every, self._skip = source, every, 0

    @property
    def statistics(self) -> SourceStatistics:
        """Those of the source."""
        return self._source.statistics

    def read(self, timeout_s: float = 1.0) -> Frame | None:
        """The next one of them; None also for another one."""
        frame = self._source.read(timeout_s)
        if frame is None:
            return None
        self._skip = (self._skip or self._every) - 1
        return frame if self._skip == self._every - 1 else None

    def close(self) -> None:
        """Nothing: the source is closed by who opened it."""


class _Writer:
    """Prints and saves each frame that the pipeline has processed."""

    def __init__(self, source: Source, parts: Sequence[Part], output: Output) -> None:
        self.summary = Summary()
        self.ended = False
        self.advance: Callable[[], None] = lambda: None
        self._source, self._parts, self._output = source, parts, output
        self._needs_depth = any(part.needs_depth for part in parts)
        self._meter = RateMeter()
        self._result: PerceptionResult | None = None
        self._waiting: Seen | None = None
        self._started_s = time.monotonic()
        self._due_s = self._started_s

    def deliver(self, result: PerceptionResult) -> None:
        """Take the result of the frame that comes next."""
        self._result = result

    def write(self, frame: Frame, _detections: Detections, /) -> None:
        """Take a frame, after its result. Raises OSError if a file cannot be written."""
        result, self._result = self._result, None
        seen_rate_hz = self._meter.add(frame.captured_ns, frame.sequence)
        if result is None or (self._needs_depth and frame.depth_m is None):
            return
        summary = self.summary
        summary.frames += 1
        summary.elapsed_s = time.monotonic() - self._started_s
        summary.objects.update(record["class_name"] for record in result.detections.records())
        self.advance()
        seen = Seen(frame, result, seen_rate_hz)
        # The first frame has no rate yet.
        early = seen_rate_hz is None and self._output.period_s > 0.0 and summary.shown == 0
        if early or time.monotonic() < self._due_s:
            self._waiting = seen
            return
        self._due_s = time.monotonic() + self._output.period_s
        self._show(seen)

    def check_depth(self) -> None:
        """Raise SourceError if there is no depth for too long at the start."""
        waited_s = time.monotonic() - self._started_s
        if self._needs_depth and not self.summary.frames and waited_s > _DEPTH_TIMEOUT_S:
            self._refuse_without_depth()

    def finish(self) -> None:
        """Show the only frame of a source that ended too early for its rate."""
        if self._needs_depth and not self.summary.frames and self._meter.seen:
            self._refuse_without_depth()
        if self._waiting is not None and not self.summary.shown:
            self._show(self._waiting)

    def _refuse_without_depth(self) -> None:
        raise SourceError(
            f"{self._source.uri}: its frames have no depth: use a source with depth (shm://NAME), or set "
            "source.depth"
        )

    def _show(self, seen: Seen) -> None:
        output, frame = self._output, seen.frame
        shown = [part.show(seen) for part in self._parts]
        if output.as_json:
            message = _frame_message(frame)
            for each in shown:
                message |= each.message
            output.write(json.dumps(message))
        else:
            for each in shown:
                for line in each.lines:
                    output.write(f"{_place(frame)}  {line}")
        if output.save is not None:
            stem = _image_name(frame)
            _write_image(output.save / stem, frame.image)
            _write_image(output.save / ANNOTATED / stem, self._drawn(seen))
        self.summary.shown += 1
        self.ended = any(part.ends for part in self._parts) or self.summary.shown == output.limit

    def _drawn(self, seen: Seen) -> Image:
        frame, image = seen.frame, seen.frame.image
        for part in self._parts:
            image = part.draw(seen, image)
        frame = replace(frame, image=image)
        if self._output.grey:
            frame = _small_and_grey(frame)
        lines = [line for part in self._parts for line in part.panel(seen)]
        return annotate_level(frame, Detections.empty(()), self._output.level, lines=lines)


class RateMeter:
    """The rate of a source over the last two seconds, at least two frames, by stamps: lost frames count."""

    def __init__(self) -> None:
        self.seen: deque[tuple[int, int]] = deque()

    def add(self, captured_ns: int, sequence: int) -> float | None:
        """Add a frame; returns the rate in Hz, None before the second frame."""
        self.seen.append((captured_ns, sequence))
        while len(self.seen) > 2 and captured_ns - self.seen[0][0] > _RATE_WINDOW_S * 1e9:
            self.seen.popleft()
        first_ns, first = self.seen[0]
        return (sequence - first) * 1e9 / (captured_ns - first_ns) if captured_ns > first_ns else None


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


def _age_ms(frame: Frame) -> float:
    return (time.monotonic_ns() - frame.captured_ns) / 1e6


def _metres(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.2f} m"


def _frame_message(frame: Frame) -> dict[str, Any]:
    return {
        **({"file": frame.file_name} if frame.file_name else {}),
        **({"media_s": round(frame.media_s, 3)} if frame.media_s is not None and _is_video(frame) else {}),
        "sequence": frame.sequence,
        "captured_ns": frame.captured_ns,
        "width": frame.width,
        "height": frame.height,
    }


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


def _image_name(frame: Frame) -> str:
    name = Path(frame.file_name)
    stem, suffix = f"{frame.sequence:06d}", ".jpg"
    if _is_video(frame):
        stem = f"{name.stem}_{stem}"
    elif frame.file_name:
        stem = name.stem
        suffix = name.suffix if cv2.haveImageWriter(f"image{name.suffix}") else f"{name.suffix}.jpg"
    return f"{stem}{suffix}"


def _small_and_grey(frame: Frame) -> Frame:
    size = (max(frame.width // GREY_DIVISOR, 1), max(frame.height // GREY_DIVISOR, 1))
    small = cv2.resize(cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY), size, interpolation=cv2.INTER_AREA)
    image = cv2.cvtColor(small, cv2.COLOR_GRAY2BGR).astype(np.uint8, copy=False)
    depth_m = frame.depth_m
    if depth_m is not None:
        depth_m = cv2.resize(depth_m, size, interpolation=cv2.INTER_NEAREST).astype(np.float32, copy=False)
    return replace(frame, image=image, depth_m=depth_m)


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
