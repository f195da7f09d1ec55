"""Where one object is: two models of its motion, fed with the detections that are associated with it.

A moving object has a Kalman filter's position and velocity (`Estimate`), driven by white acceleration
(Bar-Shalom, Li & Kirubarajan 2001, "Estimation with Applications to Tracking and Navigation", ch. 6.2). A
measurement is a position with the error ellipse of bearing and range, or a bearing alone, which corrects only
across the line of sight. A standing object has the position of all its detections, each weighted by its
information. Most errors of two frames have one cause: attitude, height, the object's size. Covariance
intersection with equal weights (Julier & Uhlmann 1997) holds for any correlation: the covariance is the
inverse of the mean information, and the position is the one that independent errors would give. Slow motion
leaves that position behind the object, so detections are forgotten, and one that disagrees begins again.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from companion.guidance.objects.target import RangeSource, Target
from companion.vehicle.state import Vector3
from vision.geolocation import position_covariance

# Random walk of a standing object: 1 m in 1 s, one sigma, a walking person's pace.
RANDOM_WALK_M2_PER_S = 1.0
# Spectral density of the acceleration, m²/s³: a walking person reverses in one or two seconds.
ACCELERATION_M2_PER_S3 = 1.5
# As the acceleration, of a marker's object: a landing pad drives straight on, or its position drifts with
# the vehicle's estimate, in which it is. What turns at once is begun again (`ObjectTable`). And the wander of
# that estimate: 0.1 m in 1 s, one sigma, far below the error of any other object.
MARKER_ACCELERATION_M2_PER_S3, WANDER_M2_PER_S = 0.1, 0.01
# One sigma of the unknown initial velocity.
FIRST_VELOCITY_SIGMA_MPS = 2.0
FASTEST_MPS = 15.0
# Range errors from attitude, height and slope are correlated between frames, those of depth are not: relative
# to the last frame the noise of a moving object is this fraction of a sigma, unless the source has changed.
_CORRELATED = frozenset({RangeSource.GROUND_PLANE, RangeSource.KNOWN_HEIGHT})
FRAME_TO_FRAME = 0.35
# That of depth is not less than this along the line of sight: the nearest point of a surface jumps.
JITTER_M = 0.2
# Noise of one measurement across the line of sight, one sigma: a few pixels and a degree of attitude.
BEARING_SIGMA_RAD = 0.03
ACROSS_SIGMA_M = 0.25
# Along the line of sight, for targets without their own sigma: fixed, and per metre of range.
UNSTATED_SIGMA = (0.3, 0.12)
UNKNOWN_RANGE_SIGMA_M = 1e3
NEAREST_M = 0.3
# An object moves if its estimated speed exceeds this and so many sigma. Errors of the range of a vehicle that
# flies towards a standing object show as some tenths of its own speed.
MOVING_MPS, MOVING_SIGMA = 1.0, 3.0
# Or if it was displaced at one of these speeds for so long: a slow detector gives no sure speeds, and a slow
# object no significant ones.
DISPLACED = ((1.5, 1.0), (3.0, 0.4))
# And by one sigma of its position, and by more than the errors of a standing object change as the vehicle
# flies: most of a range's error has one cause, so that it goes along with the line of sight and its sigma;
# from another side another point of its surface is seen, off by up to this share of the way across.
COMMON_SIGMA, ACROSS_SHARE = 1.5, 0.4
# Older detections count less, by this time constant: an object slower than `MOVING_MPS` may still move.
MEMORY_S, MEMORY_OF_DEPTH_S, MEMORY_OF_MARKER_S = 5.0, 2.0, 0.3
# Share of the difference by which a marker's detection changes the height of its object.
HEIGHT_SHARE = 0.25
# A detection this many sigma from the fused position shows that the object has moved.
RESTART_SIGMA = 3.0
# Not seen whole, with a range, for so long an object may be anywhere, although it is still detected.
STALE_S = 2.5
# Unseen for longer, an object that did not move is expected only where it stood.
STOOD_S = 4.0
# A box at the image's upper edge shows a part of an object if it is lower than this share of the newest box
# that the edge did not cut off: of an object that leaves at the top, half of its width may be detected last.
PART = 0.5

Vector = NDArray[np.float64]


class Fit(NamedTuple):
    """The innovation of a detection against an estimate at its time.

    Attributes:
        squared: Mahalanobis distance squared.
        innovation: (2,) metres north and east of the expected position.
        spread: (2, 2) its covariance.
    """

    squared: float
    target: Target
    innovation: Vector
    spread: Vector

    @property
    def unlikelihood(self) -> float:
        """For comparing objects: of a distance alone, a vague expectation would explain everything better."""
        (nn, ne), (_, ee) = self.spread.tolist()
        return self.squared + math.log(nn * ee - ne * ne)

    @property
    def off_m(self) -> float:
        """Distance from the expected position."""
        return float(np.hypot(*self.innovation))


@dataclass(frozen=True, slots=True)
class Estimate:
    """Horizontal position and velocity of a moving object at a time.

    Attributes:
        state: (4,) north, east, metres; north, east, m/s. covariance: (4, 4).
        captured_ns: that time.
        source: range source of the newest measurement.
    """

    state: Vector
    covariance: Vector
    captured_ns: int
    source: RangeSource

    @classmethod
    def initialize(cls, target: Target, vehicle: Vector3) -> Self:
        """Initialize from a target. Raises ValueError if it has no range."""
        if target.position_ned_m is None:
            raise ValueError(f"cannot initialize a track: {target.class_name!r} has no range")
        position = np.array(target.position_ned_m[:2], np.float64)
        covariance = np.zeros((4, 4))
        covariance[:2, :2] = measurement_noise(target, position - vehicle[:2])
        covariance[2:, 2:] = np.eye(2) * FIRST_VELOCITY_SIGMA_MPS**2
        state = np.concatenate([position, (0.0, 0.0)])
        return cls(state, covariance, target.captured_ns, target.range_source)

    @property
    def velocity(self) -> tuple[float, float]:
        """(north, east), m/s."""
        return (float(self.state[2]), float(self.state[3]))

    def at(self, stamp_ns: int) -> Estimate:
        """Predict to a time."""
        elapsed_s = max(0.0, (stamp_ns - self.captured_ns) / 1e9)
        move = transition(elapsed_s)
        covariance = predicted_covariance(self.covariance, elapsed_s, self.source)
        return replace(self, state=move @ self.state, covariance=covariance, captured_ns=stamp_ns)

    def fit(self, target: Target, vehicle: Vector3) -> Fit:
        """The innovation of a detection at this time; `vehicle`: the vehicle's position then, local NED."""
        if target.position_ned_m is not None:
            measured = np.array(target.position_ned_m[:2])
        else:
            # Bearing alone: a position in that direction at the estimated range.
            range_m = max(NEAREST_M, float(np.hypot(*(self.state[:2] - vehicle[:2]))))
            measured = np.array(
                (
                    vehicle[0] + range_m * math.cos(target.bearing_rad),
                    vehicle[1] + range_m * math.sin(target.bearing_rad),
                )
            )
        alike = target.range_source is RangeSource.NONE or (
            target.range_source is self.source and self.source in _CORRELATED
        )
        noise = measurement_noise(target, measured - vehicle[:2], FRAME_TO_FRAME if alike else 1.0)
        innovation = measured - self.state[:2]
        spread = self.covariance[:2, :2] + noise
        return Fit(squared_distance(innovation, spread), target, innovation, spread)

    def update(self, fit: Fit) -> Estimate:
        """The estimate updated with a detection."""
        gain = self.covariance[:, :2] @ inverse(fit.spread)
        state = self.state + gain @ fit.innovation
        speed = math.hypot(state[2], state[3])
        if speed > FASTEST_MPS:
            state[2:] *= FASTEST_MPS / speed
        # Joseph form keeps it symmetric and positive definite.
        kept = np.eye(4)
        kept[:, :2] -= gain
        noise = fit.spread - self.covariance[:2, :2]
        covariance = kept @ self.covariance @ kept.T + gain @ noise @ gain.T
        source = self.source if fit.target.position_ned_m is None else fit.target.range_source
        return Estimate(state, covariance, self.captured_ns, source)


