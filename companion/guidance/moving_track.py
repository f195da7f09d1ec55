"""One moving object followed on the ground: a constant-velocity Kalman filter, and which detection is it.

The state is position and velocity over ground (north, east), local NED, driven by white acceleration
(Bar-Shalom, Li & Kirubarajan 2001, "Estimation with Applications to Tracking and Navigation", ch. 6.2). A
measurement is a place with the ellipse of a bearing and a range. Unseen, it is predicted on. A detection is
this object only where it can have got to (innovation gate), and never one that was seen beside it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from companion.guidance.target import Target
from companion.guidance.track import NEAREST_M, measurement_noise
from companion.vehicle.state import Vector3
from vision.rotation import wrap_angle

# Spectral density of the acceleration, m²/s³: what turns a walk round in a second or two.
ACCELERATION_M2_PER_S3 = 1.5
# Before two looks nothing is known of the velocity, one sigma.
FIRST_VELOCITY_SIGMA_MPS = 2.0
FASTEST_MPS = 15.0
# What is off in a range by attitude, height and slope is off by the same from frame to frame: what one says
# against the last is surer than what it says of the place, by so much of a sigma.
FRAME_TO_FRAME = 0.35
# Unseen, the gate grows without end: a stranger is taken for the object no farther than this from where it is
# expected, and so much more for each second.
REACH_M, REACH_MPS = 1.5, 1.0
# Of two strangers where it is expected, neither is taken unless one fits so much better.
CLEARLY_NEARER = 3.0
# χ² with two degrees of freedom: 99 % of the object's own detections are inside, and the picture's tracker is
# believed without question where 90 % are: where two cars pass each other identities leap.
GATE, SURE_GATE = 9.2, 4.6
# So long unseen, an identity in the picture may have gone over to another.
IDENTITY_S = 0.5
# Unseen for longer than the first, it is in doubt who came out again: for the second, one that fits far
# better what was expected before may take its place.
PARTED_S, DOUBT_S = 0.25, 2.0
# Two boxes in one direction may both be the object.
SAME_BEARING_RAD = 0.03

Vector = NDArray[np.float64]


class _Fit(NamedTuple):
    """A detection inside the gate: its Mahalanobis distance squared, innovation (2,), spread (2, 2)."""

    squared: float
    target: Target
    innovation: Vector
    spread: Vector


class _Parting(NamedTuple):
    """What was known when the object was seen last, kept while it is in doubt who came out again."""

    state: Vector
    covariance: Vector
    captured_ns: int
    others: frozenset[int]
    until_ns: float


class MovingTrack:
    """The filtered place and velocity of one object, begun from a target whose place is known.

    Raises:
        ValueError: the target has no range.
    """

    def __init__(self, target: Target, vehicle: Vector3) -> None:
        if target.position_ned_m is None:
            raise ValueError(f"a track begins with a known place; this {target.class_name} has no range")
        self._class_name = target.class_name
        place = np.array(target.position_ned_m[:2], np.float64)
        self._state: Vector = np.concatenate([place, (0.0, 0.0)])
        self._covariance: Vector = np.zeros((4, 4))
        self._covariance[:2, :2] = measurement_noise(target, place - vehicle[:2])
        self._covariance[2:, 2:] = np.eye(2) * FIRST_VELOCITY_SIGMA_MPS**2
        self._captured_ns = target.captured_ns
        self._track_id = target.track_id
        self._others: set[int] = set()
        self._parting: _Parting | None = None

    @property
    def captured_ns(self) -> int:
        """Capture stamp of the newest detection of this object."""
        return self._captured_ns

    @property
    def track_id(self) -> int | None:
        """The object's identity in the picture; None while it has none."""
        return self._track_id

    def place(self, now_ns: int) -> tuple[float, float]:
        """(north, east) where it is, or is expected to be, at a stamp."""
        ahead_s = max(0.0, (now_ns - self._captured_ns) / 1e9)
        north, east, north_mps, east_mps = (float(value) for value in self._state)
        return (north + north_mps * ahead_s, east + east_mps * ahead_s)

    @property
    def velocity(self) -> tuple[float, float]:
        """Over ground, m/s."""
        return (float(self._state[2]), float(self._state[3]))

    @property
    def speed_sigma_mps(self) -> float:
        """One sigma of the velocity, in its worse direction."""
        return math.sqrt(float(np.linalg.eigvalsh(self._covariance[2:, 2:])[-1]))

    def update(self, targets: Sequence[Target], vehicle: Vector3) -> bool:
        """Take the detection that is this object, if any. True: there was a new one.

        Args:
            targets: of one frame (their stamps equal); a frame already seen changes nothing.
            vehicle: the vehicle's position at its capture, local NED.
        """
        fresh = [t for t in targets if t.class_name == self._class_name and t.captured_ns > self._captured_ns]
        if not fresh:
            return False
        self._go_back(fresh, vehicle)
        elapsed_s = (fresh[0].captured_ns - self._captured_ns) / 1e9
        state, covariance = _predicted(self._state, self._covariance, elapsed_s)
        fitting = []
        for target in fresh:
            innovation, noise = _innovation(target, state, vehicle)
            spread = covariance[:2, :2] + noise
            squared = float(innovation @ np.linalg.solve(spread, innovation))
            if squared <= GATE:
                fitting.append(_Fit(squared, target, innovation, spread))
        # The picture's own tracker knows best, unless its identity has leapt to where the object cannot be.
        # Nor does it know who comes out again from behind something.
        own = None if elapsed_s > IDENTITY_S else self._track_id
        fits = [fit for fit in fitting if own is not None and fit.target.track_id == own]
        if not fits or fits[0].squared > SURE_GATE:
            fits += self._strangers(fitting, state, elapsed_s)
        fits.sort(key=lambda fit: fit.squared)
        if not fits or (len(fits) > 1 and fits[1].squared < CLEARLY_NEARER * max(fits[0].squared, 0.3)):
            return False
        _, target, innovation, spread = fits[0]
        if elapsed_s > PARTED_S and self._parting is None:
            self._parting = _Parting(
                self._state,
                self._covariance,
                self._captured_ns,
                frozenset(self._others),
                target.captured_ns + DOUBT_S * 1e9,
            )
        gain = np.linalg.solve(spread, covariance[:2, :]).T
        self._state = state + gain @ innovation
        # Joseph's form keeps it symmetric and positive.
        kept = np.eye(4)
        kept[:, :2] -= gain
        noise = spread - covariance[:2, :2]
        self._covariance = kept @ covariance @ kept.T + gain @ noise @ gain.T
        speed = math.hypot(*self.velocity)
        if speed > FASTEST_MPS:
            self._state[2:] *= FASTEST_MPS / speed
        self._captured_ns = target.captured_ns
        if target.track_id is not None:
            self._track_id = target.track_id
        fitted = {id(fit.target) for fit in fitting}
        self._note_others([other for other in fresh if id(other) not in fitted], target)
        return True

    def _go_back(self, fresh: Sequence[Target], vehicle: Vector3) -> None:
        """Undo it if the wrong one was taken: another is far nearer to where the object was expected."""
        parting = self._parting
        if parting is None:
            return
        now_ns = fresh[0].captured_ns
        if now_ns > parting.until_ns:
            self._parting = None
            return
        elapsed_s = (now_ns - parting.captured_ns) / 1e9
        state, covariance = _predicted(parting.state, parting.covariance, elapsed_s)

        def squared(target: Target) -> float:
            innovation, noise = _innovation(target, state, vehicle)
            return float(innovation @ np.linalg.solve(covariance[:2, :2] + noise, innovation))

        expected = self.place(now_ns)
        seen = [
            (math.dist(target.position_ned_m[:2], expected), target)
            for target in fresh
            if target.trusted and target.position_ned_m is not None and target.track_id not in parting.others
        ]
        followed = min(seen, key=lambda one: one[0], default=None)
        others = set(parting.others)
        if followed is not None and followed[0] <= REACH_M:
            taken = squared(followed[1])
            seen.remove(followed)
            if followed[1].track_id is not None:
                others.add(followed[1].track_id)
        else:
            aside = np.array(expected) - state[:2]
            taken = float(aside @ np.linalg.solve(covariance[:2, :2], aside))
        if seen and CLEARLY_NEARER * max(min(squared(target) for _, target in seen), 0.1) < taken:
            self._state, self._covariance = parting.state, parting.covariance
            self._captured_ns, self._others = parting.captured_ns, others
            self._track_id = self._parting = None

    def _strangers(self, fitting: list[_Fit], state: Vector, unseen_s: float) -> list[_Fit]:
        """Those that may be this object under another identity: they count as true, and are near enough."""
        reach_m = REACH_M + REACH_MPS * unseen_s
        # Itself, not believed by its identity alone, is one of them where it was away.
        known = self._others if unseen_s > IDENTITY_S else {self._track_id, *self._others}
        near = []
        for fit in fitting:
            target = fit.target
            if not target.trusted or target.position_ned_m is None:
                continue
            if target.track_id is not None and target.track_id in known:
                continue
            north, east, _ = target.position_ned_m
            if math.hypot(north - state[0], east - state[1]) <= reach_m:
                near.append(fit)
        return near

    def _note_others(self, elsewhere: list[Target], own: Target) -> None:
        """What is seen where the object cannot be, in one frame with it, is another one for good."""
        self._others |= {
            target.track_id
            for target in elsewhere
            if target.trusted
            and target.track_id not in (None, self._track_id)
            and abs(wrap_angle(target.bearing_rad - own.bearing_rad)) > SAME_BEARING_RAD
        }


