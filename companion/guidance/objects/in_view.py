"""The objects as behaviours see them: all of them, and the one that a command has chosen."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field

from companion.guidance.objects.subject import Subject
from companion.guidance.objects.tracked_object import MOST_DOUBT, TrackedObject
from vision.attitude import wrap_angle

# Candidates are collected for this long from the first confirmed object on, because a detector misses frames.
CHOOSING_S = 0.4
# Objects within this angle of the nose count as ahead; of these the nearest one is chosen.
BEFORE_RAD = math.radians(10.0)


@dataclass(slots=True)
class Choice:
    """The object that a subject means: once chosen it stays, also while it is not seen.

    Attributes:
        last: the chosen object; None: none yet.
    """

    last: TrackedObject | None = None
    since_ns: int | None = None

    def update(
        self,
        subject: Subject,
        confidence: float,
        objects: Sequence[TrackedObject],
        now_ns: int,
        yaw_rad: float,
    ) -> TrackedObject | None:
        if self.last is not None:
            self.last = _same(self.last, objects)
            return self.last
        fitting = [
            each
            for each in objects
            if subject.means(each)
            and each.confirmed
            and each.doubt < MOST_DOUBT
            and each.detection.score >= confidence
            and each.unseen_s(now_ns) <= 2 * CHOOSING_S
        ]
        if not fitting:
            self.since_ns = None
            return None
        if self.since_ns is None:
            self.since_ns = now_ns
        if now_ns - self.since_ns < CHOOSING_S * 1e9 and all(each.track_ids for each in fitting):
            return None
        chosen = nearest_ahead(fitting, yaw_rad)
        if chosen.position_ned_m is not None:
            self.last = chosen
        return chosen


@dataclass(frozen=True, slots=True)
class ObjectsInView:
    """The objects of the steering camera at one step of guidance.

    Attributes:
        objects: all that are remembered, each as of its newest detection.
        markers: the printed markers, in the same form.
        now_ns: CLOCK_MONOTONIC nanoseconds. yaw_rad: of the vehicle, clockwise from north.
    """

    objects: tuple[TrackedObject, ...] = ()
    markers: tuple[TrackedObject, ...] = ()
    now_ns: int = 0
    yaw_rad: float = 0.0
    _choices: dict[Subject, Choice] = field(default_factory=dict, compare=False, repr=False)

    def of(self, subject: Subject, confidence: float = 0.0) -> TrackedObject | None:
        """The object that a command means; None: not chosen yet.

        Of a class it is the nearest confirmed one ahead. It stays the same until the command ends: unseen, it
        is returned as it was seen last (`unseen_s`). One without a known range is returned until there is one
        with.
        """
        among = self.objects if subject.marker_id is None else self.markers
        choice = self._choices.setdefault(subject, Choice())
        return choice.update(subject, confidence, among, self.now_ns, self.yaw_rad)

    def shows(self, subject: Subject) -> bool:
        """Whether one of these is there, confirmed and with a known range, or was lately."""
        among = self.objects if subject.marker_id is None else self.markers
        return any(
            subject.means(each)
            and each.confirmed
            and each.position_ned_m is not None
            and each.unseen_s(self.now_ns) <= 2 * CHOOSING_S
            for each in among
        )

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

    def now(self, known: TrackedObject) -> TrackedObject:
        """The same object as of its newest detection; unseen for long, it is returned as it is given."""
        return _same(known, self.objects)

    def choose(self, subject: Subject, chosen: TrackedObject) -> None:
        """From now on the command means this object."""
        self._choices[subject] = Choice(chosen)

    def forget(self, subject: Subject) -> None:
        """Choose again."""
        self._choices.pop(subject, None)


def nearest_ahead(objects: Sequence[TrackedObject], yaw_rad: float) -> TrackedObject:
    """The nearest object ahead of the nose; if none is ahead, the one with the smallest angle from it."""

    def rank(each: TrackedObject) -> tuple[float, float, float]:
        off_rad = abs(wrap_angle(each.detection.bearing_rad - yaw_rad))
        range_m = each.detection.ground_range_m
        return (max(off_rad, BEFORE_RAD), range_m if math.isfinite(range_m) else math.inf, off_rad)

    return min(objects, key=rank)


def _same(last: TrackedObject, objects: Sequence[TrackedObject]) -> TrackedObject:
    """The same object now; after two objects turned out to be one, that one."""
    found = next((each for each in objects if each.object_id == last.object_id), None)
    if found is None and last.track_id is not None:
        found = next((each for each in objects if last.track_id in each.track_ids), None)
    return last if found is None else found
