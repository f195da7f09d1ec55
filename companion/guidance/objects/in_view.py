"""The objects as behaviours see them: all of them, and the one that a command has chosen.

A command for a track that has ended is refused, and a behaviour that has lost its object ends; both name
what is there now. While it is flown to, an object may get a new id from the image tracker, for example after
it has left the image for a moment: it stays the same object, and the new id is reported.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field

from companion.guidance.motion import in_degrees
from companion.guidance.objects.target import RangeSource, Target
from companion.guidance.objects.tracked_object import MOST_DOUBT, Subject, TrackedObject
from companion.vehicle.state import Vector3
from vision.attitude import wrap_angle

# Candidates are collected for this long from the first confirmed object on, because a detector misses frames.
CHOOSING_S = 0.4
# Objects within this angle of the nose count as ahead; of these the nearest one is chosen.
BEFORE_RAD = math.radians(10.0)
# An object may have taken the place of a lost one if it is within this of it, and for each second since.
NEAR_M, NEAR_MPS = 2.0, 1.0


@dataclass(slots=True)
class Choice:
    """The object that a subject means: once chosen it stays, also while it is not seen.

    Attributes:
        last: the chosen object; None: none yet. Without a known range it may still change.
        begun_ns: since when it is looked for.
        since_ns: since when there are candidates; None: there are none.
        confidence: minimum of the candidates.
        noted_id: the newest track id that was reported.
    """

    last: TrackedObject | None = None
    begun_ns: int = 0
    since_ns: int | None = None
    confidence: float = 0.0
    noted_id: int | None = None


@dataclass(frozen=True, slots=True)
class ObjectsInView:
    """The objects of the steering camera at one step of guidance.

    Attributes:
        objects: all that are remembered, each as of its newest detection.
        markers: the printed markers, in the same form.
        now_ns: CLOCK_MONOTONIC nanoseconds.
        yaw_rad: of the vehicle, clockwise from north. here_ned_m: its position; None: not known.
        fault, marker_fault: why nothing new is seen of each, in words; empty: it is.
        ended_s: a track unseen for so long has ended.
    """

    objects: tuple[TrackedObject, ...] = ()
    markers: tuple[TrackedObject, ...] = ()
    now_ns: int = 0
    yaw_rad: float = 0.0
    here_ned_m: Vector3 | None = None
    fault: str = ""
    marker_fault: str = ""
    ended_s: float = 2.0
    _choices: dict[Subject, Choice] = field(default_factory=dict, compare=False, repr=False)

    def of(self, subject: Subject, confidence: float = 0.0) -> TrackedObject | None:
        """The object that a command means; None: not chosen yet, or its range was never known.

        Of a class it is the nearest confirmed one ahead. It stays the same until the command ends: unseen, it
        is returned as it was seen last (`unseen_s`, `lost`).

        Args:
            confidence: minimum of what is chosen, 0..1.
        """
        choice = self._choice(subject)
        choice.confidence = confidence
        if choice.last is None or choice.last.position_ned_m is None:
            self._choose(subject, choice)
        return None if choice.last is None or choice.last.position_ned_m is None else choice.last

    def in_sight(self, subject: Subject) -> Target | None:
        """The newest detection of what `of` chose, also while no range is known: where to look."""
        choice = self._choices.get(subject)
        return None if choice is None or choice.last is None else choice.last.detection

    def lost(self, subject: Subject, after_s: float) -> str | None:
        """Why there is no object, in words; None: it was seen, or looked for, for less than `after_s`."""
        choice = self._choice(subject)
        last = choice.last
        if last is None or last.position_ned_m is None:
            since_s = (self.now_ns - choice.begun_ns) / 1e9
            found = f"did not find {subject.phrase} in {since_s:.1f} s"
            why = "never seen with a known range"
            seen = [
                each
                for each in self._among(subject)
                if subject.means(each)
                and each.last_ns >= choice.begun_ns
                and each.detection.score >= choice.confidence
            ]
            if seen and not any(map(_certain, seen)):
                why = subject.doubted
        else:
            since_s = last.unseen_s(self.now_ns)
            found = f"lost {subject.phrase} for {since_s:.1f} s"
            why = self.where(last)
        if since_s <= after_s:
            return None
        return f"{found}: {self.fault_of(subject) or why}"

    def where(self, lost: TrackedObject) -> str:
        """Where a lost object is expected, in words, and which one may have taken its place."""
        if lost.position_ned_m is None:
            return "its range was never known"
        point = lost.position_at(self.now_ns)
        range_m = math.nan if self.here_ned_m is None else math.dist(point[:2], self.here_ned_m[:2])
        if lost.moving:
            north, east = lost.velocity_ned_mps
            towards = in_degrees(math.atan2(east, north))
            speed_mps = math.hypot(north, east)
            where = f"last expected {range_m:.1f} m away, moving at {speed_mps:.1f} m/s to {towards}°"
        else:
            where = f"last seen {range_m:.1f} m away"
        near = [
            (math.dist(each.position_ned_m[:2], point[:2]), each.object_id, each)
            for each in self._present(self.objects)
            if each.track_id is not None
            and each.position_ned_m is not None
            and each.confirmed
            and each.class_name == lost.class_name
            and each.object_id != lost.object_id
        ]
        if not near or min(near)[0] > NEAR_M + NEAR_MPS * lost.unseen_s(self.now_ns):
            return where
        apart_m, _, other = min(near)
        return f"{where}; track {other.track_id}, a {other.class_name}, is {apart_m:.1f} m from there"

    def missing(self, subject: Subject) -> str | None:
        """Why a command about it cannot begin, and what can be given instead; None: it is there."""
        if self.present(subject):
            return None
        if subject.track_id is None:
            fault = self.fault_of(subject)
            return f"no confirmed {subject.name} in the image" + (f": {fault}" if fault else "")
        last = next((each for each in self.objects if subject.means(each)), None)
        confirmed = [each for each in self._present(self.objects) if each.confirmed]
        gone = f"no track {subject.track_id}"
        if last is not None:
            gone = f"track {subject.track_id} ended {last.unseen_s(self.now_ns) - self.ended_s:.0f} s ago"
            nearest = _nearest(last, [each for each in confirmed if each.class_name == last.class_name])
            if nearest is not None and nearest.track_id is not None:
                return (
                    f"{gone}; the nearest {nearest.class_name} now is track {nearest.track_id}, "
                    f"{_apart_text(last, nearest)} from where {subject.track_id} was last seen: "
                    f"give track={nearest.track_id}"
                )
        counts = Counter(each.class_name for each in confirmed)
        if not counts:
            return f"{gone}; no confirmed track is present (tracks need tracker.enabled)"
        shown = ", ".join(f"{count} {name}" for name, count in sorted(counts.items()))
        return f"{gone}; present: {shown}; give the track_id of one, from the topic detections"

    def fault_of(self, subject: Subject) -> str:
        """Why nothing new is seen of it, in words; empty: something is."""
        return self.fault if subject.marker_id is None else self.marker_fault

    def seen(self, class_names: Collection[str], confidence: float, since_ns: int) -> list[TrackedObject]:
        """Those in the newest frame, if it was captured after `since_ns`; the highest confidence first."""
        seen = [
            each
            for each in self.objects
            if each.class_name in class_names
            and not each.occluded
            and each.last_ns > since_ns
            and each.detection.score >= confidence
        ]
        return sorted(seen, key=lambda each: -each.detection.score)

    def choose(self, subject: Subject, chosen: TrackedObject) -> None:
        """From now on the command means this object."""
        self._choices[subject] = Choice(chosen, self.now_ns)

    def forget(self, subject: Subject) -> None:
        """Choose again."""
        self._choices.pop(subject, None)

    def now(self, known: TrackedObject) -> TrackedObject:
        """The same object as of its newest detection; unseen for long, it is returned as it is given."""
        return _same(known, self.markers if known.range_source is RangeSource.MARKER else self.objects)

    def present(self, subject: Subject) -> list[TrackedObject]:
        """Those that it means and that have not ended; of a class or a marker the confirmed ones."""
        return [
            each
            for each in self._present(self._among(subject))
            if subject.means(each) and (each.confirmed or subject.track_id is not None)
        ]

    def candidates(self, subject: Subject, confidence: float = 0.0) -> list[TrackedObject]:
        """Those that it may mean: seen lately, and certain."""
        return [
            each
            for each in self._among(subject)
            if subject.means(each)
            and _certain(each)
            and each.detection.score >= confidence
            and each.unseen_s(self.now_ns) <= (CHOOSING_S if each.occluded else 2 * CHOOSING_S)
        ]

    def take_notes(self) -> list[str]:
        """The track ids that chosen objects have got since the last call, in words."""
        notes = []
        for subject, choice in self._choices.items():
            if subject.track_id is None or choice.last is None:
                continue
            if choice.last.track_id not in (choice.noted_id, subject.track_id):
                choice.noted_id = choice.last.track_id
                notes.append(f"{subject.name}: the object is track {choice.noted_id} now")
        return notes

    def _present(self, among: Sequence[TrackedObject]) -> list[TrackedObject]:
        return [each for each in among if each.unseen_s(self.now_ns) <= self.ended_s]

    def _among(self, subject: Subject) -> tuple[TrackedObject, ...]:
        return self.objects if subject.marker_id is None else self.markers

    def _choice(self, subject: Subject) -> Choice:
        """What was chosen, as it is now."""
        choice = self._choices.setdefault(subject, Choice(begun_ns=self.now_ns))
        if choice.last is not None:
            choice.last = _same(choice.last, self._among(subject))
        return choice

    def _choose(self, subject: Subject, choice: Choice) -> None:
        fitting = self.candidates(subject, choice.confidence)
        if not fitting:
            choice.last = choice.since_ns = None
            return
        if choice.since_ns is None:
            choice.since_ns = self.now_ns
        tracked = all(each.track_ids for each in fitting)
        if choice.last is None and tracked and self.now_ns - choice.since_ns < CHOOSING_S * 1e9:
            return
        chosen = nearest_ahead(fitting, self.yaw_rad)
        known = None if choice.last is None else choice.last.object_id
        kept = next((each for each in fitting if each.object_id == known), chosen)
        choice.last = chosen if chosen.position_ned_m is not None else kept


def nearest_ahead(objects: Sequence[TrackedObject], yaw_rad: float) -> TrackedObject:
    """The nearest object ahead of the nose; if none is ahead, the one with the smallest angle from it."""

    def rank(each: TrackedObject) -> tuple[float, float, float]:
        off_rad = abs(wrap_angle(each.detection.bearing_rad - yaw_rad))
        range_m = each.detection.ground_range_m
        return (max(off_rad, BEFORE_RAD), range_m if math.isfinite(range_m) else math.inf, off_rad)

    return min(objects, key=rank)


def _certain(seen: TrackedObject) -> bool:
    return seen.confirmed and seen.doubt < MOST_DOUBT


def _same(last: TrackedObject, objects: Sequence[TrackedObject]) -> TrackedObject:
    """The same object now; after two objects turned out to be one, that one."""
    found = next(
        (o for o in objects if (o.object_id, o.class_name) == (last.object_id, last.class_name)), None
    )
    if found is None and last.track_id is not None:
        found = next((each for each in objects if last.track_id in each.track_ids), None)
    return last if found is None else found


def _nearest(last: TrackedObject, others: Sequence[TrackedObject]) -> TrackedObject | None:
    """The one nearest to where another was last seen: by distance, else by direction."""
    return min(others, key=lambda each: (_apart_m(last, each), _off_rad(last, each)), default=None)


def _apart_m(first: TrackedObject, second: TrackedObject) -> float:
    if first.position_ned_m is None or second.position_ned_m is None:
        return math.inf
    return math.dist(first.position_ned_m[:2], second.position_ned_m[:2])


def _off_rad(first: TrackedObject, second: TrackedObject) -> float:
    one, other = first.detection, second.detection
    return math.hypot(
        wrap_angle(one.bearing_rad - other.bearing_rad), one.elevation_rad - other.elevation_rad
    )


def _apart_text(first: TrackedObject, second: TrackedObject) -> str:
    apart_m = _apart_m(first, second)
    return f"{apart_m:.1f} m" if math.isfinite(apart_m) else f"{math.degrees(_off_rad(first, second)):.0f}°"
