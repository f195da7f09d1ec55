"""The objects that one camera shows: detections are associated and filtered once, here.

The image tracker's ids have priority. An object whose id ends is predicted; a detection with an id that is
new since then may be the object, if it is near where the object is expected and no other detection fits about
as well. What was seen beside an object is never the same one. After an occlusion the association is a
hypothesis for a while: if another detection then fits the prediction far better, the two are exchanged.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from companion.geometry.gate import GATE
from companion.guidance.objects.position_filter import Estimate, Fit, PositionFilter
from companion.guidance.objects.target import RangeSource, Target
from companion.guidance.objects.tracked_object import TrackedObject
from companion.vehicle.state import Vector3
from vision.attitude import wrap_angle

# Unseen, the gate grows without bound: a new track id is associated no farther than this from the expected
# position, plus so much per second in which it was not seen, or only a part of it; after LONGEST_S only to
# one that stood, and within STOOD_M of its place.
REACH_M, REACH_MPS, LONGEST_S, STOOD_M = 1.5, 1.0, 10.0, 3.0
# Of two detections near the expected position one is associated only if it fits better by this factor. Below
# these squared distances fits count as equal (in general; after an occlusion).
CLEARLY_NEARER = 3.0
AS_GOOD, AS_GOOD_AGAIN = 0.3, 0.1
# The image tracker's id is trusted within 90 %, because ids switch where two cars pass each other.
SURE_GATE = 4.6
# Unseen for this long, and at least so many frames, the image tracker's id may have switched.
IDENTITY_S, IDENTITY_FRAMES = 0.5, 4
# An id has gone to an object that was unseen for no longer than this, and is expected within REACH_M.
SWITCHED_S = 3.0
# Occlusion: unseen for longer than this, then off the expected position or with another id. The association
# stays a hypothesis for DOUBT_S.
OCCLUDED_S, OCCLUDED_FRAMES, EXPECTED_GATE, DOUBT_S = 0.25, 3, 1.0, 2.0
# Two boxes of a frame within this bearing, or that overlap by this IoU, may be of one object: the detector
# finds some of them twice.
SAME_BEARING_RAD, ONE_OBJECT_IOU = 0.03, 0.5
# Where a nearer box covers this share of a box's lower edge or of a side, that edge is not the object's: its
# position is predicted for so long; after that a moving one has the direction alone. What hides a side
# overlaps by a share of the box's width; a lower edge ends off what hides it by a share of that one's height.
HIDDEN_SHARE, HIDDEN_S, HIDDEN_LAP, HIDDEN_GAP = 0.5, 2.0, 0.1, 0.04
# Without a tracker a detection within this bearing of an object that is not seen otherwise may be it.
DIRECTION_RAD = 0.1
# An object without a rival has manoeuvred if the filter has refused its detections this many times in a row
# while they fit each other: the filter begins again there.
REFUSED = 3
# No detection is farther away, and none is more exact: beyond these, numbers overflow.
FARTHEST_M, NEAREST_M = 1e6, 1e-6
# An object is forgotten after this long, and the longest unseen one where there are more than so many.
FORGET_S, MOST_OBJECTS = 60.0, 256


class _Occlusion(NamedTuple):
    """The estimate before an occlusion, and the objects known then, until the association is certain."""

    estimate: Estimate
    others: frozenset[int]
    until_ns: float


class _Object:
    """What the table remembers of one object."""

    def __init__(self, object_id: int, target: Target, vehicle: Vector3, *, hidden: bool) -> None:
        self.object_id = object_id
        self.class_name = target.class_name
        self.track_ids: tuple[int, ...] = () if target.track_id is None else (target.track_id,)
        self.first_ns = self.last_ns = self.shown_ns = target.captured_ns
        self.newest = target
        self.confirmed = target.trusted
        self._frames, self._sure, self._doubted = 1, int(target.trusted), 0
        self.ambiguous = False
        located = target.position_ned_m is not None and not hidden
        self.filter = PositionFilter(target, vehicle) if located else None
        self.occlusion: _Occlusion | None = None
        self.refused: list[tuple[Target, Vector3]] = []
        self._intervals_s: deque[float] = deque(maxlen=5)
        self._value: TrackedObject | None = None

    @property
    def track_id(self) -> int | None:
        return self.track_ids[-1] if self.track_ids else None

    @property
    def interval_s(self) -> float:
        """Interval between detections without occlusion."""
        return min(self._intervals_s, default=0.0)

    def unseen_s(self, now_ns: int) -> float:
        return (now_ns - self.last_ns) / 1e9

    def believes_id(self, now_ns: int) -> bool:
        """Whether it was seen so lately that the image tracker's id is still its own."""
        return self.unseen_s(now_ns) <= max(IDENTITY_S, IDENTITY_FRAMES * self.interval_s)

    def was_occluded(self, now_ns: int) -> bool:
        return self.unseen_s(now_ns) > max(OCCLUDED_S, OCCLUDED_FRAMES * self.interval_s)

    def see(self, target: Target, *, hidden: bool) -> None:
        """Note a detection of it; its position is the filter's."""
        self._intervals_s.append(self.unseen_s(target.captured_ns))
        self.last_ns, self.newest = target.captured_ns, target
        if not hidden:
            self.shown_ns = target.captured_ns
        self.refused = []
        if target.track_id is not None and target.track_id != self.track_id:
            self.track_ids = (*(each for each in self.track_ids if each != target.track_id), target.track_id)
        self.confirmed = self.confirmed or target.trusted
        self.ambiguous = not target.trusted or target.class_name != self.class_name
        self._frames += 1
        self._sure += not self.ambiguous
        self._doubted += self.confirmed and self.ambiguous
        self._value = None

    def value(self, newest_ns: int) -> TrackedObject:
        occluded = self.last_ns < newest_ns
        known, changing = self._value, (occluded, self.ambiguous, self.track_ids)
        if known is not None and (known.occluded, known.ambiguous, known.track_ids) == changing:
            return known
        position, covariance = None, np.zeros((4, 4))
        if self.filter is not None:
            position, covariance = self.filter.state()
        covariance_rows = tuple(map(tuple, covariance.tolist()))
        self._value = TrackedObject(
            self.object_id,
            self.track_ids,
            self.class_name,
            position,
            (0.0, 0.0) if self.filter is None else self.filter.motion.velocity,
            covariance_rows,
            self.filter is not None and self.filter.moving,
            0 if self.filter is None else self.filter.located_ns,
            self.first_ns,
            self.last_ns,
            self.confirmed,
            self.ambiguous,
            self._frames,
            self._doubted / max(1, self._doubted + self._sure),
            occluded,
            self.newest,
        )
        return self._value


