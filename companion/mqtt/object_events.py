"""What happens to the objects that the cameras see, one event at a time: new, update, lost, end."""

from __future__ import annotations

import base64
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any
from uuid import uuid4

from companion.host.clock import unix_offset_ns

UPDATE_INTERVAL_S = 1.0
SNAPSHOT_WAIT_S = 1.0
# Objects and events beyond this are of a fault: the oldest are forgotten.
_MOST_OBJECTS = 1000
_MOST_WAITING = 200


@dataclass(slots=True)
class _Seen:
    """An object that was announced. `tracks`: its tracks that have not ended; `lost`: those not detected."""

    name: str
    tracks: set[int] = field(default_factory=set)
    lost: set[int] = field(default_factory=set)
    said_ns: int = 0


@dataclass(frozen=True, slots=True)
class ObjectEvent:
    """One event, as JSON is made of it.

    Attributes:
        about: vehicle, camera, id, class and place. The id is constant while the image tracker changes its
            own.
        snapshot: JPEG of the first published image that is not older than a `new`; None: none came in time,
            or another event.
    """

    kind: str
    camera: str | None
    about: dict[str, Any]
    snapshot: bytes | None = None

    def body(self, *, with_snapshot: bool) -> dict[str, Any]:
        """Return the body of a message, with the snapshot as base64 where asked for."""
        image = {} if self.snapshot is None else {"snapshot": base64.b64encode(self.snapshot).decode()}
        return {"event_type": self.kind, **self.about, **(image if with_snapshot else {})}


class ObjectEvents:
    """Makes events of the topic `tracks` of all cameras of one vehicle, and adds a snapshot to each `new`.

    Args:
        want_image: called with a camera and whether its next images are needed.
        unix_offset_ns: Unix time minus the clock of the stamps.
    """

    def __init__(
        self,
        want_image: Callable[[str | None, bool], None],
        unix_offset_ns: Callable[[], int] = unix_offset_ns,
    ) -> None:
        self._want_image, self._unix_offset_ns = want_image, unix_offset_ns
        self._objects: dict[tuple[str | None, str], _Seen] = {}
        self._of_track: dict[tuple[str | None, int], tuple[str | None, str]] = {}
        # Of each camera with a `new` that waits for its image: events in their order, and when it is sent
        # without one.
        self._waiting: dict[str | None, tuple[deque[ObjectEvent], int]] = {}

    def on_tracks(self, body: dict[str, Any], now_ns: int) -> list[ObjectEvent]:
        """Process a message of the topic; returns what is to be sent now. `now_ns`: of the stamps' clock."""
        camera = body["camera"]
        sent: list[ObjectEvent] = []
        for kind, about in self._events(camera, body):
            event = ObjectEvent(kind, camera, about)
            if camera in self._waiting:
                waiting, _ = self._waiting[camera]
                if len(waiting) < _MOST_WAITING or kind != "update":
                    waiting.append(event)
            elif kind == "new":
                self._waiting[camera] = deque([event]), now_ns + int(SNAPSHOT_WAIT_S * 1e9)
                self._want_image(camera, True)
            else:
                sent.append(event)
        return sent

    def on_image(self, camera: str | None, captured_ns: int, jpeg: bytes) -> list[ObjectEvent]:
        """Process a published image; returns what has waited for it."""
        waiting, _ = self._waiting.get(camera, (None, 0))
        if not waiting or captured_ns < waiting[0].about["stamp_ns"]:
            return []
        # The image of the first may be older than another `new` behind it.
        return self._sent(camera, lambda event: jpeg if captured_ns >= event.about["stamp_ns"] else None)

    def due(self, now_ns: int) -> list[ObjectEvent]:
        """Return what has waited for an image too long."""
        late = [camera for camera, (_, until_ns) in self._waiting.items() if now_ns >= until_ns]
        return [event for camera in late for event in self._sent(camera, lambda _: None)]

    def _sent(self, camera: str | None, image: Callable[[ObjectEvent], bytes | None]) -> list[ObjectEvent]:
        waiting, _ = self._waiting.pop(camera)
        self._want_image(camera, False)
        return [
            ObjectEvent(event.kind, camera, event.about, image(event) if event.kind == "new" else None)
            for event in waiting
        ]

    def _events(self, camera: str | None, body: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
        for event in body["events"]:
            kind, track, stamp_ns = event["event"], event["track_id"], event["stamp_ns"]
            key = self._key(camera, event)
            seen = self._objects.get(key)
            if kind == "end":
                self._of_track.pop((camera, track), None)
                if seen is None:
                    continue
                seen.tracks.discard(track)
                seen.lost.discard(track)
                if seen.tracks:
                    continue
                del self._objects[key]
            elif kind == "lost":
                if seen is None:
                    continue
                seen.lost.add(track)
                if seen.lost != seen.tracks:
                    continue
            elif seen is None:
                kind = "new"  # or its first event here
                seen = self._objects[key] = _Seen(key[1])
                while len(self._objects) > _MOST_OBJECTS:
                    self._objects.pop(next(iter(self._objects)))
            else:
                kind = "update"
                again = bool(seen.lost) and seen.lost == seen.tracks
                seen.tracks.add(track)
                seen.lost.discard(track)
                if not again and stamp_ns - seen.said_ns < UPDATE_INTERVAL_S * 1e9:
                    continue
            if kind in ("new", "update"):
                seen.tracks.add(track)
                seen.said_ns = stamp_ns
            yield kind, self._about(seen.name, body, event)

    def _key(self, camera: str | None, event: dict[str, Any]) -> tuple[str | None, str]:
        """Return the object of a track: as it was announced, else that of its `object_id`, else its own."""
        track, number = event["track_id"], event["object_id"]
        own = self._of_track.get((camera, track))
        if own is not None:
            return own
        key = camera, f"track-{track}" if number is None else f"object-{number}"
        if event["event"] in ("new", "update"):
            self._of_track[camera, track] = key
            while len(self._of_track) > _MOST_OBJECTS:
                self._of_track.pop(next(iter(self._of_track)))
        return key

    def _about(self, name: str, body: dict[str, Any], event: dict[str, Any]) -> dict[str, Any]:
        offset_ns, ellipse = self._unix_offset_ns(), event["error_ellipse"]
        left, top, right, bottom = event["xyxy"]
        width, height = body["width"], body["height"]
        place = ("latitude_deg", "longitude_deg", "altitude_amsl_m", "moving")
        times = {"time": "stamp_ns", "first_seen": "first_ns", "last_seen": "last_ns"}
        return {
            "event_id": uuid4().hex,
            "vehicle": body["vehicle"],
            "camera": body["camera"],
            "id": name,
            "class": event["class_name"],
            **{key: event[key] for key in ("track_id", "object_id", "confidence", "stamp_ns", *place)},
            **{key: _utc(event[stamp] + offset_ns) for key, stamp in times.items()},
            # Fractions of the image.
            "box": [round(each, 4) for each in (left / width, top / height, right / width, bottom / height)],
            "error_m": None if ellipse is None else ellipse["semi_major_m"],
        }


def _utc(unix_ns: int) -> str:
    """Return ISO 8601 with milliseconds."""
    text = datetime.fromtimestamp(unix_ns / 1e9, UTC).isoformat(timespec="milliseconds")
    return text.replace("+00:00", "Z")
