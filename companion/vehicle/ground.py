"""The ground below the vehicle, from a range finder that looks down (DISTANCE_SENSOR)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from statistics import median
from typing import Any

Vector3 = tuple[float, float, float]

_DOWN = 25  # MAV_SENSOR_ROTATION_PITCH_270
_INVALID_QUALITY = 1  # `signal_quality`, per cent; 0: the sensor states none
# Beyond this tilt the beam meets the ground too far from below the vehicle.
_MIN_COSINE = math.cos(math.radians(30.0))
# The level is the median of this many measurements, half a second at PX4's rate: it drops single outliers.
_KEPT, _KEPT_S = 5, 1.0
# A surface that rises by more than this, plus so much per metre flown since the ground was measured last, is
# an object below. No car, van or bus is that low for its length (1.5 m at 4.5 m, 2.5 at 6, 3 at 12).
STEP_M, SLOPE = 0.3, 0.2
# Before the first ground: above home's level by less than a car's height.
HOME_GATE_M = 1.0
# A level measured longer ago is not used for ranges.
GROUND_MAX_AGE_S = 5.0


@dataclass(frozen=True, slots=True)
class GroundLevel:
    """The ground's level below the vehicle, by the newest measurement that met the ground.

    Attributes:
        measured_ns: when; 0: it was never met.
        position_ned_m: the point on the ground, local NED.
        recent: (stamp, down) of the newest measurements, the newest last, whatever they met.
    """

    measured_ns: int = 0
    position_ned_m: Vector3 = (0.0, 0.0, 0.0)
    recent: tuple[tuple[int, float], ...] = ()

    def measure(
        self, stamp_ns: int, slant_m: float, vehicle: Vector3, cosine: float, home: float
    ) -> GroundLevel:
        """The level after a measurement.

        A surface can only be above the ground. So a lower one is the ground, and a higher one if it is no
        higher than a slope can be.

        Args:
            slant_m: along the vehicle's down axis.
            vehicle: its position, local NED.
            cosine: of its tilt.
            home: down coordinate of home.
        """
        recent = (*self.recent, (stamp_ns, vehicle[2] + slant_m * cosine))
        recent = tuple(each for each in recent if stamp_ns - each[0] <= _KEPT_S * 1e9)[-_KEPT:]
        down = median(each[1] for each in recent)
        if self.measured_ns:
            moved_m = math.dist(vehicle[:2], self.position_ned_m[:2])
            lowest = self.position_ned_m[2] - STEP_M - SLOPE * moved_m
        else:
            lowest = home - HOME_GATE_M
        if down < lowest:
            return GroundLevel(self.measured_ns, self.position_ned_m, recent)
        return GroundLevel(stamp_ns, (vehicle[0], vehicle[1], down), recent)


def range_below_m(fields: Mapping[str, Any]) -> float | None:
    """The range of a DISTANCE_SENSOR message, metres; None if it is not downward, in range and valid."""
    current = fields["current_distance"]
    if fields["orientation"] != _DOWN or fields.get("signal_quality") == _INVALID_QUALITY:
        return None
    return current * 0.01 if fields["min_distance"] < current < fields["max_distance"] else None


def may_measure(cosine: float) -> bool:
    """Whether the vehicle's tilt allows a measurement."""
    return cosine >= _MIN_COSINE