class ObjectTable:
    """The objects of one camera, from frame to frame.

    Attributes:
        objects: what `update` returned.

    >>> from companion import ObjectTable
    >>> from companion.guidance.objects.target import Target
    >>> table, here = ObjectTable(), (0.0, 0.0, -2.0)
    >>> first = Target("car", 0.9, 0, 0.0, -0.2, 10.0, position_ned_m=(10.0, 0.0, 0.0), track_id=3)
    >>> [car] = table.update([first], here, 0)
    >>> [unseen] = table.update([], here, 100_000_000)
    >>> car.track_id, car.occluded, unseen.object_id == car.object_id, unseen.occluded
    (3, False, True, True)
    """

    def __init__(self) -> None:
        self._objects: dict[int, _Object] = {}
        self._owners: dict[int, _Object] = {}
        self._newest_ns = -1
        self._next_id = 1
        self.objects: tuple[TrackedObject, ...] = ()

    def update(
        self, targets: Sequence[Target], vehicle: Vector3, captured_ns: int
    ) -> tuple[TrackedObject, ...]:
        """Add one frame; one that is not newer than the last one, or of an unknown place, changes nothing.

        Args:
            targets: all of this capture; empty: the camera saw nothing.
            vehicle: its position at the capture, local NED.
            captured_ns: of the frame.

        Returns:
            Those of the last `LONGEST_S`, and the confirmed ones of the last `FORGET_S`, the oldest first,
            each as of its newest detection.
        """
        if captured_ns > self._newest_ns and all(map(math.isfinite, vehicle)):
            self._newest_ns = captured_ns
            _Frame(self, targets, vehicle, captured_ns).associate()
            self._forget()
            self.objects = tuple(each.value(captured_ns) for each in self._objects.values())
        return self.objects

    def clear(self) -> None:
        """Forget every object. The next one gets a number that none has had."""
        self._objects, self._owners, self.objects = {}, {}, ()

    def of_track(self, track_id: int) -> TrackedObject | None:
        """The object that has, or had, an id of the image tracker."""
        owner = self._owners.get(track_id)
        return None if owner is None else owner.value(self._newest_ns)

    def _forget(self) -> None:
        ended = [
            each
            for each in self._objects.values()
            if each.unseen_s(self._newest_ns) > (FORGET_S if each.confirmed else LONGEST_S)
        ]
        if (excess := len(self._objects) - len(ended) - MOST_OBJECTS) > 0:
            left = sorted(self._objects.values(), key=lambda each: each.last_ns)
            ended = [*ended, *[each for each in left if each not in ended][:excess]]
        for each in ended:
            self._remove(each)

    def _add(self, target: Target, vehicle: Vector3, *, hidden: bool) -> _Object:
        created = _Object(self._next_id, target, vehicle, hidden=hidden)
        self._next_id += 1
        self._objects[created.object_id] = created
        if target.track_id is not None:
            self._owners[target.track_id] = created
        return created

    def _remove(self, gone: _Object) -> None:
        del self._objects[gone.object_id]
        for track_id in gone.track_ids:
            if self._owners.get(track_id) is gone:
                del self._owners[track_id]


