"""The perception worker's loop: read a frame, detect, track, measure ranges, deliver the result."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from vision.depth import DepthSummary, depth_summary
from vision.detections import Detections
from vision.frame import Frame
from vision.frame_changes import FrameChanges
from vision.frame_selection import FrameSelector
from vision.marker_boards import BoardPose
from vision.markers import Marker
from vision.object_detector import Timing
from vision.obstacle_sectors import ObstacleSectors
from vision.sources import Source
from vision.tracking import CameraView, ObjectSelection, Tracker, TrackEvent

SurfacesIn = Callable[[Frame, NDArray[np.float32]], tuple[NDArray[np.float32], NDArray[np.float32]]]


@dataclass(frozen=True, slots=True)
class PerceptionResult:
    """What was detected in one frame. Small and picklable.

    Attributes:
        sequence: the frame's. A gap: frames that were not processed.
        captured_ns: CLOCK_MONOTONIC nanoseconds of the frame's capture.
        inferred_ns: when the detections were ready.
        width, height: the frame's size, pixels.
        detections: in the frame's pixels, with tracks if there is a tracker, and with their nearest points if
            the frame has depth.
        timing_ms: stage → milliseconds. `capture`: from the capture stamp until the bytes arrived; `decode`;
            `wait`: until the frame was read; then `preprocess`, `inference`, `postprocess`, `track`, `range`;
            `total`: from reading the frame to here.
        dropped: frames lost so far between the source and here; frames skipped on purpose do not count.
        frames_skipped: reason → frames so far that were not processed. `replaced` by a newer one,
            `unreadable`; and on purpose `rate`.
        track_events: oldest first; all since the previous result.
        markers: those in the frame; None if marker detection is off.
        obstacles: distance of the nearest one in each direction; None without depth or attitude.
        boards: those of the markers that belong to a board.
        depth: of the frame's depth image; None without one.
        image_since_ns, depth_since_ns: as of `Frame`.
        frames_repeated: frames so far with the colour image (`image`), or the `depth`, of the frame before.

    >>> from vision import Detections, PerceptionResult
    >>> result = PerceptionResult(
    ...     0, 1_000_000, 9_000_000, 640, 480, Detections.empty(("car",)), {"total": 8.0}, dropped=0
    ... )
    >>> (result.inferred_ns - result.captured_ns) / 1e6  # milliseconds
    8.0
    """

    sequence: int
    captured_ns: int
    inferred_ns: int
    width: int
    height: int
    detections: Detections
    timing_ms: dict[str, float]
    dropped: int
    track_events: tuple[TrackEvent, ...] = ()
    frames_skipped: Mapping[str, int] = field(default_factory=dict)
    markers: tuple[Marker, ...] | None = None
    obstacles: ObstacleSectors | None = None
    boards: tuple[BoardPose, ...] = ()
    depth: DepthSummary | None = None
    image_since_ns: int | None = None
    depth_since_ns: int | None = None
    frames_repeated: Mapping[str, int] = field(default_factory=dict)

    @property
    def since_ns(self) -> int:
        """Capture of the oldest of the identical images that this result was made of."""
        stamps = (self.captured_ns, self.image_since_ns, self.depth_since_ns)
        return min(stamp for stamp in stamps if stamp is not None)


class FrameDetector(Protocol):
    """The part of `vision.object_detector.ObjectDetector` that the pipeline needs."""

    @property
    def class_names(self) -> tuple[str, ...]: ...
    @property
    def last_timing(self) -> Timing | None: ...
    def detect(self, image_bgr: NDArray[np.uint8], /) -> Detections: ...


class FrameRecorder(Protocol):
    """Records frames; for example `vision.recording.Recording`."""

    def write(self, frame: Frame, detections: Detections, /) -> None: ...


class Pipeline:
    """Source → detector → tracker → range → result, one frame per step.

    Attributes:
        frames: frames read so far.
        tracker: of every processed frame; None without one or without a detector.
        object_selection: follows an object that an operator selects; None without a tracker.

    >>> import tempfile
    >>> import cv2, numpy as np
    >>> from vision import PerceptionResult, Pipeline, open_source
    >>> folder = tempfile.TemporaryDirectory()
    >>> cv2.imwrite(f"{folder.name}/photo.png", np.zeros((120, 160, 3), np.uint8))
    True
    >>> results: list[PerceptionResult] = []
    >>> with open_source(f"{folder.name}/photo.png") as source:
    ...     Pipeline(source, detector=None).step(1.0, results.append)
    True
    >>> [(result.sequence, result.width) for result in results]
    [(0, 160)]
    """

    def __init__(
        self,
        source: Source,
        detector: FrameDetector | None,
        *,
        max_rate_hz: float | None = None,
        recorder: FrameRecorder | None = None,
        tracker: Tracker | None = None,
        view_at: Callable[[Frame], CameraView | None] = lambda _: None,
        find_markers: Callable[[Frame], tuple[tuple[Marker, ...], tuple[BoardPose, ...]]] | None = None,
        obstacles_in: Callable[[Frame], ObstacleSectors | None] = lambda _: None,
        surfaces_in: SurfacesIn | None = None,
        clock_ns: Callable[[], int] = time.monotonic_ns,
        tracker_stamp_ns: Callable[[Frame], int] = lambda frame: frame.captured_ns,
    ) -> None:
        """
        Args:
            source: open; the caller closes it.
            detector: None: no detection, every result is empty.
            max_rate_hz: of the frames that are processed; None: all. The others are only recorded.
            recorder: receives every frame with the newest detections, after the result is delivered.
            tracker: receives the detections of every processed frame.
            view_at: returns the camera orientation at a frame's capture, None if unknown. Called after the
                detection, when the vehicle's attitude of that moment has arrived.
            find_markers: called for every processed frame; returns the markers and the boards.
            obstacles_in: called for every processed frame with depth.
            surfaces_in: returns nearest points (N, 3) and middles (N,) of the objects in boxes (N, 4) of a
                frame with depth, see `vision.depth.surfaces`; None: no ranges are measured.
            clock_ns: the clock of the frames' stamps, CLOCK_MONOTONIC nanoseconds.
            tracker_stamp_ns: the tracker's time of a frame, nanoseconds; a recording may have its own time.
        """
        self._source = source
        self._detector = detector
        self._selector = FrameSelector(max_rate_hz)
        self._changes = FrameChanges()
        self._recorder = recorder
        self.tracker = tracker if detector is not None else None
        self.object_selection: ObjectSelection | None = None
        if self.tracker is not None:
            self.object_selection = ObjectSelection(self.tracker.settings, self.tracker.take_id)
        self._view_at = view_at
        self._find_markers = find_markers
        self._obstacles_in = obstacles_in
        self._surfaces_in = surfaces_in
        self._clock_ns = clock_ns
        self._tracker_stamp_ns = tracker_stamp_ns
        self._newest = Detections.empty(detector.class_names if detector else ())
        self._next_sequence = 0
        self._missing = 0
        self._replaced = 0
        self.frames = 0

    @property
    def frames_skipped(self) -> dict[str, int]:
        """Reason → frames so far that were not processed; see `PerceptionResult`."""
        unreadable = self._source.statistics.unreadable
        # The source counts an unreadable frame before the gap it leaves; the count must not decrease.
        self._replaced = max(self._replaced, self._missing - unreadable)
        return {"replaced": self._replaced, "unreadable": unreadable, "rate": self._selector.skipped}

    @property
    def frames_repeated(self) -> dict[str, int]:
        """Kind of image → frames so far that repeated it; see `PerceptionResult`."""
        return self._changes.repeated

    @property
    def dropped(self) -> int:
        """Frames lost so far between the source and here; frames skipped on purpose do not count."""
        return self._missing

    def step(self, timeout_s: float, deliver: Callable[[PerceptionResult], None]) -> bool:
        """Read one frame, process it if selected, pass the result to `deliver`, then record the frame.

        Returns:
            False if no frame arrived within `timeout_s`.

        Raises:
            EndOfStream, SourceError: from the source.
        """
        frame = self._source.read(timeout_s)
        if frame is None:
            return False
        picked_ns = self._clock_ns()
        frame = self._changes.stamped(frame)
        self._missing += max(0, frame.sequence - self._next_sequence)
        self._next_sequence = frame.sequence + 1
        self.frames += 1
        if self._selector.accept(frame):
            result = self._process(frame, picked_ns)
            self._newest = result.detections
            deliver(result)
        if self._recorder is not None:
            self._recorder.write(frame, self._newest)
        return True

    def _process(self, frame: Frame, picked_ns: int) -> PerceptionResult:
        started_ns = time.perf_counter_ns()
        timing_ms = {"decode": frame.decode_ms}
        if frame.ready_ns:
            arrival_ms = (frame.ready_ns - frame.captured_ns) / 1e6
            timing_ms["capture"] = max(arrival_ms - frame.decode_ms, 0.0)
            timing_ms["wait"] = (picked_ns - frame.ready_ns) / 1e6
        if self._detector is None:
            detections = self._newest
        else:
            detections = self._detector.detect(frame.image)
            timing = self._detector.last_timing
            if timing is not None:
                timing_ms["preprocess"] = timing.preprocess_ms
                timing_ms["inference"] = timing.inference_ms
                timing_ms["postprocess"] = timing.postprocess_ms
        detected_ns = time.perf_counter_ns()
        events: tuple[TrackEvent, ...] = ()
        if self.tracker is not None:
            view = self._view_at(frame)
            tracked = self.tracker.update(detections, self._tracker_stamp_ns(frame), view, frame.image)
            if self.object_selection is not None:
                tracked = self.object_selection.update(frame, tracked, view)
            detections, events = tracked.detections, tracked.events
        tracked_ns = time.perf_counter_ns()
        timing_ms["track"] = (tracked_ns - detected_ns) / 1e6
        obstacles, depth = None, None
        if frame.depth_m is not None:
            obstacles, depth = self._obstacles_in(frame), depth_summary(frame.depth_m)
            if self._surfaces_in is not None:
                nearest, middle_px = self._surfaces_in(frame, detections.xyxy)
                detections = replace(detections, nearest_camera_m=nearest, middle_px=middle_px)
        ranged_ns = time.perf_counter_ns()
        timing_ms["range"] = (ranged_ns - tracked_ns) / 1e6
        markers, boards = (None, ()) if self._find_markers is None else self._find_markers(frame)
        done_ns = time.perf_counter_ns()
        if markers is not None:
            timing_ms["markers"] = (done_ns - ranged_ns) / 1e6
        timing_ms["total"] = (done_ns - started_ns) / 1e6
        return PerceptionResult(
            sequence=frame.sequence,
            captured_ns=frame.captured_ns,
            inferred_ns=self._clock_ns(),
            width=frame.width,
            height=frame.height,
            detections=detections,
            timing_ms=timing_ms,
            dropped=self.dropped,
            track_events=events,
            frames_skipped=self.frames_skipped,
            markers=markers,
            obstacles=obstacles,
            boards=boards,
            depth=depth,
            image_since_ns=frame.image_since_ns,
            depth_since_ns=frame.depth_since_ns,
            frames_repeated=self.frames_repeated,
        )
