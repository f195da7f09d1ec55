"""What the service keeps of the workers' results: status, durations of the stages, live tracks."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum

from vision.pipeline import PerceptionResult
from vision.tracking import Track, TrackEvent, TrackEventKind


class PerceptionState(StrEnum):
    """State of the supervisor."""

    STOPPED = "stopped"
    STARTING = "starting"
    RUNNING = "running"
    RESTARTING = "restarting"
    FINISHED = "finished"  # the source has ended
    FAILED = "failed"  # repeatedly; tried again every 30 s


@dataclass(frozen=True, slots=True)
class PerceptionStatus:
    """A snapshot of perception.

    Attributes:
        pid: of the worker; None while there is none.
        restarts: since the start.
        frames: frames that the workers have read.
        results: results received.
        rate_hz: results a second, over the last two seconds.
        newest: the newest result; None before the first.
        age_s: of the newest result, from its capture.
        timing_ms: stage → milliseconds of the newest result.
        timing_p50_ms, timing_p99_ms: stage → median and 99th percentile of the newest 200 results,
            milliseconds. `publish` is the time from the worker's result to its publication.
        dropped: frames lost before they were processed, and results replaced by newer ones before sending.
        frames_skipped: reason → frames that were not processed, or whose result was replaced by a newer one
            before it was sent (`superseded`); see `PerceptionResult`.
        frames_repeated: kind of image → frames that repeated it; see `PerceptionResult`.
        stuck_after_s: the silence after which the worker is stuck.
        class_names: classes of the model; empty before the start and without a detector.
        tracks: confirmed tracks that have not ended.
        runtime: runtime of the network; None before the start and without a network.
        runtime_reason: why this runtime and precision, as text.
        problem: the last error, empty if none.
    """

    state: PerceptionState
    pid: int | None = None
    restarts: int = 0
    frames: int = 0
    results: int = 0
    rate_hz: float = 0.0
    newest: PerceptionResult | None = None
    age_s: float | None = None
    timing_ms: Mapping[str, float] = field(default_factory=dict)
    timing_p50_ms: Mapping[str, float] = field(default_factory=dict)
    timing_p99_ms: Mapping[str, float] = field(default_factory=dict)
    dropped: int = 0
    frames_skipped: Mapping[str, int] = field(default_factory=dict)
    frames_repeated: Mapping[str, int] = field(default_factory=dict)
    stuck_after_s: float | None = None
    class_names: tuple[str, ...] = ()
    tracks: int = 0
    runtime: str | None = None
    runtime_reason: str = ""
    problem: str = ""


WINDOW = 200


class StageTimes:
    """Keeps each stage's newest `WINDOW` durations, milliseconds."""

    def __init__(self) -> None:
        self._times: dict[str, deque[float]] = {}

    def add(self, timing_ms: Mapping[str, float]) -> None:
        """Add one result's durations."""
        for stage, value in timing_ms.items():
            self._times.setdefault(stage, deque(maxlen=WINDOW)).append(value)

    def quantile_ms(self, share: float) -> dict[str, float]:
        """Return stage → quantile `share` (0..1) by nearest rank."""
        return {stage: _nearest_rank(sorted(values), share) for stage, values in self._times.items()}


def _nearest_rank(ascending: list[float], share: float) -> float:
    return ascending[math.ceil(share * len(ascending)) - 1]


class LiveTracks:
    """The confirmed tracks that have not ended, across worker restarts: ids stay unique.

    Attributes:
        next_id: the next worker's first track id, above every id so far.
    """

    def __init__(self) -> None:
        self.next_id = 1
        self._live: dict[int, Track] = {}
        self._orphans: tuple[Track, ...] = ()

    def __len__(self) -> int:
        return len(self._live)

    def update(self, result: PerceptionResult) -> PerceptionResult:
        """Apply a result; returns it with END events for the previous worker's tracks."""
        stamp_ns = result.captured_ns
        ends = tuple(TrackEvent(TrackEventKind.END, stamp_ns, track) for track in self._orphans)
        self._orphans = ()
        for event in result.track_events:
            if event.kind is TrackEventKind.END:
                self._live.pop(event.track.track_id, None)
            else:
                self._live[event.track.track_id] = event.track
            self.next_id = max(self.next_id, event.track.track_id + 1)
        track_id = result.detections.track_id
        if track_id is not None and len(track_id):
            self.next_id = max(self.next_id, int(track_id.max()) + 1)
        return replace(result, track_events=ends + result.track_events) if ends else result

    def worker_ended(self) -> tuple[Track, ...]:
        """End all tracks, and return them; their END events are added to the next worker's first result."""
        ended = tuple(self._live.values())
        self._orphans += ended
        self._live.clear()
        return ended