class _Frame:
    """The association of one frame's detections with the objects of a table."""

    def __init__(
        self, table: ObjectTable, targets: Sequence[Target], vehicle: Vector3, captured_ns: int
    ) -> None:
        self._table, self._vehicle, self._now_ns = table, vehicle, captured_ns
        of_frame = (target for target in targets if target.captured_ns == captured_ns)
        self._left = _with_unique_ids(filter(None, map(_usable, of_frame)))
        # A detector misses single frames of what hides an object, too.
        ids = {each.track_id for each in self._left} | {None}
        missed = [
            each.newest
            for each in table._objects.values()
            if each.track_id not in ids and not each.was_occluded(captured_ns)
        ]
        before = [*self._left, *missed]
        self._hidden = {id(each) for each in self._left if _is_hidden(each, before)}
        self._seen: dict[int, Target] = {}  # by object
        self._ways: dict[int, list[Estimate]] = {}
        self._fits: dict[tuple[int, int], tuple[Estimate, Fit]] = {}

    def associate(self) -> None:
        objects = self._table._objects
        for each in list(objects.values()):
            if each.occlusion is not None:
                self._exchange(each, each.occlusion)
        for target in list(self._left):
            self._take_own(target)
        self._take_new()
        for target in list(self._left):
            self._refuse_or_add(target)

    def _fit(self, known: _Object, target: Target) -> tuple[Estimate, Fit]:
        """How well a detection fits an object with a position, and where that was expected for it."""
        key = known.object_id, id(target)
        if key not in self._fits:
            measured = target
            if self._partly_hidden(known, target):
                measured = _without_range(target)
            fits = [
                (way, way.fit(measured, self._vehicle)._replace(target=target))
                for way in self._ways_of(known)
            ]
            self._fits[key] = min(fits, key=lambda pair: pair[1].squared)
        return self._fits[key]

    def _ways_of(self, known: _Object) -> list[Estimate]:
        """Where an object with a position may be now."""
        if known.object_id not in self._ways:
            assert known.filter is not None
            ways = known.filter.at(self._now_ns, unseen=known.was_occluded(self._now_ns))
            self._ways[known.object_id] = ways
        return self._ways[known.object_id]

    def _out_of_reach(self, known: _Object, target: Target, reach_m: float) -> bool:
        """Whether it is surely too far away: much faster than `_fit`, and true for most."""
        place = target.position_ned_m
        if place is None or self._partly_hidden(known, target):
            return False
        assert known.filter is not None
        ways = known.filter.places(self._now_ns, unseen=known.was_occluded(self._now_ns))
        return all(math.dist(place[:2], way) > reach_m for way in ways)

    def _partly_hidden(self, known: _Object, target: Target) -> bool:
        """Whether a detection shows a part of this object, which moves, or was lately seen whole or first."""
        if id(target) not in self._hidden:
            return False
        if known.filter is None:
            return self._now_ns - known.first_ns <= HIDDEN_S * 1e9
        return known.filter.moving or self._now_ns - known.filter.located_ns <= HIDDEN_S * 1e9

    def _owner(self, target: Target) -> _Object | None:
        return None if target.track_id is None else self._table._owners.get(target.track_id)

    def _take(self, known: _Object, target: Target) -> None:
        """A detection is of this object."""
        if self._partly_hidden(known, target):
            if known.filter is not None and self._now_ns - known.shown_ns <= HIDDEN_S * 1e9:
                known.filter.predict(self._now_ns)
            elif known.filter is not None:
                expected, fit = self._fit(known, target)
                known.filter.update(expected, fit._replace(target=_without_range(target)), self._vehicle)
            self._own(known, target)
            self._left = [each for each in self._left if each is not target]
            return
        if known.filter is not None and not known.filter.begins_again(target):
            expected, fit = self._fit(known, target)
            self._note_occlusion(known, target, fit)
            known.filter.update(expected, fit, self._vehicle)
        elif target.position_ned_m is not None:
            known.filter = PositionFilter(target, self._vehicle)
        self._own(known, target)
        self._left = [each for each in self._left if each is not target]

    def _own(self, known: _Object, target: Target) -> None:
        """Note that this is the object's detection in this frame; an id of another object is now its own."""
        owner = self._owner(target)
        if owner is not None and owner is not known:
            owner.track_ids = tuple(each for each in owner.track_ids if each != target.track_id)
        known.see(target, hidden=id(target) in self._hidden)
        if target.track_id is not None:
            self._table._owners[target.track_id] = known
        self._seen[known.object_id] = target

    def _note_occlusion(self, known: _Object, target: Target, fit: Fit) -> None:
        surely = target.track_id == known.track_id and fit.squared <= EXPECTED_GATE
        if known.occlusion is None and not surely and known.was_occluded(self._now_ns):
            assert known.filter is not None
            others = {
                each.object_id
                for each in self._table._objects.values()
                if each is not known and each.first_ns <= known.last_ns
            }
            until_ns = self._now_ns + DOUBT_S * 1e9
            known.occlusion = _Occlusion(known.filter.motion, frozenset(others), until_ns)

    def _take_own(self, target: Target) -> None:
        """The detection with an object's own id, where it is expected."""
        known = self._owner(target)
        if known is None or known.track_id != target.track_id or known.object_id in self._seen:
            return
        if (
            known.filter is None
            or known.filter.begins_again(target)
            or (known.believes_id(self._now_ns) and self._fit(known, target)[1].squared <= SURE_GATE)
        ):
            self._take(known, target)

    def _take_new(self) -> None:
        """The other detections near where objects are expected that have not been seen yet in this frame."""
        chosen: dict[int, list[tuple[_Object, Fit]]] = {}
        for known in list(self._table._objects.values()):
            if known.object_id in self._seen or known.filter is None:
                continue
            fits = self._fitting(known)
            # Without a tracker only the distance distinguishes them.
            with_ids = [fit for fit in fits if fit.target.track_id is not None]
            known.ambiguous = len(with_ids) > 1 and _alike(fits[0], fits[1])
            if fits and not known.ambiguous:
                chosen.setdefault(id(fits[0].target), []).append((known, fits[0]))
        for pairs in chosen.values():
            pairs.sort(key=lambda pair: pair[1].unlikelihood)
            known, fit = pairs[0]
            if len(pairs) > 1 and fit.target.track_id is not None and _alike(fit, pairs[1][1]):
                own = [pair for pair in pairs if pair[0].track_id == fit.target.track_id is not None]
                if len(own) != 1:
                    for each, _ in pairs:
                        each.ambiguous = True
                    continue
                known, fit = own[0]
            young = self._owner(fit.target)
            if young is not None and young is not known and self._seen.get(young.object_id) is fit.target:
                self._merge(young, known)
            self._take(known, fit.target)

    def _fitting(self, known: _Object) -> list[Fit]:
        """The detections that may be an object which is not seen with its own id, the best fit first."""
        unseen_s = known.unseen_s(self._now_ns)
        reach_m = REACH_M + REACH_MPS * (self._now_ns - known.shown_ns) / 1e9
        if unseen_s > LONGEST_S:
            assert known.filter is not None
            reach_m = 0.0 if known.filter.moving else STOOD_M
        fits = []
        for target in (*self._left, *self._seen.values()):
            if target.class_name != known.class_name:
                continue
            own = target.track_id is not None and target.track_id == known.track_id
            if not own and not self._may_be(known, target, reach_m):
                continue
            _, fit = self._fit(known, target)
            near = fit.off_m <= reach_m
            if (
                own
                and (
                    fit.squared <= GATE
                    if known.believes_id(self._now_ns)
                    else fit.squared <= SURE_GATE and near
                )
            ) or (not own and fit.squared <= GATE and near):
                fits.append(fit)
        return sorted(fits, key=lambda fit: fit.squared)

    def _may_be(self, known: _Object, target: Target, reach_m: float) -> bool:
        """Whether a detection may be this object, within a reach of where it is expected.

        Its id is newer than the object's last detection; or its owner is expected elsewhere, so that the id
        has gone to another object.
        """
        # Without a tracker the place is all there is.
        untracked = target.track_id is None and not known.track_ids
        sure = known.confirmed and target.trusted
        if not untracked and (not sure or (target.position_ned_m is None and target.track_id is not None)):
            return False
        if self._out_of_reach(known, target, reach_m):
            return False
        if untracked:
            return True
        owner = self._owner(target)
        if owner is None or owner.first_ns > known.last_ns or owner.track_id != target.track_id:
            return True
        if owner.filter is None or owner.filter.begins_again(target):
            return False
        # Where this object is expected is known well for a while only.
        if target.position_ned_m is None or known.unseen_s(self._now_ns) > SWITCHED_S:
            return False
        off_m = self._fit(known, target)[1].off_m
        return off_m <= REACH_M and self._fit(owner, target)[1].squared > GATE

    def _merge(self, young: _Object, known: _Object) -> None:
        """Two objects are one: the older one goes on."""
        del self._seen[young.object_id]
        self._table._remove(young)
        for track_id in young.track_ids:
            self._table._owners[track_id] = known
        known.track_ids = (
            *known.track_ids,
            *(each for each in young.track_ids if each not in known.track_ids),
        )

    def _refuse_or_add(self, target: Target) -> None:
        """A detection that no object has taken: a manoeuvre of its owner, a second box, or a new object."""
        known = self._owner(target) if target.track_id is not None else self._in_direction(target)
        if (
            known is not None
            and known.track_id == target.track_id
            and known.object_id not in self._seen
            and (known.refused or known.believes_id(self._now_ns))
        ):
            if known.filter is None:
                self._take(known, target)
            elif not known.ambiguous:
                self._manoeuvre(known, target)
            return
        if not self._is_second_box(target):
            if known is not None and target.track_id is not None:
                known.track_ids = tuple(each for each in known.track_ids if each != target.track_id)
            created = self._table._add(target, self._vehicle, hidden=id(target) in self._hidden)
            self._seen[created.object_id] = target

    def _manoeuvre(self, known: _Object, target: Target) -> None:
        """Begin again where the image tracker sees the object, if the filter has refused it several times.

        The filter expects a bounded acceleration; an object that turns or stops at once leaves its gate. The
        image tracker has not lost it, so the filter is wrong.
        """
        assert known.filter is not None
        if target.cut and known.filter.stands(self._now_ns):
            # Of the part within the image the middle is elsewhere: that is no manoeuvre.
            known.filter.predict(self._now_ns)
            self._own(known, target)
            return
        part = known.filter.is_part(target) or self._partly_hidden(known, target)
        if target.position_ned_m is None or not target.trusted or part:
            known.refused = []
            return
        if any(
            Estimate.initialize(other, seen_from).at(self._now_ns).fit(target, self._vehicle).squared > GATE
            for other, seen_from in known.refused
        ):
            known.refused = []
        known.refused.append((target, self._vehicle))
        if len(known.refused) < REFUSED:
            return
        known.filter.restart(known.refused)
        known.occlusion = None
        self._own(known, target)

    def _in_direction(self, target: Target) -> _Object | None:
        """Without a tracker: the object of its class, not seen in this frame, in its direction."""
        near = [
            (off_rad, each.object_id, each)
            for each in self._table._objects.values()
            if each.object_id not in self._seen
            and not each.track_ids
            and (each.refused or each.believes_id(self._now_ns))
            and each.class_name == target.class_name
            and (off_rad := abs(wrap_angle(each.newest.bearing_rad - target.bearing_rad))) < DIRECTION_RAD
        ]
        return min(near)[2] if near else None

    def _is_second_box(self, target: Target) -> bool:
        """Whether a new id is a second box on an object of this frame."""
        return any(
            other.class_name == target.class_name
            and (
                (
                    abs(wrap_angle(other.bearing_rad - target.bearing_rad)) <= SAME_BEARING_RAD
                    and abs(other.elevation_rad - target.elevation_rad) <= SAME_BEARING_RAD
                )
                or _overlap(other, target) >= ONE_OBJECT_IOU
            )
            for other in self._seen.values()
        )

    def _exchange(self, known: _Object, occlusion: _Occlusion) -> None:
        """Take another detection that fits the prediction before the occlusion far better."""
        if self._now_ns > occlusion.until_ns:
            known.occlusion = None
            return
        assert known.filter is not None
        before, present = occlusion.estimate.at(self._now_ns), known.filter.motion.at(self._now_ns)
        seen = [t for t in self._left if t.class_name == known.class_name and t.position_ned_m is not None]
        seen = [t for t in seen if (o := self._owner(t)) is None or o.object_id not in occlusion.others]
        followed = self._followed(known, seen, present)
        if followed is not None:
            current = before.fit(followed, self._vehicle).squared
        else:
            aside = present.state[:2] - before.state[:2]
            current = float(aside @ np.linalg.solve(before.covariance[:2, :2], aside))
        rivals = [before.fit(t, self._vehicle) for t in seen if t is not followed and t.trusted]
        rivals.sort(key=lambda fit: fit.squared)
        if not rivals:
            return
        best, unseen_s = rivals[0], (self._now_ns - occlusion.estimate.captured_ns) / 1e9
        bar = CLEARLY_NEARER * max(best.squared, AS_GOOD_AGAIN)
        if best.squared > SURE_GATE or best.off_m > REACH_M + REACH_MPS * unseen_s:
            return
        if current <= bar or any(rival.squared <= bar for rival in rivals[1:]):
            return
        # The other one goes on as an object of its own, with the id that it has.
        young = self._owner(best.target)
        if young is not None and young is not known:
            self._table._remove(young)
        if known.track_id is not None and known.track_id != best.target.track_id:
            self._table._owners.pop(known.track_id, None)
            known.track_ids = known.track_ids[:-1]
        known.occlusion = None
        known.filter.update(before, best, self._vehicle)
        self._own(known, best.target)
        self._left = [each for each in self._left if each is not best.target]

    def _followed(self, known: _Object, seen: Sequence[Target], present: Estimate) -> Target | None:
        """The detection of the current association: the one with its id, or the nearest within `REACH_M`."""
        fits = [present.fit(target, self._vehicle) for target in seen]
        for fit in fits:
            own = fit.target.track_id is not None and fit.target.track_id == known.track_id
            if own and fit.squared <= GATE:
                return fit.target
        near = [fit for fit in fits if fit.off_m <= REACH_M]
        return min(near, key=lambda fit: fit.off_m).target if near else None


