"""Keeping the camera's gimbal on an object that is flown to: its pitch, as the nose keeps the bearing."""

from __future__ import annotations

import math
from typing import Annotated

from companion.guidance.arguments import EnumArgument
from companion.guidance.behaviour import BehaviourContext
from companion.guidance.gimbal.sweep import BEHIND_RAD, PATIENCE_S, gap_text
from companion.guidance.targets.target import Target
from companion.vehicle.gimbal import GimbalAim
from companion.vehicle.state import Vector3

GimbalUse = Annotated[
    str, EnumArgument("gimbal", ("leave", "track"), "leave it alone, or keep its camera on the object")
]

# Straight below, an elevation says nothing of a height.
STEEPEST_RAD = math.radians(89.0)
# Nearer than this it is above or below, and its direction swings with every centimetre.
NEAREST_M = 0.1
# The object's height stays: of each detection's word of it, so much is believed.
NEWEST_SHARE = 0.5


class GimbalTracking:
    """Where the gimbal looks so that an object stays in the middle of the picture's height.

    A detection tells the object's height, by its elevation and its range. At that height it is looked at
    while the vehicle flies on and while the object is hidden.

    Attributes:
        aim: where the gimbal is to look; None: not begun, or nobody knows where it looks.
    """

    def __init__(self) -> None:
        self.aim: GimbalAim | None = None
        self._begun_ns = 0
        self._seen: Target | None = None
        self._down_m: float | None = None
        self._behind_since_ns: int | None = None

    def begin(self, context: BehaviourContext) -> None:
        """Stay where the gimbal looks, so that control of it is had when the object is seen."""
        gimbal = context.state.gimbal
        self.aim = self._seen = self._down_m = self._behind_since_ns = None
        self._begun_ns = context.now_ns
        if gimbal is not None and gimbal.pitch_rad is not None:
            self.aim = GimbalAim(gimbal.nearest_pitch_rad(gimbal.pitch_rad))

    def taken(self, context: BehaviourContext) -> str | None:
        """Why the gimbal is not moved any more, in words; None: it is."""
        if context.now_ns <= self._begun_ns:  # at the first turn it is still told of what came before
            return None
        return context.gimbal.problem or None

    def turn_to(self, target: Target, context: BehaviourContext) -> None:
        """Look at what has no range yet: it may come fully into the picture, and its range with it."""
        self._look(target.elevation_rad, context)

    def keep_on(
        self, newest: Target | None, range_m: float, position: Vector3, context: BehaviourContext
    ) -> str | None:
        """Look at the object where it is thought to be now, as far as the gimbal reaches.

        Args:
            newest: its newest detection; None: there was none with a range.
            range_m: how far away it is thought to be now, horizontal metres.
            position: the vehicle's, local NED metres.
            context: tells of the gimbal.

        Returns:
            Why there is no use in going on, in words; None: the gimbal follows.
        """
        if newest is not None:
            range_m = max(range_m, NEAREST_M)
            if newest is not self._seen:
                self._seen = newest
                then_m = newest.ground_range_m if math.isfinite(newest.ground_range_m) else range_m
                elevation_rad = max(-STEEPEST_RAD, min(STEEPEST_RAD, newest.elevation_rad))
                down_m = position[2] - max(then_m, NEAREST_M) * math.tan(elevation_rad)
                before_m = down_m if self._down_m is None else self._down_m
                self._down_m = before_m + NEWEST_SHARE * (down_m - before_m)
            assert self._down_m is not None
            self._look(math.atan2(position[2] - self._down_m, range_m), context)
        return self.taken(context) or self._stuck(context)

    def _look(self, elevation_rad: float, context: BehaviourContext) -> None:
        pitch_rad = elevation_rad - context.gimbal.camera_pitch_rad
        gimbal = context.state.gimbal
        if gimbal is not None:  # else it is lost, and told so
            self.aim = GimbalAim(gimbal.nearest_pitch_rad(pitch_rad))

    def _stuck(self, context: BehaviourContext) -> str | None:
        """It does not go where it is asked to, for longer than a gimbal may take."""
        gimbal, now_ns = context.state.gimbal, context.now_ns
        measured_rad = None if gimbal is None else gimbal.pitch_rad
        if self.aim is None or measured_rad is None or abs(self.aim.pitch_rad - measured_rad) <= BEHIND_RAD:
            self._behind_since_ns = None
            return None
        if self._behind_since_ns is None:
            self._behind_since_ns = now_ns
        if now_ns - self._behind_since_ns <= PATIENCE_S * 1e9:
            return None
        return f"it does not follow: {gap_text(self.aim.pitch_rad, measured_rad)}"