class PositionFilter:
    """Position and velocity of one object.

    Attributes:
        motion: of the moving model, at the newest detection.
        moving: the object moves.
        located_ns: capture of the newest detection that showed all of it with a range.

    Raises:
        ValueError: the first target has no range.
    """

    def __init__(self, target: Target, vehicle: Vector3) -> None:
        self._begin(target, vehicle, 0.0)

    def restart(self, detections: Sequence[tuple[Target, Vector3]]) -> None:
        """Begin again at the last of these, each with the vehicle's position; their spread is an error."""
        target, vehicle = detections[-1]
        places = [other.position_ned_m[:2] for other, _ in detections if other.position_ned_m is not None]
        spread = np.cov(places, rowvar=False)
        self._begin(target, vehicle, spread)
        self.motion.covariance[:2, :2] += spread

    def _begin(self, target: Target, vehicle: Vector3, spread: Vector | float) -> None:
        self.motion = Estimate.initialize(target, vehicle)
        self.moving, self._cut = False, target.cut
        self._whole_height = 0.0
        assert target.position_ned_m is not None
        self._down_m = target.position_ned_m[2]
        self._was = deque([(target.captured_ns, self.motion.state, vehicle, _along(target, vehicle))])
        self._begin_fusion()
        self._fuse(np.array(target.position_ned_m[:2]), _covariance(target, vehicle) + spread)
        self._note_whole(target)

    def update(self, expected: Estimate, fit: Fit, vehicle: Vector3) -> None:
        """Add a detection.

        Where the image's edge cuts a box off, an object seems to move: such a detection, and one of a small
        part, counts for a standing object's position only until it is seen whole.

        Args:
            expected: `motion` at its capture. fit: the detection in it.
        """
        target = fit.target
        self.motion = expected.update(fit)
        partly = (target.cut and not self._cut) or self.is_part(target)
        if partly and not self._stale(target.captured_ns):
            return
        if target.position_ned_m is None:
            # Across the line of sight a bearing counts as much as a position.
            place = expected.state[:2] + fit.innovation
            covariance = measurement_noise(target, place - vehicle[:2])
            if self._disagrees(place, covariance):
                self._begin_fusion()
                place, covariance = self.motion.state[:2], self.motion.covariance[:2, :2]
            self._fuse(place, covariance)
            return
        if partly:
            self.moving = self._moves(target, vehicle)
            self._begin_fusion()
            self._fuse(self.motion.state[:2], self.motion.covariance[:2, :2])
            return
        place, covariance = np.array(target.position_ned_m[:2]), _covariance(target, vehicle)
        self.moving = self._moves(target, vehicle)
        if self.moving or self._disagrees(place, covariance):
            self._begin_fusion()
        self._forget((target.captured_ns - self.located_ns) / 1e9)
        self._fuse(place, covariance)
        self._note_whole(target)

    def predict(self, now_ns: int) -> None:
        """Go on without a detection that says where it is."""
        self.motion = self.motion.at(now_ns)

    def _moves(self, target: Target, vehicle: Vector3) -> bool:
        now_ns, longest_s = target.captured_ns, DISPLACED[-1][0]
        along = _along(target, vehicle)
        sigma_m = math.hypot(*along)
        while len(self._was) > 1 and now_ns - self._was[1][0] >= longest_s * 1e9:
            self._was.popleft()
        self._was.append((now_ns, self.motion.state, vehicle, along))
        for duration_s, speed_mps in DISPLACED:
            before = [was for was in self._was if now_ns - was[0] >= duration_s * 1e9]
            if before:
                since_ns, then, vehicle_then, along_then = before[-1]
                displaced_m = math.hypot(*(self.motion.state - then)[:2])
                north, east = vehicle[0] - vehicle_then[0], vehicle[1] - vehicle_then[1]
                across_m = abs(along[0] * east - along[1] * north) / max(sigma_m, 1e-6)
                common_m = math.hypot(*(along - along_then))
                least_m = max(ACROSS_SHARE * across_m, COMMON_SIGMA * common_m, sigma_m)
                if displaced_m > max(speed_mps * (now_ns - since_ns) / 1e9, least_m):
                    return True
        speed_sigma_mps = math.sqrt(float(np.trace(self.motion.covariance[2:, 2:])))
        return math.hypot(*self.motion.velocity) > max(MOVING_MPS, MOVING_SIGMA * speed_sigma_mps)

    def at(self, now_ns: int, *, unseen: bool) -> list[Estimate]:
        """Where it may be: on its way; and, after a while `unseen`, where it stood, unless it surely moves.

        From frame to frame the way is right; a noisy speed leads an unseen object away, and after `STOOD_S`
        its way could be anywhere, so that it would fit every other object's detections.
        """
        ways = [self.motion.at(now_ns)]
        if unseen and not self.moving:
            place, fused = self._fused
            elapsed_s = (now_ns - self.motion.captured_ns) / 1e9
            covariance = np.diag([0.0] * 2 + [FIRST_VELOCITY_SIGMA_MPS**2] * 2)
            covariance[:2, :2] = fused + np.eye(2) * RANDOM_WALK_M2_PER_S * elapsed_s
            state = np.concatenate([place, (0.0, 0.0)])
            stood = Estimate(state, covariance, now_ns, self.motion.source)
            ways = [stood] if elapsed_s > STOOD_S else [*ways, stood]
        return ways

    def places(self, now_ns: int, *, unseen: bool) -> list[tuple[float, ...]]:
        """North and east of `at`, which costs much more."""
        elapsed_s = max(0.0, (now_ns - self.motion.captured_ns) / 1e9)
        north, east, north_mps, east_mps = self.motion.state.tolist()
        stood: list[tuple[float, ...]] = []
        if unseen and not self.moving:
            stood = [tuple(self._fused[0].tolist())]
            if elapsed_s > STOOD_S:
                return stood
        return [(north + elapsed_s * north_mps, east + elapsed_s * east_mps), *stood]

    def begins_again(self, target: Target) -> bool:
        """Whether this is the first detection that the image's edge does not cut off."""
        return self._cut and not target.cut and target.position_ned_m is not None

    def stands(self, now_ns: int) -> bool:
        """Whether it stands where it was lately seen whole."""
        return not self.moving and not self._stale(now_ns)

    def _stale(self, now_ns: int) -> bool:
        """Whether where it was last seen whole says nothing any more."""
        return now_ns - self.located_ns > STALE_S * 1e9

    def is_part(self, target: Target) -> bool:
        """Whether the middle of this box is not the object's."""
        return target.cut_above and _height(target) < PART * self._whole_height

    def state(self) -> tuple[Vector3, Vector]:
        """Position in local NED, and (4, 4) covariance of north, east and their velocities."""
        # The filter's own covariance is from frame to frame: what all frames share is in the detections'.
        place, fused = self._fused
        if self.moving or self.motion.source is RangeSource.MARKER:
            # A marker's position is so exact that the estimate's drift shows: it is followed.
            place = self.motion.state[:2]
        else:
            # How far the newest detections are from the fused position is part of its error.
            behind = self.motion.state[:2] - place
            fused = fused + np.outer(behind, behind)
        # Scaled to it, so that position and velocity stay correlated as the filter has them.
        scale = np.eye(4)
        scale[:2, :2] = root(fused) @ inverse(root(self.motion.covariance[:2, :2]))
        covariance = scale @ self.motion.covariance @ scale.T
        covariance[:2, :2] += np.eye(2) * self._vehicle_sigma_m**2
        return (float(place[0]), float(place[1]), self._down_m), covariance

    def _disagrees(self, measured: Vector, covariance: Vector) -> bool:
        place, fused = self._fused
        away = measured - place
        spread = fused + covariance + np.eye(2) * JITTER_M**2
        return squared_distance(away, spread) > RESTART_SIGMA**2

    def _begin_fusion(self) -> None:
        self._information, self._weighted, self._count = np.zeros((2, 2)), np.zeros(2), 0.0

    def _forget(self, elapsed_s: float) -> None:
        memory_s = {RangeSource.DEPTH: MEMORY_OF_DEPTH_S, RangeSource.MARKER: MEMORY_OF_MARKER_S}
        kept = math.exp(-elapsed_s / memory_s.get(self.motion.source, MEMORY_S))
        self._information, self._weighted = self._information * kept, self._weighted * kept
        self._count *= kept

    def _fuse(self, measured: Vector, covariance: Vector) -> None:
        information = inverse(covariance)
        self._information = self._information + information
        self._weighted = self._weighted + information @ measured
        self._count += 1
        # Forgetting changes neither of the two: it weighs all alike.
        covariance = inverse(self._information / self._count)
        self._fused = covariance @ (self._weighted / self._count), covariance

    def _note_whole(self, target: Target) -> None:
        assert target.position_ned_m is not None
        down_m = target.position_ned_m[2]
        if target.range_source is RangeSource.MARKER:
            down_m = self._down_m + HEIGHT_SHARE * (down_m - self._down_m)
        self._down_m = down_m
        self.located_ns, self._vehicle_sigma_m = target.captured_ns, target.vehicle_sigma_m
        if not target.cut_above:
            self._whole_height = _height(target)


