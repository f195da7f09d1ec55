"""Where a landing pad is: sightings of its marker, filtered, each with the certainty of its distance.

Over ground a Kalman filter an axis, of constant position or of constant velocity (Bar-Shalom, Li and
Kirubarajan 2001, 6.3); the pad's height is averaged. Places are local NED: where the vehicle's own estimate
wanders, the pad's place wanders with it, which is what a landing relative to the pad needs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.guidance.targets.from_markers import MarkerTarget
from companion.vehicle.state import Vector3

# One sigma of a sighting: corners and calibration, and one degree of attitude at its distance.
SIGHT_SIGMA_M, SIGHT_SIGMA_PER_M = 0.02, 0.018
# How fast a still pad's place wanders in our own estimate, m/√s; what a moving one's velocity may do, m/s².
WANDER_M, ACCELERATION_MPS2 = 0.1, 0.6
FIRST_SPEED_MPS = 1.0
# Farther off than so many sigmas, and this much, a sighting is doubted; so many in a row are believed.
GATE_SIGMAS, GATE_M = 4.0, 0.3
DOUBTS_BELIEVED = 6
HEIGHT_SHARE = 0.25
LONGEST_GAP_S = 2.0


@dataclass(slots=True)
class _Axis:
    """Place and velocity along one axis, with their covariance."""

    place: float
    speed: float
    pp: float
    pv: float
    vv: float

    def predict(self, dt_s: float, moving: bool) -> None:
        if not moving:
            self.pp += WANDER_M**2 * dt_s
            return
        q = ACCELERATION_MPS2**2
        self.place += self.speed * dt_s
        self.pp += 2 * dt_s * self.pv + dt_s**2 * self.vv + q * dt_s**4 / 4 + WANDER_M**2 * dt_s
        self.pv += dt_s * self.vv + q * dt_s**3 / 2
        self.vv += q * dt_s**2

    def correct(self, measured: float, variance: float) -> None:
        total = self.pp + variance
        gain_place, gain_speed = self.pp / total, self.pv / total
        off = measured - self.place
        self.place += gain_place * off
        self.speed += gain_speed * off
        self.vv -= gain_speed * self.pv
        self.pv *= 1.0 - gain_place
        self.pp *= 1.0 - gain_place


class PadFilter:
    """Of one pad, from its first sighting on.

    Attributes:
        captured_ns: CLOCK_MONOTONIC of the newest sighting that was believed.
        count: how many were.
    """

    def __init__(self, first: MarkerTarget, *, moving: bool) -> None:
        self._moving = moving
        self._begin(first)

    def _begin(self, sighting: MarkerTarget) -> None:
        variance = _variance(sighting)
        speed_variance = FIRST_SPEED_MPS**2 if self._moving else 0.0
        north, east, self._down_m = sighting.pad_ned_m
        self._axes = [_Axis(value, 0.0, variance, 0.0, speed_variance) for value in (north, east)]
        self._filtered_ns = self.captured_ns = sighting.captured_ns
        self._doubts = 0
        self.count = 1

    def add(self, sighting: MarkerTarget) -> bool:
        """Take a sighting, newer or of the same frame; False: it is old, or doubted and left out."""
        dt_s = (sighting.captured_ns - self._filtered_ns) / 1e9
        if dt_s < 0.0:
            return False
        if dt_s > LONGEST_GAP_S:
            self._begin(sighting)
            return True
        for axis in self._axes:
            axis.predict(dt_s, self._moving)
        self._filtered_ns = sighting.captured_ns
        variance, place = _variance(sighting), sighting.pad_ned_m
        off_m = math.hypot(place[0] - self._axes[0].place, place[1] - self._axes[1].place)
        if off_m > GATE_M + GATE_SIGMAS * math.sqrt(variance + self._axes[0].pp):
            self._doubts += 1
            if self._doubts >= DOUBTS_BELIEVED:
                self._begin(sighting)
                return True
            return False
        for axis, measured in zip(self._axes, place[:2], strict=True):
            axis.correct(measured, variance)
        self._down_m += HEIGHT_SHARE * (place[2] - self._down_m)
        self._doubts = 0
        self.captured_ns = sighting.captured_ns
        self.count += 1
        return True

    def at(self, now_ns: int) -> Vector3:
        """Where it is at a moment, local NED; a moving one is taken to go on as it did."""
        ahead_s = max(0.0, (now_ns - self._filtered_ns) / 1e9) if self._moving else 0.0
        north, east = (axis.place + axis.speed * ahead_s for axis in self._axes)
        return (north, east, self._down_m)

    @property
    def velocity_mps(self) -> tuple[float, float]:
        """Over ground, north and east; zero of a still pad."""
        return (self._axes[0].speed, self._axes[1].speed)

    def unseen_s(self, now_ns: int) -> float:
        """Since the newest sighting that was believed."""
        return (now_ns - self.captured_ns) / 1e9


def _variance(sighting: MarkerTarget) -> float:
    return (SIGHT_SIGMA_M + SIGHT_SIGMA_PER_M * sighting.distance_m) ** 2
