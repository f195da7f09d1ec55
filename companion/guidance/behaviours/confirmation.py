"""Confirmation of detections and yaw alignment, shared by `seek`, `patrol` and area searches.

A find needs several frames that agree on a direction, of an object with a confirmed track. It is verified
when the vehicle faces it and still sees it. Of several finds the one with the highest confidence is the best.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Collection
from dataclasses import dataclass

from companion.guidance.behaviour import BehaviourContext
from companion.guidance.objects.target import Target
from vision.attitude import wrap_angle

# Number of frames within the window that must agree on a direction.
FRAMES_NEEDED = 3
FRAMES_WINDOW_S = 1.5
SAME_BEARING_RAD = math.radians(12.0)
# After a first detection a turn pauses this long for more.
LOOK_S = 1.0
# Facing the object: tolerance, duration, time-out, and when a detection counts as lost.
FACING_RAD = math.radians(4.0)
FACING_S = 0.4
FACING_TIMEOUT_S = 12.0
SIGHT_LOST_S = 2.0
# A find must have been seen within this time.
SIGHT_FRESH_S = 0.7
# Candidates whose confidence is within this of the best are equal: the nearest is selected.
EQUAL_CONFIDENCE = 0.1


class DetectionConfirmer:
    """Confirms recent detections of some classes.

    Attributes:
        doubted: an object was seen often enough but not confirmed.
        look_until_ns: after a first detection, the time until which more are expected.
    """

    def __init__(self, class_names: Collection[str], confidence: float) -> None:
        self._class_names, self._confidence = frozenset(class_names), confidence
        self._seen: deque[Target] = deque(maxlen=64)
        self._newest_ns = 0
        self.doubted = False
        self.look_until_ns: float = 0

    def reset(self, now_ns: int) -> None:
        """Forget everything. Frames captured before now are ignored: they may show another place."""
        self._seen.clear()
        self._newest_ns = now_ns
        self.doubted, self.look_until_ns = False, 0

    def forget(self) -> None:
        """Forget detections; processed frames are not processed again."""
        self._seen.clear()

    def fresh(self, context: BehaviourContext) -> list[Target]:
        """Targets of new frames that are of these classes, with enough confidence."""
        fresh = [target for target in context.targets if target.captured_ns > self._newest_ns]
        if fresh:
            self._newest_ns = max(target.captured_ns for target in fresh)
        return [t for t in fresh if t.class_name in self._class_names and t.score >= self._confidence]

    def update(
        self, context: BehaviourContext, wanted: Callable[[Target], bool] = lambda target: True
    ) -> Target | None:
        """Process new frames; returns the target confirmed now, if any. `wanted` filters targets."""
        found = self.agreed([t for t in self.fresh(context) if wanted(t)], context.now_ns)
        return found[0] if found else None

    def agreed(self, seen: Collection[Target], now_ns: int) -> list[Target]:
        """Process `fresh` targets; returns those confirmed now, highest confidence first."""
        found: list[Target] = []
        if not seen:
            return found
        seen = sorted(seen, key=lambda target: -target.confidence)
        if not self._seen or seen[0].captured_ns - self._seen[-1].captured_ns > LOOK_S * 1e9:
            self.look_until_ns = now_ns + LOOK_S * 1e9
        self._seen.extend(seen)
        oldest_ns = self._newest_ns - FRAMES_WINDOW_S * 1e9
        recent = [target for target in self._seen if target.captured_ns >= oldest_ns]
        for target in seen:
            agreeing = [
                t
                for t in recent
                if t.class_name == target.class_name and apart_rad(t, target) <= SAME_BEARING_RAD
            ]
            if len({t.captured_ns for t in agreeing}) < FRAMES_NEEDED:
                continue
            # A track stays confirmed from some frame on; an ambiguous class may come and go.
            first = next((index for index, t in enumerate(agreeing) if t.trusted), len(agreeing))
            since = [t.trusted for t in agreeing[first:]]
            if target.trusted and 2 * sum(since) > len(since):
                found.append(target)
            else:
                self.doubted = True
        return found


@dataclass(slots=True)
class _Candidate:
    """One object that was seen on a turn.

    Attributes:
        target: newest trusted detection. range_m: newest known range.
        frames, doubted: number of frames in which it was trusted, and in which it was not.
        found: it was confirmed.
    """

    target: Target
    range_m: float = math.nan
    frames: int = 0
    doubted: int = 0
    found: bool = False

    @property
    def rank(self) -> float:
        """The track's median confidence, reduced by untrusted frames and by a low number of frames."""
        return self.target.score * self.frames / (self.frames + self.doubted + FRAMES_NEEDED)