def _covariance(target: Target, vehicle: Vector3) -> Vector:
    """(2, 2) covariance of a position: as stated, else by the kind of its range."""
    stated = target.position_covariance
    if stated is not None:
        return stated
    assert target.position_ned_m is not None
    return measurement_noise(target, np.array(target.position_ned_m[:2]) - vehicle[:2])


def _along(target: Target, vehicle: Vector3) -> Vector:
    """(2,) one sigma of a position, along the line of sight."""
    assert target.position_ned_m is not None
    towards = np.array(target.position_ned_m[:2]) - vehicle[:2]
    sigma_m = largest_sigma(_covariance(target, vehicle))
    return np.asarray(towards * (sigma_m / max(float(np.hypot(*towards)), NEAREST_M)))


def _height(target: Target) -> float:
    """Of its box, in pixels at a range of 1 m, so that it is the same from near and far."""
    _, top, _, bottom = target.box_xyxy
    return (bottom - top) * target.ground_range_m


def squared_distance(offset: Vector, covariance: Vector) -> float:
    """Mahalanobis distance squared of a (2,) offset, by a (2, 2) covariance."""
    (nn, ne), (_, ee) = covariance.tolist()
    north, east = offset.tolist()
    return float((ee * north * north - 2.0 * ne * north * east + nn * east * east) / (nn * ee - ne * ne))


