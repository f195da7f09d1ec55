"""What a command is about: an object of a class, or exactly one track; and which tracks there are.

A command for a track that has ended is refused, and a behaviour that has lost its track ends; both name the
track that is there now. While it is flown to, its object may get a new id from the image tracker, for example
after it has left the image for a moment. It is followed on where it is expected (see `MovingTrack`), and the
new id is reported. An object that was seen beside it never takes its place.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass

from companion.guidance.objects.from_markers import marker_name
from companion.guidance.objects.target import DOUBTED, UNCONFIRMED_MARKER, Target
from companion.guidance.objects.tracked_object import TrackedObject
from companion.vehicle.gimbal import GimbalAim
from vision.attitude import wrap_angle

# An ended track is remembered for this long, and at most so many are.
MEMORY_S, MEMORY_TRACKS = 120.0, 256
# A track took the place of a lost one if it is within this of it, and for each second since.
NEAR_M, NEAR_MPS = 2.0, 1.0


@dataclass(frozen=True, slots=True)
class Subject:
    """The objects that a command is about: those of a class, one track, or one printed marker."""

    class_name: str = ""
    track_id: int | None = None
    marker_id: int | None = None

    def __post_init__(self) -> None:
        given = (bool(self.class_name), self.track_id is not None, self.marker_id is not None)
        if sum(given) != 1:
            raise ValueError(
                "expected one of class, track and marker, got "
                f"{self.class_name!r}, {self.track_id} and {self.marker_id}"
            )

    @property
    def class_names(self) -> tuple[str, ...]:
        """The classes that the detector must know."""
        return (self.class_name,) if self.class_name else ()

    @property
    def name(self) -> str:
        """`car`, `track 17`, or `marker 7`."""
        if self.marker_id is not None:
            return marker_name(self.marker_id)
        return self.class_name or f"track {self.track_id}"

    @property
    def phrase(self) -> str:
        """`the car`, `track 17`, or `marker 7`."""
        return f"the {self.class_name}" if self.class_name else self.name

    def phrase_now(self, track_id: int | None) -> str:
        """`phrase` with the id that the object has now: `track 31 (was 20)`."""
        if self.track_id is None or track_id in (None, self.track_id):
            return self.phrase
        return f"track {track_id} (was {self.track_id})"

    def means(self, seen: TrackedObject) -> bool:
        """Whether an object is one of these."""
        if self.track_id is not None:
            return seen.track_id == self.track_id
        return seen.class_name == (self.class_name or self.name)

    def of(self, targets: Collection[Target], confidence: float = 0.0) -> list[Target]:
        """These objects' targets with at least a confidence; of `BehaviourContext.targets_of`."""
        return [
            target
            for target in targets
            if (
                target.track_id == self.track_id
                if self.track_id is not None
                else target.class_name == (self.class_name or self.name)
            )
            and target.score >= confidence
        ]

    def same(self, targets: Collection[Target], last: Target, confidence: float = 0.0) -> list[Target]:
        """Those that may be the object that was seen last: of its class, with any id."""
        return Subject(last.class_name).of(targets, confidence)

    @property
    def doubted(self) -> str:
        """The reason when it was seen and never trusted."""
        return DOUBTED if self.marker_id is None else UNCONFIRMED_MARKER

    def new_id(self, before: int | None, after: int | None) -> list[str]:
        """The note that the object of a track has another id now; empty: there is nothing to say."""
        if self.track_id is None or before == after:
            return []
        return [f"{self.name}: the object is track {after} now"]


