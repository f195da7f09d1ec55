"""Landing pad filter: position from marker detections, weighted by distance.

Horizontally one Kalman filter per axis, constant velocity (Bar-Shalom, Li and Kirubarajan 2001, 6.3); the
pad's height is averaged. Positions are local NED: the pad's drifts with the vehicle's own estimate, as a
landing relative to the pad requires.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.guidance.objects.from_markers import MarkerTarget
from companion.vehicle.state import Vector3

# One sigma of a detection: corners and calibration, and one degree of attitude at its distance.
SIGHT_SIGMA_M, SIGHT_SIGMA_PER_M = 0.02, 0.018
# Process noise: wander in our own estimate, m/√s; acceleration of the pad, or of the estimate's drift, m/s².
WANDER_M, ACCELERATION_MPS2 = 0.1, 0.6
FIRST_SPEED_MPS = 1.0
# Of a static pad in the estimate, and how long a drift lasts unseen.
FIRST_DRIFT_MPS, DRIFT_S = 0.3, 0.6
# Outlier gate: sigmas plus metres. After DOUBTS_BELIEVED outliers in a row the filter restarts there.
GATE_SIGMAS, GATE_M = 4.0, 0.3
DOUBTS_BELIEVED = 6
HEIGHT_SHARE = 0.25
LONGEST_GAP_S = 2.0


@dataclass(slots=True)
class _Axis:
    """Position and velocity along one axis, with their covariance."""

    position: float
    speed: float
    pp: float
    pv: float
    vv: float

    def predict(self, dt_s: float) -> None:
        q = ACCELERATION_MPS2**2
        self.position += self.speed * dt_s
        self.pp += 2 * dt_s * self.pv + dt_s**2 * self.vv + q * dt_s**4 / 4 + WANDER_M**2 * dt_s
        self.pv += dt_s * self.vv + q * dt_s**3 / 2
        self.vv += q * dt_s**2

    def correct(self, measured: float, variance: float) -> None:
        total = self.pp + variance
        gain_position, gain_speed = self.pp / total, self.pv / total
        off = measured - self.position
        self.position += gain_position * off
        self.speed += gain_speed * off
        self.vv -= gain_speed * self.pv
        self.pv *= 1.0 - gain_position
        self.pp *= 1.0 - gain_position


class PadFilter:
    """Position and velocity filter of one pad, initialized by its first detection.

    A static pad moves too: by the drift of the estimate in which it is located, 0.2 m/s for a second or two.

    Attributes:
        captured_ns: CLOCK_MONOTONIC of the newest accepted detection.
        count: number of accepted detections.
    """

    def __init__(self, first: MarkerTarget, *, moving: bool) -> None:
        self._moving = moving
        self._begin(first)

    def _begin(self, detection: MarkerTarget) -> None:
        variance = _variance(detection)
        speed_variance = (FIRST_SPEED_MPS if self._moving else FIRST_DRIFT_MPS) ** 2
        north, east, self._down_m = detection.pad_ned_m
        self._axes = [_Axis(value, 0.0, variance, 0.0, speed_variance) for value in (north, east)]
        self._filtered_ns = self.captured_ns = detection.captured_ns
        self._doubts = 0
        self.count = 1

    def add(self, detection: MarkerTarget) -> bool:
        """Add a detection, newer or of the same frame; False: it is old, or rejected as an outlier."""
        dt_s = (detection.captured_ns - self._filtered_ns) / 1e9
        if dt_s < 0.0:
            return False
        if dt_s > LONGEST_GAP_S:
            self._begin(detection)
            return True
        for axis in self._axes:
            axis.predict(dt_s)
        self._filtered_ns = detection.captured_ns
        variance, position = _variance(detection), detection.pad_ned_m
        off_m = math.hypot(position[0] - self._axes[0].position, position[1] - self._axes[1].position)
        if off_m > GATE_M + GATE_SIGMAS * math.sqrt(variance + self._axes[0].pp):
            self._doubts += 1
            if self._doubts >= DOUBTS_BELIEVED:
                self._begin(detection)
                return True
            return False
        for axis, measured in zip(self._axes, position[:2], strict=True):
            axis.correct(measured, variance)
        self._down_m += HEIGHT_SHARE * (position[2] - self._down_m)
        self._doubts = 0
        self.captured_ns = detection.captured_ns
        self.count += 1
        return True

    def at(self, now_ns: int) -> Vector3:
        """Position at a time, local NED; predicted with constant velocity, a static pad for `DRIFT_S`."""
        ahead_s = max(0.0, (now_ns - self._filtered_ns) / 1e9)
        ahead_s = ahead_s if self._moving else min(ahead_s, DRIFT_S)
        north, east = (axis.position + axis.speed * ahead_s for axis in self._axes)
        return (north, east, self._down_m)

    def velocity_at(self, now_ns: int) -> tuple[float, float]:
        """(north, east) of the position at a time, m/s."""
        if not self._moving and (now_ns - self._filtered_ns) / 1e9 > DRIFT_S:
            return (0.0, 0.0)
        return (self._axes[0].speed, self._axes[1].speed)

    def unseen_s(self, now_ns: int) -> float:
        """Time since the newest accepted detection."""
        return (now_ns - self.captured_ns) / 1e9


def _variance(detection: MarkerTarget) -> float:
    return (SIGHT_SIGMA_M + SIGHT_SIGMA_PER_M * detection.distance_m) ** 2
