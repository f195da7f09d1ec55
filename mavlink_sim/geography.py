"""Between the local NED frame and latitude, longitude, altitude: a flat earth around PX4's SIH home."""

from __future__ import annotations

import math

HOME_LATITUDE_DEG = 47.397743225  # SIH_LOC_LAT0
HOME_LONGITUDE_DEG = 8.545594215
HOME_ALTITUDE_M = 489.4  # SIH_LOC_H0, above mean sea level
EARTH_RADIUS_M = 6371000.0
_METRES_PER_DEGREE = math.radians(1.0) * EARTH_RADIUS_M
_LONGITUDE_SCALE = math.cos(math.radians(HOME_LATITUDE_DEG))


def geographic(position: tuple[float, float, float]) -> tuple[float, float, float]:
    """(latitude °, longitude °, altitude AMSL m) of a local NED position."""
    north, east, down = position
    return (
        HOME_LATITUDE_DEG + north / _METRES_PER_DEGREE,
        HOME_LONGITUDE_DEG + east / (_METRES_PER_DEGREE * _LONGITUDE_SCALE),
        HOME_ALTITUDE_M - down,
    )


def local(latitude_deg: float, longitude_deg: float, altitude_m: float) -> tuple[float, float, float]:
    """The local NED position of a place; NaN stays NaN."""
    return (
        (latitude_deg - HOME_LATITUDE_DEG) * _METRES_PER_DEGREE,
        (longitude_deg - HOME_LONGITUDE_DEG) * _METRES_PER_DEGREE * _LONGITUDE_SCALE,
        HOME_ALTITUDE_M - altitude_m,
    )
