"""Association of detections with one moving object.

Unseen, it is predicted. A detection is associated only inside the innovation gate, and never if it was seen
beside the object before. After an occlusion the association is a hypothesis for a while: if another detection
then fits the prediction far better, the track switches to it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from companion.guidance.targets.estimate import Estimate, Fit
from companion.guidance.targets.target import Target
from companion.vehicle.state import Vector3
from vision.attitude import wrap_angle

# Unseen, the gate grows without bound: a new track id is associated no farther than this from the expected
# position, plus so much per second.
REACH_M, REACH_MPS = 1.5, 1.0
# Of two new track ids near the expected position one is associated only if it fits better by this factor.
# Below these squared distances fits count as equal (new ids; reappearance after an occlusion).
CLEARLY_NEARER = 3.0
AS_GOOD, AS_GOOD_AGAIN = 0.3, 0.1
# χ² with two degrees of freedom: 99 % of the object's own detections are inside the first; the image
# tracker's id is trusted within the second, 90 %, because ids switch where two cars pass each other.
GATE, SURE_GATE = 9.2, 4.6
# Unseen for this long, and at least so many frames, the image tracker's id may have switched.
IDENTITY_S, IDENTITY_FRAMES = 0.5, 4
# Occlusion: unseen for longer than this, then off the expected position or with another id. The association
# stays a hypothesis for DOUBT_S.
OCCLUDED_S, OCCLUDED_FRAMES, EXPECTED_GATE, DOUBT_S = 0.25, 3, 1.0, 2.0
# Two boxes within this bearing may both be the object.
SAME_BEARING_RAD = 0.03
# A confirmed track without a rival has manoeuvred if the filter has refused its detections this many times in
# a row while they fit each other: the filter restarts there.
REFUSED = 3


class _OcclusionHypothesis(NamedTuple):
    """The estimate before an occlusion, kept until the association afterwards is certain."""

    estimate: Estimate
    others: frozenset[int]
    until_ns: float


class MovingTrack:
    """Filtered position and velocity of one object, initialized from a target with a known position.

    Raises:
        ValueError: the target has no range.
    """

    def __init__(self, target: Target, vehicle: Vector3) -> None:
        self._class_name = target.class_name
        self._estimate = Estimate.initialize(target, vehicle)
        self._track_id = target.track_id
        self._newest = target
        self._others: set[int] = set()
        self._occlusion: _OcclusionHypothesis | None = None
        self._intervals_s: deque[float] = deque(maxlen=5)
        self._refused: list[tuple[Target, Vector3]] = []

    @property
    def captured_ns(self) -> int:
        """Capture stamp of the newest detection of this object."""
        return self._estimate.captured_ns

    @property
    def newest(self) -> Target:
        """The newest detection of this object."""
        return self._newest

    @property
    def track_id(self) -> int | None:
        """The image tracker's id of the object; None without one."""
        return self._track_id

    def position_at(self, now_ns: int) -> tuple[float, float]:
        """(north, east) estimated or predicted position at a stamp."""
        state = self._estimate.at(now_ns).state
        return (float(state[0]), float(state[1]))

    @property
    def velocity(self) -> tuple[float, float]:
        """(north, east), m/s."""
        return self._estimate.velocity

    @property
    def speed_sigma_mps(self) -> float:
        """One sigma of the velocity along the longer axis of its ellipse."""
        return math.sqrt(float(np.linalg.eigvalsh(self._estimate.covariance[2:, 2:])[-1]))

    def update(self, targets: Sequence[Target], vehicle: Vector3) -> bool:
        """Associate a detection with this object, if any. True: there was a new one.

        Args:
            targets: of one frame (their stamps equal); a frame already seen changes nothing.
            vehicle: the vehicle's position at its capture, local NED.
        """
        fresh = [t for t in targets if t.class_name == self._class_name and t.captured_ns > self.captured_ns]
        if not fresh:
            return False
        now_ns = fresh[0].captured_ns
        if self._switch_back(fresh, now_ns, vehicle):
            return True
        unseen_s = (now_ns - self.captured_ns) / 1e9
        expected = self._estimate.at(now_ns)
        fitting = [fit for target in fresh if (fit := expected.fit(target, vehicle)).squared <= GATE]
        own = self._own(fitting, unseen_s)
        if own is None:
            return self._manoeuvred(fresh, fitting, unseen_s, vehicle)
        self._refused = []
        surely = own.target.track_id == self._track_id and own.squared <= EXPECTED_GATE
        if (
            self._occlusion is None
            and not surely
            and unseen_s > max(OCCLUDED_S, OCCLUDED_FRAMES * self._interval_s)
        ):
            self._occlusion = _OcclusionHypothesis(
                self._estimate, frozenset(self._others), now_ns + DOUBT_S * 1e9
            )
        self._estimate, self._newest = expected.update(own), own.target
        self._intervals_s.append(unseen_s)
        if own.target.track_id is not None:
            self._track_id = own.target.track_id
        fitted = {id(fit.target) for fit in fitting}
        self._note_others([other for other in fresh if id(other) not in fitted], own.target)
        return True

    @property
    def _interval_s(self) -> float:
        """Interval between detections without occlusion."""
        return min(self._intervals_s, default=0.0)

    def _own(self, fitting: list[Fit], unseen_s: float) -> Fit | None:
        """The detection inside the gate that is the object; None: none, or ambiguous."""
        # The image tracker's id has priority, unless it has switched to where the object cannot be, or after
        # an occlusion.
        believed = self._believes_id(unseen_s)
        fits = [
            fit for fit in fitting if self._track_id is not None and fit.target.track_id == self._track_id
        ]
        if not (believed and fits and fits[0].squared <= SURE_GATE):
            reach_m = REACH_M + REACH_MPS * unseen_s
            if not believed:
                fits = [fit for fit in fits if fit.squared <= SURE_GATE and fit.off_m <= reach_m]
            fits += [fit for fit in fitting if self._may_be_it(fit.target) and fit.off_m <= reach_m]
        fits.sort(key=lambda fit: fit.squared)
        if not fits or (len(fits) > 1 and fits[1].squared < CLEARLY_NEARER * max(fits[0].squared, AS_GOOD)):
            return None
        return fits[0]

    def _believes_id(self, unseen_s: float) -> bool:
        """Whether the object was seen so lately that the image tracker's id is still its own."""
        return unseen_s <= max(IDENTITY_S, IDENTITY_FRAMES * self._interval_s)

    def _manoeuvred(
        self, fresh: Sequence[Target], fitting: Sequence[Fit], unseen_s: float, vehicle: Vector3
    ) -> bool:
        """Restart where the image tracker sees the object, if the filter has refused it several times.

        The filter expects a bounded acceleration; an object that turns or stops at once leaves its gate. The
        image tracker has not lost it, so the filter is wrong, unless there is a rival inside the gate.
        """
        own = next((t for t in fresh if t.track_id is not None and t.track_id == self._track_id), None)
        if (
            own is None
            or not own.trusted
            or own.position_ned_m is None
            or not (self._refused or self._believes_id(unseen_s))
            or any(self._may_be_it(fit.target) for fit in fitting)
        ):
            self._refused = []
            return False
        if any(
            Estimate.initialize(target, seen_from).at(own.captured_ns).fit(own, vehicle).squared > GATE
            for target, seen_from in self._refused
        ):
            self._refused = []
        self._refused.append((own, vehicle))
        if len(self._refused) < REFUSED:
            return False
        self._estimate, self._newest = Estimate.initialize(own, vehicle), own
        self._refused, self._occlusion = [], None
        return True

    def _may_be_it(self, target: Target) -> bool:
        """Whether a new track id may be this object: it is trusted and has a position."""
        known = target.track_id is not None and target.track_id in {self._track_id, *self._others}
        return target.trusted and target.position_ned_m is not None and not known

    def _switch_back(self, fresh: Sequence[Target], now_ns: int, vehicle: Vector3) -> bool:
        """Switch to another detection that fits the prediction before the occlusion far better."""
        occlusion = self._occlusion
        if occlusion is None:
            return False
        if now_ns > occlusion.until_ns:
            self._occlusion = None
            return False
        expected, present = occlusion.estimate.at(now_ns), self._estimate.at(now_ns)
        seen = [t for t in fresh if t.position_ned_m is not None and t.track_id not in occlusion.others]
        followed = self._followed(seen, present, vehicle)
        if followed is not None:
            current = expected.fit(followed, vehicle).squared
        else:
            aside = present.state[:2] - expected.state[:2]
            current = float(aside @ np.linalg.solve(expected.covariance[:2, :2], aside))
        rivals = [expected.fit(t, vehicle) for t in seen if t is not followed and t.trusted]
        rivals.sort(key=lambda fit: fit.squared)
        if not rivals:
            return False
        best, unseen_s = rivals[0], (now_ns - occlusion.estimate.captured_ns) / 1e9
        bar = CLEARLY_NEARER * max(best.squared, AS_GOOD_AGAIN)
        if best.squared > SURE_GATE or best.off_m > REACH_M + REACH_MPS * unseen_s:
            return False
        if current <= bar or any(rival.squared <= bar for rival in rivals[1:]):
            return False
        self._estimate, self._track_id, self._occlusion = expected.update(best), best.target.track_id, None
        self._newest = best.target
        self._others = set(occlusion.others)
        if followed is not None and followed.track_id is not None:
            self._others.add(followed.track_id)
        return True

    def _followed(self, seen: Sequence[Target], present: Estimate, vehicle: Vector3) -> Target | None:
        """The detection of the current association: the one with its id, or the nearest within `REACH_M`."""
        fits = [present.fit(target, vehicle) for target in seen]
        for fit in fits:
            if (
                fit.target.track_id is not None
                and fit.target.track_id == self._track_id
                and fit.squared <= GATE
            ):
                return fit.target
        near = [fit for fit in fits if fit.off_m <= REACH_M]
        return min(near, key=lambda fit: fit.off_m).target if near else None

    def _note_others(self, elsewhere: list[Target], own: Target) -> None:
        """Detections outside the gate in the same frame are permanently other objects."""
        self._others |= {
            target.track_id
            for target in elsewhere
            if target.trusted
            and target.track_id not in (None, self._track_id)
            and abs(wrap_angle(target.bearing_rad - own.bearing_rad)) > SAME_BEARING_RAD
        }
