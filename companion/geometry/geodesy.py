"""Latitude and longitude to metres north and east and back, over a few kilometres."""

from __future__ import annotations

import math
from typing import NamedTuple

# WGS 84 (NGA.STND.0036): semi-major axis, metres, and first eccentricity squared.
SEMI_MAJOR_M = 6_378_137.0
ECCENTRICITY_SQUARED = 6.694379990141e-3


def north_east(from_deg: tuple[float, float], to_deg: tuple[float, float]) -> tuple[float, float]:
    """Metres (north, east) from one (latitude, longitude) to another, degrees, WGS 84.

    Uses the plane tangent to the ellipsoid half way: accurate to 1 cm over 10 km, away from the poles.
    """
    meridian_m, parallel_m = _radii_m((from_deg[0] + to_deg[0]) / 2)
    longitude_deg = math.remainder(to_deg[1] - from_deg[1], 360.0)
    return (math.radians(to_deg[0] - from_deg[0]) * meridian_m, math.radians(longitude_deg) * parallel_m)


def latitude_longitude(from_deg: tuple[float, float], north_m: float, east_m: float) -> tuple[float, float]:
    """(latitude, longitude), degrees, of a point north and east of another: the inverse of `north_east`."""
    latitude_deg = from_deg[0]
    for _ in range(2):
        # The plane touches half way; its place changes by a millionth in the second round.
        meridian_m, parallel_m = _radii_m((from_deg[0] + latitude_deg) / 2)
        latitude_deg = from_deg[0] + math.degrees(north_m / meridian_m)
    return latitude_deg, math.remainder(from_deg[1] + math.degrees(east_m / parallel_m), 360.0)


class GeodeticOrigin(NamedTuple):
    """Latitude, longitude (degrees, WGS 84) and height above mean sea level of the origin of local NED."""

    latitude_deg: float
    longitude_deg: float
    altitude_amsl_m: float

    def place(self, position_ned_m: tuple[float, float, float]) -> tuple[float, float, float]:
        """Latitude, longitude and height of a point in local NED."""
        north, east, down = position_ned_m
        return (*latitude_longitude(self[:2], north, east), self.altitude_amsl_m - down)


def _radii_m(latitude_deg: float) -> tuple[float, float]:
    """Radius of the meridian and of the parallel."""
    middle_rad = math.radians(latitude_deg)
    denominator = 1.0 - ECCENTRICITY_SQUARED * math.sin(middle_rad) ** 2
    meridian_m = SEMI_MAJOR_M * (1.0 - ECCENTRICITY_SQUARED) / denominator**1.5
    return meridian_m, SEMI_MAJOR_M / math.sqrt(denominator) * math.cos(middle_rad)
