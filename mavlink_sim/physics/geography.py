"""Between a local NED frame and latitude, longitude, altitude: a flat earth around PX4's SIH home."""

from __future__ import annotations

import math
from dataclasses import dataclass

HOME_LATITUDE_DEG = 47.397743225  # SIH_LOC_LAT0
HOME_LONGITUDE_DEG = 8.545594215
HOME_ALTITUDE_M = 489.4  # SIH_LOC_H0, above mean sea level
EARTH_RADIUS_M = 6371000.0
_METRES_PER_DEGREE = math.radians(1.0) * EARTH_RADIUS_M
_LONGITUDE_SCALE = math.cos(math.radians(HOME_LATITUDE_DEG))


@dataclass(frozen=True, slots=True)
class LocalFrame:
    """The local NED frame of one vehicle.

    Attributes:
        north_m, east_m: its origin as seen from SIH's home. Vehicles of a fleet start at different points,
            and each has its origin at its own.
    """

    north_m: float = 0.0
    east_m: float = 0.0

    def geographic(self, position: tuple[float, float, float]) -> tuple[float, float, float]:
        """(latitude °, longitude °, altitude AMSL m) of a local NED position in metres."""
        north, east, down = position
        return (
            HOME_LATITUDE_DEG + (self.north_m + north) / _METRES_PER_DEGREE,
            HOME_LONGITUDE_DEG + (self.east_m + east) / (_METRES_PER_DEGREE * _LONGITUDE_SCALE),
            HOME_ALTITUDE_M - down,
        )

    def local(
        self, latitude_deg: float, longitude_deg: float, altitude_m: float
    ) -> tuple[float, float, float]:
        """The local NED position in metres; NaN stays NaN."""
        return (
            (latitude_deg - HOME_LATITUDE_DEG) * _METRES_PER_DEGREE - self.north_m,
            (longitude_deg - HOME_LONGITUDE_DEG) * _METRES_PER_DEGREE * _LONGITUDE_SCALE - self.east_m,
            HOME_ALTITUDE_M - altitude_m,
        )
