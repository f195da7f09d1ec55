"""The vehicle's position on the earth (WGS 84) and in local NED, which come in separate messages."""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.geometry.geodesy import latitude_longitude, north_east
from companion.vehicle.state import Vector3, VehicleState

# GLOBAL_POSITION_INT comes 5 to 50 times a second.
GLOBAL_MAX_AGE_S = 0.5


def global_problem(state: VehicleState, now_ns: int) -> str | None:
    """Why the vehicle's global position is unknown; None: it is known."""
    if state.position_fault(now_ns) is not None or state.velocity_ned_mps is None:
        return "own position unknown"
    if not _is_global(state):
        return "latitude and longitude not received"
    age_s = (now_ns - state.global_ns) / 1e9
    return f"latitude and longitude stale ({age_s:.1f} s)" if age_s > GLOBAL_MAX_AGE_S else None


def _is_global(state: VehicleState) -> bool:
    return all(map(math.isfinite, (state.latitude_deg, state.longitude_deg, state.altitude_amsl_m)))


@dataclass(frozen=True, slots=True)
class Anchor:
    """One point known both globally (degrees, metres above sea level) and in the own local frame."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    position_ned_m: Vector3

    @classmethod
    def of(cls, state: VehicleState, now_ns: int) -> Anchor | None:
        """The vehicle's newest position in both frames; None while either is unknown (`global_problem`)."""
        return None if global_problem(state, now_ns) is not None else cls.newest(state)

    @classmethod
    def newest(cls, state: VehicleState) -> Anchor | None:
        """The same of any age; None while either was never received."""
        position, velocity = state.position_ned_m, state.velocity_ned_mps or (0.0, 0.0, 0.0)
        if position is None or not _is_global(state):
            return None
        # The two have different stamps: the local position is predicted to the global one's time.
        dt_s = (state.global_ns - state.position_ns) / 1e9
        north, east, down = (p + v * dt_s for p, v in zip(position, velocity, strict=True))
        return cls(state.latitude_deg, state.longitude_deg, state.altitude_amsl_m, (north, east, down))

    def local(self, latitude_deg: float, longitude_deg: float, altitude_m: float) -> Vector3:
        """A global position in the local frame, NED metres."""
        north, east = north_east((self.latitude_deg, self.longitude_deg), (latitude_deg, longitude_deg))
        return (
            self.position_ned_m[0] + north,
            self.position_ned_m[1] + east,
            self.position_ned_m[2] - (altitude_m - self.altitude_m),
        )

    def globally(self, position: Vector3) -> Vector3:
        """A local position as latitude, longitude (degrees) and height above sea level (metres)."""
        north, east = position[0] - self.position_ned_m[0], position[1] - self.position_ned_m[1]
        here = (self.latitude_deg, self.longitude_deg)
        altitude_m = self.altitude_m - (position[2] - self.position_ned_m[2])
        return (*latitude_longitude(here, north, east), altitude_m)
