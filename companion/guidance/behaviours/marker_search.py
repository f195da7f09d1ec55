"""Search path for a marker that is not seen at once: wait, climb, then fly a spiral."""

from __future__ import annotations

import math

from companion.vehicle.state import Vector3

WAIT_S = 1.5
CLIMB_M = 3.0
CLIMB_MPS = 1.0
SPEED_MPS = 1.0
# Pitch of the spiral, as a fraction of the height: well inside the footprint of a 60° camera.
PITCH_OF_HEIGHT = 0.7


class MarkerSearch:
    """A search around a point.

    Args:
        point: centre, local NED metres.
        radius_m: of the spiral; 0: only wait and climb.
        height_m: initial height above the ground.
    """

    def __init__(self, point: Vector3, radius_m: float, height_m: float) -> None:
        self._point, self._radius_m = point, radius_m
        self._pitch_m = max(1.0, PITCH_OF_HEIGHT * (height_m + CLIMB_M))
        self._angle_rad = 0.0
        self._elapsed_s = 0.0
        self.ended = False

    @property
    def status(self) -> str:
        """Progress in words."""
        return f"{self._reached_m:.1f} m around" if self._angle_rad > 0.0 else "here"

    @property
    def _reached_m(self) -> float:
        return self._pitch_m * self._angle_rad / math.tau

    def update(self, dt_s: float, position: Vector3) -> Vector3:
        """The next position, local NED. `ended` is set when the whole area was covered."""
        self._elapsed_s += dt_s
        north, east, down = self._point
        if self._elapsed_s < WAIT_S:
            return self._point
        climbed_m = min(CLIMB_M, CLIMB_MPS * (self._elapsed_s - WAIT_S))
        height = down - climbed_m
        if climbed_m < CLIMB_M:
            return (north, east, height)
        if self._reached_m >= self._radius_m:
            self.ended |= self._elapsed_s > 2 * WAIT_S + CLIMB_M / CLIMB_MPS
            return self._at(height)
        # Only as fast as the vehicle follows, so that nothing is skipped.
        point = self._at(height)
        if math.dist(point[:2], position[:2]) < SPEED_MPS * 1.5:
            self._angle_rad += dt_s * SPEED_MPS / max(self._reached_m, self._pitch_m / 2)
        return self._at(height)

    def _at(self, height: float) -> Vector3:
        north, east, _ = self._point
        reached_m = min(self._reached_m, self._radius_m)
        return (
            north + reached_m * math.cos(self._angle_rad),
            east + reached_m * math.sin(self._angle_rad),
            height,
        )
