"""Keeping the camera's gimbal on an object that is flown to: its pitch, as the nose keeps the bearing."""

from __future__ import annotations

import math
from typing import Protocol

from companion.guidance.behaviour import Situation
from companion.vehicle.gimbal import GimbalAim
from companion.vehicle.state import Vector3

# Straight below, an elevation says nothing of a height.
STEEPEST_RAD = math.radians(89.0)
NEAREST_M = 0.1


class Tracked(Protocol):
    """An object that is followed from frame to frame."""

    @property
    def captured_ns(self) -> int:
        """Capture stamp of its newest detection."""

    @property
    def elevation_rad(self) -> float:
        """Of its middle in that, above the horizon."""


class GimbalTracking:
    """Where the gimbal looks so that an object stays in the middle of the picture's height.

    A detection tells the object's height, by its elevation and how far away it is thought to be. At that
    height it is looked at until the next one, while the vehicle flies on and while the object is hidden.

    Attributes:
        aim: where the gimbal is to look; None: nothing was seen yet.
    """

    def __init__(self) -> None:
        self.aim: GimbalAim | None = None
        self._begun_ns = self._seen_ns = 0
        self._down_m = 0.0

    def begin(self, now_ns: int) -> None:
        """What was seen before is another object."""
        self.aim, self._begun_ns, self._seen_ns = None, now_ns, 0

    def keep_on(
        self, track: Tracked | None, range_m: float, position: Vector3, situation: Situation
    ) -> str | None:
        """Look at the object where it is now, as far as the gimbal reaches.

        Args:
            track: what is known of it; None: nothing yet.
            range_m: how far away it is thought to be, horizontally.
            position: the vehicle's, local NED.

        Returns:
            Why the gimbal is not moved any more, in words; None: it is.
        """
        # At the first turn it is still told of what came before.
        if situation.gimbal.problem and situation.now_ns > self._begun_ns:
            return situation.gimbal.problem
        if track is None:
            return None
        range_m = max(range_m, NEAREST_M)
        if track.captured_ns != self._seen_ns:
            self._seen_ns = track.captured_ns
            elevation_rad = max(-STEEPEST_RAD, min(STEEPEST_RAD, track.elevation_rad))
            self._down_m = position[2] - range_m * math.tan(elevation_rad)
        pitch_rad = math.atan2(position[2] - self._down_m, range_m)
        gimbal = situation.state.gimbal
        if gimbal is not None:
            pitch_rad = max(gimbal.lowest_pitch_rad, min(gimbal.highest_pitch_rad, pitch_rad))
        self.aim = GimbalAim(pitch_rad)
        return None