def inverse(covariance: Vector) -> Vector:
    """Of a (2, 2) covariance. Written out: of so few numbers NumPy's own takes ten times as long."""
    (nn, ne), (_, ee) = covariance.tolist()
    share = 1.0 / (nn * ee - ne * ne)
    return np.array(((share * ee, -share * ne), (-share * ne, share * nn)))


def root(covariance: Vector) -> Vector:
    """The symmetric square root of a (2, 2) covariance."""
    (nn, ne), (_, ee) = covariance.tolist()
    added = math.sqrt(max(nn * ee - ne * ne, 1e-24))
    share = 1.0 / math.sqrt(nn + ee + 2.0 * added)
    return np.array(((share * (nn + added), share * ne), (share * ne, share * (ee + added))))


def largest_sigma(covariance: Vector) -> float:
    """One sigma of a (2, 2) covariance along the longer axis of its ellipse."""
    (nn, ne), (_, ee) = covariance.tolist()
    return math.sqrt(max(0.0, 0.5 * (nn + ee) + math.hypot(0.5 * (nn - ee), ne)))


def transition(elapsed_s: float) -> Vector:
    """(4, 4) motion of position and velocity without an acceleration."""
    move = np.eye(4)
    move[0, 2] = move[1, 3] = elapsed_s
    return move