@dataclass(frozen=True, slots=True)
class RecentTracks:
    """The newest target of each track of the last `MEMORY_S`, newest first.

    Attributes:
        max_age_s: a track unseen for so long has ended (`tracker.max_age_s`).
    """

    targets: tuple[Target, ...] = ()
    max_age_s: float = 2.0

    def newest(self, track_id: int) -> Target | None:
        """The newest target of a track."""
        return next((target for target in self.targets if target.track_id == track_id), None)

    def present(self, now_ns: int) -> list[Target]:
        """Those that have not ended."""
        return [t for t in self.targets if now_ns - t.captured_ns <= self.max_age_s * 1e9]

    def updated(self, seen: Collection[Target]) -> RecentTracks:
        """With the targets of a frame; of one that is already included, unchanged."""
        tracked = {target.track_id: target for target in seen if target.track_id is not None}
        if not tracked or next(iter(tracked.values())).captured_ns <= self._newest_ns:
            return self
        newest_ns = max(target.captured_ns for target in tracked.values())
        others = [
            t
            for t in self.targets
            if t.track_id not in tracked and newest_ns - t.captured_ns <= MEMORY_S * 1e9
        ]
        return RecentTracks((*tracked.values(), *others)[:MEMORY_TRACKS], self.max_age_s)

    @property
    def _newest_ns(self) -> int:
        return self.targets[0].captured_ns if self.targets else -1

    def missing(self, track_id: int, now_ns: int) -> str | None:
        """Why a track cannot be chosen, and what can be instead; None: it is there."""
        last, present = self.newest(track_id), self.present(now_ns)
        if last in present:
            return None
        gone = f"no track {track_id}"
        if last is not None:
            ago_s = (now_ns - last.captured_ns) / 1e9 - self.max_age_s
            gone = f"track {track_id} ended {ago_s:.0f} s ago"
            nearest = _nearest(last, [t for t in present if t.trusted and t.class_name == last.class_name])
            if nearest is not None:
                there = f"{_apart_text(last, nearest)} from where {track_id} was last seen"
                return (
                    f"{gone}; the nearest {nearest.class_name} now is track {nearest.track_id}, {there}: "
                    f"give track={nearest.track_id}"
                )
        counts = Counter(target.class_name for target in present if target.trusted)
        if not counts:
            return f"{gone}; no confirmed track is present (tracks need tracker.enabled)"
        shown = ", ".join(f"{count} {name}" for name, count in sorted(counts.items()))
        return f"{gone}; present: {shown}; give the track_id of one, from the topic detections"

    def replacement(self, lost: Target, now_ns: int, place: tuple[float, float] | None = None) -> str:
        """Which track took the place of a lost one, to be added to a reason; empty: none near.

        Args:
            place: where the object is expected now, north and east; None: where it was last seen.
        """
        if lost.track_id is None:
            return ""
        where = place or (None if lost.position_ned_m is None else lost.position_ned_m[:2])
        since = [
            t
            for t in self.present(now_ns)
            if t.trusted and t.class_name == lost.class_name and t.track_id != lost.track_id
        ]
        if where is None or not since:
            return ""
        near_m = NEAR_M + NEAR_MPS * (now_ns - lost.captured_ns) / 1e9
        apart_m, nearest = min(((_distance_m(t, where), t) for t in since), key=lambda pair: pair[0])
        if apart_m > near_m:
            return ""
        there = f"{apart_m:.1f} m from where it was {'expected' if place is not None else 'last seen'}"
        return f"; track {nearest.track_id}, a {nearest.class_name}, is {there}"


NO_TRACKS = RecentTracks()


@dataclass(frozen=True, slots=True)
class GlobalPoint:
    """A place to point the gimbal at: WGS 84, and metres above home."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float = 0.0


# Where to point the gimbal: a direction, an object, or a place.
GimbalGoal = GimbalAim | Subject | GlobalPoint


def newest_of(
    wanted: Subject, seen: Target | None, targets: Collection[Target], tracks: RecentTracks, now_ns: int
) -> Target | None:
    """The newest detection of a track, or of the best object of a class; None: none.

    The object of a class stays the same until its track has ended. Without tracks it is the one in the
    direction nearest to the last.

    Args:
        seen: the object's last detection. targets: of the newest frame.
    """
    if wanted.track_id is not None:
        return tracks.newest(wanted.track_id)
    trusted = [target for target in wanted.of((*targets, *tracks.present(now_ns))) if target.trusted]
    if seen is None or now_ns - seen.captured_ns > tracks.max_age_s * 1e9:
        return max(trusted, key=lambda target: target.score, default=None)
    if seen.track_id is None:
        return min(trusted, key=lambda target: _off_rad(seen, target), default=None)
    return next((target for target in wanted.of(targets) if target.track_id == seen.track_id), None)


def _distance_m(target: Target, place: tuple[float, float]) -> float:
    return math.inf if target.position_ned_m is None else math.dist(target.position_ned_m[:2], place)


def _nearest(last: Target, candidates: list[Target]) -> Target | None:
    """The one nearest to where another was last seen: by distance, else by direction."""

    def rank(target: Target) -> tuple[float, float]:
        known = None if last.position_ned_m is None else last.position_ned_m[:2]
        return (math.inf if known is None else _distance_m(target, known), _off_rad(last, target))

    return min(candidates, key=rank, default=None)


def _off_rad(first: Target, second: Target) -> float:
    return math.hypot(
        wrap_angle(first.bearing_rad - second.bearing_rad), first.elevation_rad - second.elevation_rad
    )


def _apart_text(first: Target, second: Target) -> str:
    if first.position_ned_m is not None and second.position_ned_m is not None:
        return f"{math.dist(first.position_ned_m[:2], second.position_ned_m[:2]):.1f} m"
    return f"{math.degrees(_off_rad(first, second)):.0f}°"
