"""When what is seen counts as found, and turning the nose to it: what `seek`, `patrol` and searches share.

One detection is a rumour. Several frames that agree on a direction, of an object that counts as true, make a
find; it is confirmed when the vehicle faces it and still sees it. Of several finds the surest is the best.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Collection
from dataclasses import dataclass

from companion.guidance.behaviour import BehaviourContext
from companion.guidance.targets.target import Target
from vision.attitude import wrap_angle

# So many frames of the last so many seconds must agree on a direction.
FRAMES_NEEDED = 3
FRAMES_WINDOW_S = 1.5
SAME_BEARING_RAD = math.radians(12.0)
# After a first sighting a turn waits this long for the others to come.
LOOK_S = 1.0
# Facing the object: how well, for how long it must last, and when to give the sighting up.
FACING_RAD = math.radians(4.0)
FACING_S = 0.4
FACING_TIMEOUT_S = 12.0
SIGHT_LOST_S = 2.0
# Found means seen now, not a moment ago.
SIGHT_FRESH_S = 0.7
# Candidates less sure than the surest by no more than this are as good: the nearest of them is taken.
AS_SURE = 0.1


class DetectionConfirmer:
    """What was seen lately of some classes.

    Attributes:
        doubted: something was seen often enough, and did not count as true.
        look_until_ns: something was seen just now; by then there should be more of it.
    """

    def __init__(self, class_names: Collection[str], confidence: float) -> None:
        self._class_names, self._confidence = frozenset(class_names), confidence
        self._seen: deque[Target] = deque(maxlen=64)
        self._newest_ns = 0
        self.doubted = False
        self.look_until_ns: float = 0

    def reset(self, now_ns: int) -> None:
        """Forget everything. Frames captured before now do not count: they may be of another place."""
        self._seen.clear()
        self._newest_ns = now_ns
        self.doubted, self.look_until_ns = False, 0

    def forget(self) -> None:
        """Forget what was seen; frames that were looked at stay looked at."""
        self._seen.clear()

    def fresh(self, context: BehaviourContext) -> list[Target]:
        """The targets of frames not looked at before that are of these classes, and sure enough."""
        fresh = [target for target in context.targets if target.captured_ns > self._newest_ns]
        if fresh:
            self._newest_ns = max(target.captured_ns for target in fresh)
        return [t for t in fresh if t.class_name in self._class_names and t.score >= self._confidence]

    def look(
        self, context: BehaviourContext, wanted: Callable[[Target], bool] = lambda target: True
    ) -> Target | None:
        """Take what new frames show. A target: found now. `wanted` may leave some out."""
        found = self.agreed([t for t in self.fresh(context) if wanted(t)], context.now_ns)
        return found[0] if found else None

    def agreed(self, seen: Collection[Target], now_ns: int) -> list[Target]:
        """Take targets that are `fresh`; those of them that are found now, the surest in this frame first."""
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
            # Its track counts as true from some frame on, and then for good; but a rival name comes and goes.
            first = next((index for index, t in enumerate(agreeing) if t.trusted), len(agreeing))
            since = [t.trusted for t in agreeing[first:]]
            if target.trusted and 2 * sum(since) > len(since):
                found.append(target)
            else:
                self.doubted = True
        return found


@dataclass(slots=True)
class _Candidate:
    """What is known of one object that was seen on a turn.

    Attributes:
        target: as it was last seen without doubt. range_m: the newest that is known.
        frames, doubted: how many frames showed it, without doubt and with.
        found: they agreed.
    """

    target: Target
    range_m: float = math.nan
    frames: int = 0
    doubted: int = 0
    found: bool = False

    @property
    def sureness(self) -> float:
        """Its track's median confidence, less the more frames doubted it, and the fewer there are."""
        return self.target.score * self.frames / (self.frames + self.doubted + FRAMES_NEEDED)


class Candidates:
    """What was found on a turn, to be compared when the turn is done."""

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
        """The surest, as it was last seen; of those about as sure, the nearest. None: nothing was found."""
        found = [one for one in self._seen if one.found]
        if not found:
            return None
        least = max(one.sureness for one in found) - AS_SURE
        as_sure = [one for one in found if one.sureness >= least]
        nearest = min(as_sure, key=lambda one: one.range_m if math.isfinite(one.range_m) else math.inf)
        return nearest.target

    def drop(self, target: Target) -> None:
        """It was not there after all, whatever it was called."""
        self._seen = [one for one in self._seen if apart_rad(one.target, target) > SAME_BEARING_RAD]


def _same(known: Target, target: Target) -> bool:
    if known.track_id is not None or target.track_id is not None:
        return known.track_id == target.track_id
    return apart_rad(known, target) <= SAME_BEARING_RAD


class YawAligner:
    """The nose on its way to what was found.

    Attributes:
        target: it, as it was seen last.
    """

    def __init__(self, found: Target, now_ns: int) -> None:
        self.target = found
        self._since_ns = now_ns
        self._expected_ns = found.captured_ns
        self._facing_since_ns: int | None = None

    def follow(self, seen: Collection[Target]) -> None:
        """Take what new frames show of it."""
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
        """The camera does not look there yet: that it is not seen says nothing."""
        self._expected_ns = now_ns

    def lost(self, now_ns: int) -> bool:
        """It was not there after all, or it went away."""
        unseen_s = (now_ns - max(self.target.captured_ns, self._expected_ns)) / 1e9
        return unseen_s > SIGHT_LOST_S or now_ns - self._since_ns > FACING_TIMEOUT_S * 1e9

    def off_rad(self, yaw_rad: float) -> float:
        """How far the nose is from it."""
        return _across(wrap_angle(self.target.bearing_rad - yaw_rad), self.target.elevation_rad)

    def faced(self, yaw_rad: float, now_ns: int) -> bool:
        """Whether the nose has pointed at it for long enough, and it is still seen."""
        unseen_s = (now_ns - self.target.captured_ns) / 1e9
        if unseen_s > SIGHT_FRESH_S or self.off_rad(yaw_rad) > FACING_RAD:
            self._facing_since_ns = None
        elif self._facing_since_ns is None:
            self._facing_since_ns = now_ns
        return self._facing_since_ns is not None and now_ns - self._facing_since_ns >= FACING_S * 1e9


def apart_rad(first: Target, second: Target) -> float:
    """The angle between two targets across the line of sight: level, it is that between their bearings."""
    elevation_rad = (first.elevation_rad + second.elevation_rad) / 2
    return _across(wrap_angle(first.bearing_rad - second.bearing_rad), elevation_rad)


def _across(bearing_rad: float, elevation_rad: float) -> float:
    """What a difference of bearings comes to so far off the horizon: nearly below, all bearings are one."""
    return abs(bearing_rad) * math.cos(elevation_rad)
