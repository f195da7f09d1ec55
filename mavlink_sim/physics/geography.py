"""Between the local NED frame and latitude, longitude, altitude: a flat earth around PX4's SIH home.

Vehicles of a fleet start in different places, and each has its local frame's origin at its own. Which one is
meant is a context variable that a vehicle sets for its turn, so that the many callers need not know; outside
any turn it is SIH's home.
"""

from __future__ import annotations

import math
from contextvars import ContextVar

HOME_LATITUDE_DEG = 47.397743225  # SIH_LOC_LAT0
HOME_LONGITUDE_DEG = 8.545594215
HOME_ALTITUDE_M = 489.4  # SIH_LOC_H0, above mean sea level
EARTH_RADIUS_M = 6371000.0
_METRES_PER_DEGREE = math.radians(1.0) * EARTH_RADIUS_M
_LONGITUDE_SCALE = math.cos(math.radians(HOME_LATITUDE_DEG))

# North and east, metres, of the local frame's origin as seen from SIH's home.
start_of_vehicle: ContextVar[tuple[float, float]] = ContextVar("start_of_vehicle", default=(0.0, 0.0))


def geographic(position: tuple[float, float, float]) -> tuple[float, float, float]:
    """(latitude °, longitude °, altitude AMSL m) of a local NED position."""
    north, east, down = position
    start_north, start_east = start_of_vehicle.get()
    return (
        HOME_LATITUDE_DEG + (start_north + north) / _METRES_PER_DEGREE,
        HOME_LONGITUDE_DEG + (start_east + east) / (_METRES_PER_DEGREE * _LONGITUDE_SCALE),
        HOME_ALTITUDE_M - down,
    )


def local(latitude_deg: float, longitude_deg: float, altitude_m: float) -> tuple[float, float, float]:
    """The local NED position of a place; NaN stays NaN."""
    start_north, start_east = start_of_vehicle.get()
    return (
        (latitude_deg - HOME_LATITUDE_DEG) * _METRES_PER_DEGREE - start_north,
        (longitude_deg - HOME_LONGITUDE_DEG) * _METRES_PER_DEGREE * _LONGITUDE_SCALE - start_east,
        HOME_ALTITUDE_M - altitude_m,
    )
