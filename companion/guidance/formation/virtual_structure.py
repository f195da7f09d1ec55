"""A formation about a leader that is not there: the whole structure flies a path, and waits for its slowest.

Every vehicle holds its place in the structure, and the structure goes on only as fast as they do (Lewis, Tan
1997, "High precision formation control of mobile robots using virtual structures"; the feedback from the
vehicles to the structure as in Ren, Beard 2004, "Formation feedback control for multiple spacecraft via
virtual structures"). The vehicle that assigns the slots moves it and tells where it is; if that one falls
silent, the next goes on from there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from companion.guidance.formation.neighbours import Anchor
from companion.guidance.formation.pose import Structure
from companion.guidance.path import Path
from companion.vehicle.state import Vector3
from vision.attitude import wrap_angle

# It moves on at full speed with the worst slot error below the first, not at all from the second on.
FULL_SPEED_ERROR_M = 0.7
NO_SPEED_ERROR_M = 2.5
ACCELERATION_MPS2 = 0.7
# Farther off than this from the heading of the path, a structure turns before it goes on.
TURN_FIRST_RAD = 1.2


class VirtualStructure:
    """The structure as one vehicle moves it.

    Args:
        points: (north, east) or (north, east, height) metres from the home of whoever begins it.
        speed_mps: at most. laps: 1: to the last point; 0: round and round for ever.
    """

    def __init__(self, points: Sequence[tuple[float, ...]], speed_mps: float, laps: float = 1.0) -> None:
        self._points, self._speed_mps, self._laps = tuple(points), speed_mps, laps
        self._path: Path | None = None
        self._origin: Vector3 = (0.0, 0.0, 0.0)
        self._origin_ned: Vector3 = (0.0, 0.0, 0.0)
        self._now_mps = 0.0
        self.along_m = 0.0

    @property
    def begun(self) -> bool:
        """It has a path."""
        return self._path is not None

    @property
    def arrived(self) -> bool:
        """It stands at the end of its path."""
        if self._path is None or self._laps == 0.0:
            return False
        return self.along_m >= self._laps * self._path.length_m - 1e-6

    def begin(self, anchor: Anchor, home: Vector3, height_m: float) -> None:
        """Begin at the first point. `height_m` above home where the points have none.

        Raises:
            ValueError: the points make no path.
        """
        self._lay(anchor, anchor.globally(home), home, height_m)
        self.along_m = 0.0

    def take_over(self, anchor: Anchor, told: Structure) -> None:
        """Go on where another vehicle's was. Raises ValueError as `begin`."""
        origin_ned = anchor.local(*told.origin)
        # Where the points have no height it is the one it flies at.
        self._lay(anchor, told.origin, origin_ned, origin_ned[2] - anchor.local(*told.place)[2])
        self.along_m = told.along_m
        self._now_mps = math.hypot(*told.velocity_ned_mps)

    def _lay(self, anchor: Anchor, origin: Vector3, origin_ned: Vector3, height_m: float) -> None:
        self._origin, self._origin_ned = origin, origin_ned
        places: list[Vector3] = []
        for north, east, *height in self._points:
            height_m = height[0] if height else height_m
            places.append((origin_ned[0] + north, origin_ned[1] + east, origin_ned[2] - height_m))
        if len(places) == 1:
            # One point is a place to stand at: a path has a length, so it comes from a hand's breadth above.
            places.insert(0, (places[0][0], places[0][1], places[0][2] - 0.05))
        self._path = Path(places, self._speed_mps, closed=self._laps != 1.0)

    def leave(self) -> None:
        """Another vehicle moves it; what this one knew of where it is counts no more."""
        self._path = None

    def move(self, dt_s: float, worst_error_m: float, heading_error_rad: float) -> None:
        """Go on for a moment, as fast as the vehicles keep up and the formation has turned."""
        assert self._path is not None
        room = (NO_SPEED_ERROR_M - worst_error_m) / (NO_SPEED_ERROR_M - FULL_SPEED_ERROR_M)
        turned = 1.0 - abs(wrap_angle(heading_error_rad)) / TURN_FIRST_RAD
        share = max(0.0, min(1.0, room)) * max(0.0, min(1.0, turned))
        # A path's end is approached at no speed at all: the last of it is flown slowly, not never.
        wanted = max(self._path.point(self.along_m).speed_mps, 0.2) * share
        step = ACCELERATION_MPS2 * dt_s
        self._now_mps += max(-2.0 * step, min(step, wanted - self._now_mps))
        self.along_m += max(0.0, self._now_mps) * dt_s
        if self._laps:
            self.along_m = min(self.along_m, self._laps * self._path.length_m)

    def motion(self) -> tuple[Vector3, Vector3, float | None]:
        """Position and velocity (local NED), and the path's heading; None where it leads straight up."""
        assert self._path is not None
        here = self._path.point(self.along_m)
        speed = 0.0 if self.arrived else max(0.0, self._now_mps)
        north, east, down = (part * speed for part in here.direction)
        level = math.hypot(here.direction[0], here.direction[1])
        heading = math.atan2(here.direction[1], here.direction[0]) if level > 0.2 else None
        return here.position_ned_m, (north, east, down), heading

    def told(self, anchor: Anchor, heading_rad: float, over: bool) -> Structure:
        """What the others are told; `over`: all are there, and it has ended."""
        place, velocity, _ = self.motion()
        return Structure(anchor.globally(place), velocity, heading_rad, self._origin, self.along_m, over)

    @property
    def status(self) -> str:
        if self._path is None:
            return "not begun"
        return f"{self.along_m:.0f} of {self._path.length_m:.0f} m"
