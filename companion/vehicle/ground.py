"""The ground below the vehicle, from a range finder that looks down (DISTANCE_SENSOR)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from statistics import median
from typing import Any

Vector3 = tuple[float, float, float]

_DOWN = 25  # MAV_SENSOR_ROTATION_PITCH_270
_INVALID_QUALITY = 1  # `signal_quality`, per cent; 0: the sensor states none
# Beyond this tilt the beam meets the ground too far from below the vehicle.
_MIN_COSINE = math.cos(math.radians(30.0))
# A measurement is the median of this many, half a second at PX4's rate: it drops single outliers.
_MEDIAN_OF = 5
# A surface is compared with the ground at least this far back on the path.
BACK_M = 4.0
# It is ground if it differs by no more than this, plus so much per metre from there, at most `MAX_RISE_M`:
# less than the boot or bonnet of a car, whatever the length of the object.
STEP_M, SLOPE, MAX_RISE_M = 0.3, 0.1, 0.8
# Differences of this much are measurement noise.
_NOISE_M = 0.1
# A lower surface is ground after this time, longer than a false echo. No older measurement counts than this.
DROP_S, _KEPT_S = 1.0, 1.5
# A level within this of home's is home's again.
HOME_GATE_M = 1.0
# Points of the path that are kept, and their least distance.
_TRAIL, _TRAIL_M = 12, 0.5
# A level measured longer ago is not used for ranges.
GROUND_MAX_AGE_S = 5.0


@dataclass(frozen=True, slots=True)
class GroundLevel:
    """The ground's level below the vehicle, by the newest measurement that met the ground.

    Attributes:
        measured_ns: when; 0: it was never met.
        position_ned_m: the point on the ground, local NED.
        recent: (stamp, down) of the newest measurements, the newest last, whatever they met.
        trail: points of the ground below the path, the newest last.
        step_m: between this level and another one a few metres back: which of them is around, is not known.
    """

    measured_ns: int = 0
    position_ned_m: Vector3 = (0.0, 0.0, 0.0)
    recent: tuple[tuple[int, float], ...] = ()
    trail: tuple[Vector3, ...] = ()
    step_m: float = 0.0

    def measure(
        self, stamp_ns: int, slant_m: float, vehicle: Vector3, cosine: float, home: float
    ) -> GroundLevel:
        """The level after a measurement.

        What is below may be an object. So a higher surface is ground only if it is home's level again, or no
        higher than a slope can be; a lower one also if it lasts.

        Args:
            slant_m: along the vehicle's down axis.
            vehicle: its position, local NED.
            cosine: of its tilt.
            home: down coordinate of home.
        """
        recent = (*self.recent, (stamp_ns, vehicle[2] + slant_m * cosine))
        recent = tuple(each for each in recent if stamp_ns - each[0] <= _KEPT_S * 1e9)
        since = max((at for at, _ in recent if stamp_ns - at >= DROP_S * 1e9), default=0)
        recent = tuple(each for each in recent if each[0] >= since)
        down = _level(recent)
        reference, back_m = self._reference(vehicle, home)
        allowed_m = min(STEP_M + SLOPE * back_m, MAX_RISE_M)
        differs_m = abs(down - reference)
        trail, step_m = self.trail, 0.0 if back_m >= BACK_M else self.step_m
        if differs_m > SLOPE * back_m + _NOISE_M:
            step_m = max(step_m, differs_m)
        if differs_m > allowed_m:
            is_home = abs(down - home) <= HOME_GATE_M < abs(reference - home)
            lasts = since > 0 and min(each for _, each in recent) > reference + allowed_m
            if not is_home and not lasts:
                return replace(self, recent=recent)
            trail, step_m = (), differs_m
        point = (vehicle[0], vehicle[1], down)
        if not trail or math.dist(trail[-1][:2], point[:2]) >= _TRAIL_M:
            trail = (*trail, point)[-_TRAIL:]
        return GroundLevel(stamp_ns, point, recent, trail, step_m)

    def disagreement_m(self, level: float, now_ns: int) -> float:
        """Between a level (down) that is used and what else was measured in the last second or few metres."""
        fresh = bool(self.recent) and now_ns - self.recent[-1][0] <= DROP_S * 1e9
        return max(self.step_m, abs(_level(self.recent) - level) if fresh else 0.0)

    def _reference(self, vehicle: Vector3, home: float) -> tuple[float, float]:
        """The level of the newest point at least `BACK_M` away, else of the oldest, and its distance."""
        if not self.trail:
            return home, math.inf
        away = [(math.dist(point[:2], vehicle[:2]), point[2]) for point in self.trail]
        back_m, down = next((each for each in reversed(away) if each[0] >= BACK_M), away[0])
        return down, back_m


def _level(recent: tuple[tuple[int, float], ...]) -> float:
    return median(down for _, down in recent[-_MEDIAN_OF:])


def range_below_m(fields: Mapping[str, Any]) -> float | None:
    """The range of a DISTANCE_SENSOR message, metres; None if it is not downward, in range and valid."""
    current = fields["current_distance"]
    if fields["orientation"] != _DOWN or fields.get("signal_quality") == _INVALID_QUALITY:
        return None
    return current * 0.01 if fields["min_distance"] < current < fields["max_distance"] else None


def may_measure(cosine: float) -> bool:
    """Whether the vehicle's tilt allows a measurement."""
    return cosine >= _MIN_COSINE