class Candidates:
    """Objects found on a turn, compared when the turn is done."""

    def __init__(self) -> None:
        self._seen: list[_Candidate] = []

    def __len__(self) -> int:
        return sum(candidate.found for candidate in self._seen)

    def add(self, seen: Collection[Target], found: Collection[Target]) -> None:
        """Add a frame's targets (`DetectionConfirmer.fresh`) and those confirmed now (`agreed`)."""
        for target in seen:
            candidate = next((one for one in self._seen if _same(one.target, target)), None)
            if candidate is None:
                candidate = _Candidate(target)
                self._seen.append(candidate)
            if target.trusted:
                candidate.target = target
                candidate.frames += 1
            else:
                candidate.doubted += 1
            if math.isfinite(target.ground_range_m):
                candidate.range_m = target.ground_range_m
            candidate.found = candidate.found or target in found

    def best(self) -> Target | None:
        """The nearest of the finds within `EQUAL_CONFIDENCE` of the highest rank; None: no find."""
        found = [one for one in self._seen if one.found]
        if not found:
            return None
        least = max(one.rank for one in found) - EQUAL_CONFIDENCE
        best = [one for one in found if one.rank >= least]
        nearest = min(best, key=lambda one: one.range_m if math.isfinite(one.range_m) else math.inf)
        return nearest.target

    def drop(self, target: Target) -> None:
        """Remove everything in the direction of a find that was not verified."""
        self._seen = [one for one in self._seen if apart_rad(one.target, target) > SAME_BEARING_RAD]


def _same(known: Target, target: Target) -> bool:
    if known.track_id is not None or target.track_id is not None:
        return known.track_id == target.track_id
    return apart_rad(known, target) <= SAME_BEARING_RAD


class YawAligner:
    """Turns the nose to a find.

    Attributes:
        target: its newest detection.
    """

    def __init__(self, found: Target, now_ns: int) -> None:
        self.target = found
        self._since_ns = now_ns
        self._expected_ns = found.captured_ns
        self._facing_since_ns: int | None = None

    def follow(self, seen: Collection[Target]) -> None:
        """Update the target from new frames."""
        found = self.target
        same = [
            target
            for target in seen
            if target.trusted
            and target.class_name == found.class_name
            and apart_rad(target, found) <= SAME_BEARING_RAD
        ]
        if same:
            self.target = min(
                same,
                key=lambda t: (t.track_id is None or t.track_id != found.track_id, apart_rad(t, found)),
            )

    def expect_later(self, now_ns: int) -> None:
        """The camera does not point there yet, so a missing detection does not count."""
        self._expected_ns = now_ns

    def lost(self, now_ns: int) -> bool:
        """Whether the target is lost, or facing it timed out."""
        unseen_s = (now_ns - max(self.target.captured_ns, self._expected_ns)) / 1e9
        return unseen_s > SIGHT_LOST_S or now_ns - self._since_ns > FACING_TIMEOUT_S * 1e9

    def off_rad(self, yaw_rad: float) -> float:
        """Angle between the nose and the target."""
        return _across(wrap_angle(self.target.bearing_rad - yaw_rad), self.target.elevation_rad)

    def faced(self, yaw_rad: float, now_ns: int) -> bool:
        """Whether the nose has pointed at the target for `FACING_S`, and it is still seen."""
        unseen_s = (now_ns - self.target.captured_ns) / 1e9
        if unseen_s > SIGHT_FRESH_S or self.off_rad(yaw_rad) > FACING_RAD:
            self._facing_since_ns = None
        elif self._facing_since_ns is None:
            self._facing_since_ns = now_ns
        return self._facing_since_ns is not None and now_ns - self._facing_since_ns >= FACING_S * 1e9


def apart_rad(first: Target, second: Target) -> float:
    """Angle between two targets; at the horizon that between their bearings."""
    elevation_rad = (first.elevation_rad + second.elevation_rad) / 2
    return _across(wrap_angle(first.bearing_rad - second.bearing_rad), elevation_rad)


def _across(bearing_rad: float, elevation_rad: float) -> float:
    """The angle that corresponds to a difference of bearings at an elevation."""
    return abs(bearing_rad) * math.cos(elevation_rad)