def _usable(target: Target) -> Target | None:
    """The detection without numbers that are none, or out of all bounds; None without a direction."""
    if not math.isfinite(target.bearing_rad + target.elevation_rad):
        return None
    position = target.position_ned_m
    if position is not None and not all(abs(v) < FARTHEST_M for v in (*position, target.vehicle_sigma_m)):
        return replace(target, position_ned_m=None, range_source=RangeSource.NONE, ground_range_m=math.nan)
    along_m, across_m = target.range_sigma_m, target.across_sigma_m
    if any(not NEAREST_M < sigma < FARTHEST_M and not math.isnan(sigma) for sigma in (along_m, across_m)):
        return replace(target, range_sigma_m=math.nan, across_sigma_m=math.nan)
    return target


def _without_range(target: Target) -> Target:
    """Its direction alone."""
    return replace(target, position_ned_m=None, range_source=RangeSource.NONE)


def _alike(best: Fit, second: Fit) -> bool:
    """Whether two fits are too similar to prefer one."""
    return second.squared < CLEARLY_NEARER * max(best.squared, AS_GOOD)


def _with_unique_ids(targets: Iterable[Target]) -> list[Target]:
    """Of two detections with one id in a frame, the one with the higher confidence."""
    kept: dict[int | None, list[Target]] = {}
    for target in targets:
        same = kept.setdefault(target.track_id, [])
        if target.track_id is None or not same:
            same.append(target)
        elif target.confidence > same[0].confidence:
            same[0] = target
    return [target for same in kept.values() for target in same]


