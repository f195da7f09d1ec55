"""One moving object followed on the ground: which detection is it.

Unseen, it is predicted on. A detection is this object only where it can have got to (innovation gate), and
never one that was seen beside it. Who comes out again from behind something may be in doubt for a while: if
another then fits far better what was expected, the wrong one is left for it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from companion.guidance.targets.moving_estimate import Fit, MovingEstimate
from companion.guidance.targets.target import Target
from companion.vehicle.state import Vector3
from vision.attitude import wrap_angle

# Unseen, the gate grows without end: a stranger is taken for the object no farther than this from where it is
# expected, and so much more for each second.
REACH_M, REACH_MPS = 1.5, 1.0
# Of two strangers where it is expected, neither is taken unless one fits so much better; below these, of
# strangers and of one that comes out again, fits are equally good.
CLEARLY_NEARER = 3.0
AS_GOOD, AS_GOOD_AGAIN = 0.3, 0.1
# χ² with two degrees of freedom: 99 % of the object's own detections are inside, and the picture's tracker is
# believed without question where 90 % are: where two cars pass each other identities leap.
GATE, SURE_GATE = 9.2, 4.6
# So long unseen, an identity in the picture may have gone over to another; never before so many frames.
IDENTITY_S, IDENTITY_FRAMES = 0.5, 4
# Unseen for longer than this, and then not quite where it was expected or with another identity, it is in
# doubt for so long whether it is the same.
PARTED_S, PARTED_FRAMES, EXPECTED_GATE, DOUBT_S = 0.25, 3, 1.0, 2.0
# Two boxes in one direction may both be the object.
SAME_BEARING_RAD = 0.03


class _OcclusionHypothesis(NamedTuple):
    """What was known when the object was seen last, kept while it is in doubt who came out again."""

    estimate: MovingEstimate
    others: frozenset[int]
    until_ns: float


class MovingTrack:
    """The filtered place and velocity of one object, begun from a target whose place is known.

    Raises:
        ValueError: the target has no range.
    """

    def __init__(self, target: Target, vehicle: Vector3) -> None:
        self._class_name = target.class_name
        self._estimate = MovingEstimate.initialize(target, vehicle)
        self._track_id = target.track_id
        self._newest = target
        self._others: set[int] = set()
        self._occlusion: _OcclusionHypothesis | None = None
        self._intervals_s: deque[float] = deque(maxlen=5)

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
        """The object's identity in the picture; None while it has none."""
        return self._track_id

    def place(self, now_ns: int) -> tuple[float, float]:
        """(north, east) where it is, or is expected to be, at a stamp."""
        state = self._estimate.at(now_ns).state
        return (float(state[0]), float(state[1]))

    @property
    def velocity(self) -> tuple[float, float]:
        """Over ground, m/s."""
        return self._estimate.velocity

    @property
    def speed_sigma_mps(self) -> float:
        """One sigma of the velocity, in its worse direction."""
        return math.sqrt(float(np.linalg.eigvalsh(self._estimate.covariance[2:, 2:])[-1]))

    def update(self, targets: Sequence[Target], vehicle: Vector3) -> bool:
        """Take the detection that is this object, if any. True: there was a new one.

        Args:
            targets: of one frame (their stamps equal); a frame already seen changes nothing.
            vehicle: the vehicle's position at its capture, local NED.
        """
        fresh = [t for t in targets if t.class_name == self._class_name and t.captured_ns > self.captured_ns]
        if not fresh:
            return False
        now_ns = fresh[0].captured_ns
        if self._gone_back(fresh, now_ns, vehicle):
            return True
        unseen_s = (now_ns - self.captured_ns) / 1e9
        expected = self._estimate.at(now_ns)
        fitting = [fit for target in fresh if (fit := expected.fit(target, vehicle)).squared <= GATE]
        own = self._own(fitting, unseen_s)
        if own is None:
            return False
        surely = own.target.track_id == self._track_id and own.squared <= EXPECTED_GATE
        if (
            self._occlusion is None
            and not surely
            and unseen_s > max(PARTED_S, PARTED_FRAMES * self._interval_s)
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
        """Between two looks when nothing is hidden."""
        return min(self._intervals_s, default=0.0)

    def _own(self, fitting: list[Fit], unseen_s: float) -> Fit | None:
        """Which of those inside the gate is the object; None: none, or it cannot be told."""
        # The picture's own tracker knows best, unless its identity has leapt to where the object cannot be.
        # Nor does it know who comes out again from behind something.
        believed = unseen_s <= max(IDENTITY_S, IDENTITY_FRAMES * self._interval_s)
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

    def _may_be_it(self, target: Target) -> bool:
        """A stranger that may be this object under another identity: it counts as true and has a place."""
        known = target.track_id is not None and target.track_id in {self._track_id, *self._others}
        return target.trusted and target.position_ned_m is not None and not known

    def _gone_back(self, fresh: Sequence[Target], now_ns: int, vehicle: Vector3) -> bool:
        """Leave what was taken for the object if another is far nearer to where that was expected."""
        parting = self._occlusion
        if parting is None:
            return False
        if now_ns > parting.until_ns:
            self._occlusion = None
            return False
        expected, present = parting.estimate.at(now_ns), self._estimate.at(now_ns)
        seen = [t for t in fresh if t.position_ned_m is not None and t.track_id not in parting.others]
        followed = self._followed(seen, present, vehicle)
        if followed is not None:
            taken = expected.fit(followed, vehicle).squared
        else:
            aside = present.state[:2] - expected.state[:2]
            taken = float(aside @ np.linalg.solve(expected.covariance[:2, :2], aside))
        rivals = [expected.fit(t, vehicle) for t in seen if t is not followed and t.trusted]
        rivals.sort(key=lambda fit: fit.squared)
        if not rivals:
            return False
        best, unseen_s = rivals[0], (now_ns - parting.estimate.captured_ns) / 1e9
        bar = CLEARLY_NEARER * max(best.squared, AS_GOOD_AGAIN)
        if best.squared > SURE_GATE or best.off_m > REACH_M + REACH_MPS * unseen_s:
            return False
        if taken <= bar or any(rival.squared <= bar for rival in rivals[1:]):
            return False
        self._estimate, self._track_id, self._occlusion = expected.update(best), best.target.track_id, None
        self._newest = best.target
        self._others = set(parting.others)
        if followed is not None and followed.track_id is not None:
            self._others.add(followed.track_id)
        return True

    def _followed(self, seen: Sequence[Target], present: MovingEstimate, vehicle: Vector3) -> Target | None:
        """The detection that would be taken as things are: the own identity, or the nearest that is near."""
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
        """What is seen where the object cannot be, in one frame with it, is another one for good."""
        self._others |= {
            target.track_id
            for target in elsewhere
            if target.trusted
            and target.track_id not in (None, self._track_id)
            and abs(wrap_angle(target.bearing_rad - own.bearing_rad)) > SAME_BEARING_RAD
        }