def predicted_covariance(covariance: Vector, elapsed_s: float, source: RangeSource) -> Vector:
    """A (4, 4) covariance after this time, in which an unknown acceleration adds to it.

    Where the range comes from a marker, the wander of the vehicle's own estimate adds to it, too.
    """
    move, by_marker = transition(elapsed_s), source is RangeSource.MARKER
    q = MARKER_ACCELERATION_M2_PER_S3 if by_marker else ACCELERATION_M2_PER_S3
    position, mixed, velocity = q * elapsed_s**3 / 3.0, q * elapsed_s**2 / 2.0, q * elapsed_s
    position += WANDER_M2_PER_S * elapsed_s if by_marker else 0.0
    noise = np.array(
        (
            (position, 0.0, mixed, 0.0),
            (0.0, position, 0.0, mixed),
            (mixed, 0.0, velocity, 0.0),
            (0.0, mixed, 0.0, velocity),
        )
    )
    return np.asarray(move @ covariance @ move.T + noise)


def measurement_noise(target: Target, line_of_sight: Vector, share: float = 1.0) -> Vector:
    """(2, 2) covariance of a measured position, given the vector from the vehicle to it.

    Args:
        share: of its error that differs from one frame to the next.
    """
    range_m = max(NEAREST_M, float(np.hypot(*line_of_sight)))
    if target.range_source is RangeSource.NONE:
        sigma_along = UNKNOWN_RANGE_SIGMA_M
    elif math.isfinite(target.range_sigma_m):
        sigma_along = target.range_sigma_m
    else:
        sigma_along = math.hypot(UNSTATED_SIGMA[0], UNSTATED_SIGMA[1] * range_m)
    sigma_across = math.hypot(ACROSS_SIGMA_M, BEARING_SIGMA_RAD * range_m)
    if target.range_source is RangeSource.MARKER and math.isfinite(target.across_sigma_m):
        sigma_across = target.across_sigma_m  # above is that of a box
    bearing_rad = math.atan2(line_of_sight[1], line_of_sight[0])
    least_m = JITTER_M if target.range_source is RangeSource.DEPTH else 0.0
    return position_covariance(bearing_rad, max(share * sigma_along, least_m), share * sigma_across)
