"""Tracks across worker restarts: ids stay unique, and the tracks of a dead worker end."""

from __future__ import annotations

from dataclasses import replace

from vision.pipeline import PerceptionResult
from vision.tracking import Track, TrackEvent, TrackEventKind


class LiveTracks:
    """The confirmed tracks that have not ended.

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

    def worker_ended(self) -> None:
        """End all tracks; their END events are added to the next worker's first result."""
        self._orphans += tuple(self._live.values())
        self._live.clear()
