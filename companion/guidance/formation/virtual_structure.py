"""Virtual structure: a formation about a virtual leader that flies a path and waits for the slowest vehicle.

Every vehicle holds its slot in the structure, and the structure moves only as fast as they follow (Lewis, Tan
1997, "High precision formation control of mobile robots using virtual structures"; feedback from the vehicles
to the structure as in Ren, Beard 2004, "Formation feedback control for multiple spacecraft via virtual
structures"). The vehicle that assigns the slots moves the structure and publishes its state; if it falls
silent, the next one continues from there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from companion.guidance.formation.pose import Structure
from companion.guidance.path import Path
from companion.vehicle.global_position import Anchor
from companion.vehicle.state import Vector3
from vision.attitude import wrap_angle

# Full speed with the worst slot error below the first, no speed from the second on.
FULL_SPEED_ERROR_M = 0.7
NO_SPEED_ERROR_M = 2.5
ACCELERATION_MPS2 = 0.7
# With a greater heading error than this, the structure turns before it moves on.
TURN_FIRST_RAD = 1.2


class VirtualStructure:
    """The structure as one vehicle moves it.

    Args:
        points: (north, east) or (north, east, height) metres from the home of the vehicle that starts it.
        speed_mps: at most. laps: 1: to the last point; 0: repeat until cancelled.
    """

    def __init__(self, points: Sequence[tuple[float, ...]], speed_mps: float, laps: float = 1.0) -> None:
        self._points, self._speed_mps, self._laps = tuple(points), speed_mps, laps
        self._path: Path | None = None
        self._origin: Vector3 = (0.0, 0.0, 0.0)
        self._now_mps = 0.0
        self.along_m = 0.0

    @property
    def started(self) -> bool:
        """Whether it has a path."""
        return self._path is not None

    @property
    def arrived(self) -> bool:
        """Whether it is at the end of its path."""
        if self._path is None or self._laps == 0.0:
            return False
        return self.along_m >= self._laps * self._path.length_m - 1e-6

    def begin(self, anchor: Anchor, home: Vector3, height_m: float) -> None:
        """Start at the first point. `height_m`: above home, for points without a height.

        Raises:
            ValueError: the points do not form a path.
        """
        self._lay(anchor.globally(home), home, height_m)
        self.along_m = 0.0

    def take_over(self, anchor: Anchor, state: Structure) -> None:
        """Continue from the published state of another vehicle's structure. Raises ValueError as `begin`."""
        origin_ned = anchor.local(*state.origin)
        # Points without a height get the structure's current one.
        self._lay(state.origin, origin_ned, origin_ned[2] - anchor.local(*state.place)[2])
        self.along_m = state.along_m
        self._now_mps = math.hypot(*state.velocity_ned_mps)

    def _lay(self, origin: Vector3, origin_ned: Vector3, height_m: float) -> None:
        self._origin = origin
        positions: list[Vector3] = []
        for north, east, *height in self._points:
            height_m = height[0] if height else height_m
            positions.append((origin_ned[0] + north, origin_ned[1] + east, origin_ned[2] - height_m))
        self._path = Path(positions, self._speed_mps, closed=self._laps != 1.0)

    def leave(self) -> None:
        """Another vehicle moves it: discard the own state."""
        self._path = None

    def move(self, dt_s: float, worst_error_m: float, heading_error_rad: float) -> None:
        """Advance by `dt_s`, slower with the worst slot error and the heading error."""
        assert self._path is not None
        following = (NO_SPEED_ERROR_M - worst_error_m) / (NO_SPEED_ERROR_M - FULL_SPEED_ERROR_M)
        aligned = 1.0 - abs(wrap_angle(heading_error_rad)) / TURN_FIRST_RAD
        factor = max(0.0, min(1.0, following)) * max(0.0, min(1.0, aligned))
        # The path's speed is zero at its end: a minimum speed reaches it.
        wanted = max(self._path.point(self.along_m).speed_mps, 0.2) * factor
        step = ACCELERATION_MPS2 * dt_s
        self._now_mps += max(-2.0 * step, min(step, wanted - self._now_mps))
        self.along_m += max(0.0, self._now_mps) * dt_s
        if self._laps:
            self.along_m = min(self.along_m, self._laps * self._path.length_m)

    def motion(self) -> tuple[Vector3, Vector3, float | None]:
        """Position and velocity (local NED), and the path's heading; None where it is vertical."""
        assert self._path is not None
        here = self._path.point(self.along_m)
        speed = 0.0 if self.arrived else max(0.0, self._now_mps)
        north, east, down = (part * speed for part in here.direction)
        level = math.hypot(here.direction[0], here.direction[1])
        heading = math.atan2(here.direction[1], here.direction[0]) if level > 0.2 else None
        return here.position_ned_m, (north, east, down), heading

    def snapshot(self, anchor: Anchor, heading_rad: float, over: bool) -> Structure:
        """The state to publish; `over`: finished, and all vehicles are in their slots."""
        position, velocity, _ = self.motion()
        return Structure(anchor.globally(position), velocity, heading_rad, self._origin, self.along_m, over)
