"""Horizontal position and velocity of one object: the Kalman filter of standing and moving objects.

The state is position and velocity (north, east), local NED. A moving object is driven by white acceleration
(Bar-Shalom, Li & Kirubarajan 2001, "Estimation with Applications to Tracking and Navigation", ch. 6.2); a
standing one has no velocity, and its position is a random walk. A measurement is a position with the error
ellipse of bearing and range, or a bearing alone, which corrects only across the line of sight.
"""

from __future__ import annotations

import math
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
# One sigma of the unknown initial velocity.
FIRST_VELOCITY_SIGMA_MPS = 2.0
FASTEST_MPS = 15.0
# Range errors from attitude, height and slope are correlated between frames, those of depth are not: relative
# to the last frame the noise of a moving object is this fraction of a sigma, unless the source has changed.
_CORRELATED = frozenset({RangeSource.GROUND_PLANE, RangeSource.KNOWN_HEIGHT, RangeSource.MARKER})
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
    """Horizontal position and velocity of an object at a time.

    Attributes:
        state: (4,) north, east, metres; north, east, m/s. covariance: (4, 4).
        captured_ns: that time.
        source: range source of the newest measurement.
        moving: whether the object may have a velocity.
    """

    state: Vector
    covariance: Vector
    captured_ns: int
    source: RangeSource
    moving: bool

    @classmethod
    def initialize(cls, target: Target, vehicle: Vector3, *, moving: bool = True) -> Self:
        """Initialize from a target. Raises ValueError if it has no range."""
        if target.position_ned_m is None:
            raise ValueError(f"cannot initialize a track: {target.class_name!r} has no range")
        position = np.array(target.position_ned_m[:2], np.float64)
        covariance = np.zeros((4, 4))
        covariance[:2, :2] = measurement_noise(target, position - vehicle[:2])
        if moving:
            covariance[2:, 2:] = np.eye(2) * FIRST_VELOCITY_SIGMA_MPS**2
        state = np.concatenate([position, (0.0, 0.0)])
        return cls(state, covariance, target.captured_ns, target.range_source, moving)

    @property
    def velocity(self) -> tuple[float, float]:
        """(north, east), m/s."""
        return (float(self.state[2]), float(self.state[3]))

    def at(self, stamp_ns: int) -> Estimate:
        """Predict to a time."""
        elapsed_s = max(0.0, (stamp_ns - self.captured_ns) / 1e9)
        move = np.eye(4)
        move[0, 2] = move[1, 3] = elapsed_s
        noise = acceleration_noise(elapsed_s)
        if not self.moving:
            noise = np.diag([RANDOM_WALK_M2_PER_S * elapsed_s] * 2 + [0.0] * 2)
        return replace(
            self,
            state=move @ self.state,
            covariance=move @ self.covariance @ move.T + noise,
            captured_ns=stamp_ns,
        )

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
        same = target.range_source is RangeSource.NONE or (
            target.range_source is self.source and self.source in _CORRELATED
        )
        alike = self.moving and same
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
        return Estimate(state, covariance, self.captured_ns, source, self.moving)


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


def acceleration_noise(elapsed_s: float) -> NDArray[np.float64]:
    """(4, 4) covariance that an unknown acceleration adds to position and velocity in this time."""
    q = ACCELERATION_M2_PER_S3
    position, mixed, velocity = q * elapsed_s**3 / 3.0, q * elapsed_s**2 / 2.0, q * elapsed_s
    return np.array(
        (
            (position, 0.0, mixed, 0.0),
            (0.0, position, 0.0, mixed),
            (mixed, 0.0, velocity, 0.0),
            (0.0, mixed, 0.0, velocity),
        )
    )


def measurement_noise(
    target: Target, line_of_sight: NDArray[np.float64], share: float = 1.0
) -> NDArray[np.float64]:
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
    bearing_rad = math.atan2(line_of_sight[1], line_of_sight[0])
    least_m = JITTER_M if target.range_source is RangeSource.DEPTH else 0.0
    return position_covariance(bearing_rad, max(share * sigma_along, least_m), share * sigma_across)