def _is_hidden(target: Target, frame: Sequence[Target]) -> bool:
    """Whether a confirmed object of the frame, nearer by its lower edge, hides an edge of the object."""
    left, top, right, bottom = target.box_xyxy
    for other in frame:
        left2, top2, right2, bottom2 = other.box_xyxy
        if not other.trusted or bottom2 <= bottom or _overlap(target, other) >= ONE_OBJECT_IOU:
            continue
        lap, gap = min(right, right2) - max(left, left2), HIDDEN_GAP * (bottom2 - top2)
        below = lap > HIDDEN_SHARE * (right - left) and top2 - gap < bottom
        beside = lap > HIDDEN_LAP * (right - left) and (left2 <= left or right2 >= right)
        if below or (beside and bottom - max(top, top2) > HIDDEN_SHARE * (bottom - top)):
            return True
    return False


def _overlap(one: Target, other: Target) -> float:
    """IoU of two boxes."""
    left, top, right, bottom = one.box_xyxy
    left2, top2, right2, bottom2 = other.box_xyxy
    width, height = min(right, right2) - max(left, left2), min(bottom, bottom2) - max(top, top2)
    if width <= 0.0 or height <= 0.0:
        return 0.0
    both = width * height
    return both / ((right - left) * (bottom - top) + (right2 - left2) * (bottom2 - top2) - both)