def _predicted(state: Vector, covariance: Vector, elapsed_s: float) -> tuple[Vector, Vector]:
    """State and covariance after a time of constant velocity and white acceleration."""
    move = np.eye(4)
    move[0, 2] = move[1, 3] = elapsed_s
    q = ACCELERATION_M2_PER_S3
    noise = np.zeros((4, 4))
    for axis in (0, 1):
        noise[axis, axis] = q * elapsed_s**3 / 3.0
        noise[axis, axis + 2] = noise[axis + 2, axis] = q * elapsed_s**2 / 2.0
        noise[axis + 2, axis + 2] = q * elapsed_s
    return move @ state, move @ covariance @ move.T + noise


def _innovation(target: Target, state: Vector, vehicle: Vector3) -> tuple[Vector, Vector]:
    """(2,) what was measured beyond what was expected, and the (2, 2) noise of that."""
    if target.position_ned_m is not None:
        measured = np.array(target.position_ned_m[:2])
    else:
        # A bearing alone: a place in that direction as far away as the object is thought to be.
        range_m = max(NEAREST_M, float(np.hypot(*(state[:2] - vehicle[:2]))))
        measured = np.array(
            (
                vehicle[0] + range_m * math.cos(target.bearing_rad),
                vehicle[1] + range_m * math.sin(target.bearing_rad),
            )
        )
    noise = measurement_noise(target, measured - vehicle[:2]) * FRAME_TO_FRAME**2
    return measured - state[:2], noise
