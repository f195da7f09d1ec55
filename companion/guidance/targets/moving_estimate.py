"""Horizontal motion estimate of one object: a constant-velocity Kalman filter.

The state is position and velocity (north, east), local NED, driven by white acceleration (Bar-Shalom, Li &
Kirubarajan 2001, "Estimation with Applications to Tracking and Navigation", ch. 6.2). A measurement is a
position with the error ellipse of bearing and range, or a bearing alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from companion.guidance.targets.target import RangeSource, Target
from companion.guidance.targets.track import NEAREST_M, measurement_noise
from companion.vehicle.state import Vector3

# Spectral density of the acceleration, m²/s³: a walking person reverses in one or two seconds.
ACCELERATION_M2_PER_S3 = 1.5
# One sigma of the unknown initial velocity.
FIRST_VELOCITY_SIGMA_MPS = 2.0
FASTEST_MPS = 15.0
# Range errors from attitude, height and slope are correlated between frames: relative to the last frame the
# noise is this fraction of a sigma, unless the range source has changed.
FRAME_TO_FRAME = 0.35

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
    def off_m(self) -> float:
        """Distance from the expected position."""
        return float(np.hypot(*self.innovation))


@dataclass(frozen=True, slots=True)
class MovingEstimate:
    """Horizontal position and velocity of an object at a time.

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
        return cls(
            np.concatenate([position, (0.0, 0.0)]), covariance, target.captured_ns, target.range_source
        )

    @property
    def velocity(self) -> tuple[float, float]:
        """(north, east), m/s."""
        return (float(self.state[2]), float(self.state[3]))

    def at(self, stamp_ns: int) -> MovingEstimate:
        """Predict to a time with constant velocity and white acceleration."""
        elapsed_s = max(0.0, (stamp_ns - self.captured_ns) / 1e9)
        move = np.eye(4)
        move[0, 2] = move[1, 3] = elapsed_s
        q = ACCELERATION_M2_PER_S3
        noise = np.zeros((4, 4))
        for axis in (0, 1):
            noise[axis, axis] = q * elapsed_s**3 / 3.0
            noise[axis, axis + 2] = noise[axis + 2, axis] = q * elapsed_s**2 / 2.0
            noise[axis + 2, axis + 2] = q * elapsed_s
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
        noise = measurement_noise(target, measured - vehicle[:2])
        if target.range_source in (self.source, RangeSource.NONE):
            noise = noise * FRAME_TO_FRAME**2
        innovation = measured - self.state[:2]
        spread = self.covariance[:2, :2] + noise
        return Fit(float(innovation @ np.linalg.solve(spread, innovation)), target, innovation, spread)

    def update(self, fit: Fit) -> MovingEstimate:
        """The estimate updated with a detection."""
        gain = np.linalg.solve(fit.spread, self.covariance[:2, :]).T
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
        return MovingEstimate(state, covariance, self.captured_ns, source)
