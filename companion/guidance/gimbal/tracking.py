"""Gimbal tracking: keep the camera's pitch on an object while the vehicle's yaw keeps the bearing."""

from __future__ import annotations

import math
from typing import Annotated

from companion.guidance.behaviour import BehaviourContext
from companion.guidance.command import EnumArgument
from companion.guidance.gimbal.sweep import BEHIND_RAD, PATIENCE_S, gap_text
from companion.guidance.targets.target import Target
from companion.vehicle.gimbal import GimbalAim
from companion.vehicle.state import Vector3

GimbalUse = Annotated[
    str, EnumArgument("gimbal", ("leave", "track"), "leave: not moved; track: camera kept on the object")
]

# Straight below, an elevation does not determine a height.
STEEPEST_RAD = math.radians(89.0)
# Nearer than this the object is above or below, and its elevation is too sensitive.
NEAREST_M = 0.1
# Smoothing of the object's height: weight of the newest detection.
NEWEST_SHARE = 0.5


class GimbalTracking:
    """Pitch aim that keeps an object vertically centred in the image.

    A detection's elevation and range give the object's height. The gimbal points at that height while the
    vehicle moves and while the object is hidden.

    Attributes:
        aim: where to point the gimbal; None: not started, or its attitude is unknown.
    """

    def __init__(self) -> None:
        self.aim: GimbalAim | None = None
        self._begun_ns = 0
        self._seen: Target | None = None
        self._down_m: float | None = None
        self._behind_since_ns: int | None = None

    def begin(self, context: BehaviourContext) -> None:
        """Hold the current pitch, so that control is acquired before the object is seen."""
        gimbal = context.state.gimbal
        self.aim = self._seen = self._down_m = self._behind_since_ns = None
        self._begun_ns = context.now_ns
        if gimbal is not None and gimbal.pitch_rad is not None:
            self.aim = GimbalAim(gimbal.nearest_pitch_rad(gimbal.pitch_rad))

    def control_fault(self, context: BehaviourContext) -> str | None:
        """Why the gimbal is not moved any more, in words; None: it is."""
        if context.now_ns <= self._begun_ns:  # the first update still shows the previous owner's problem
            return None
        return context.gimbal.problem or None

    def turn_to(self, target: Target, context: BehaviourContext) -> None:
        """Point at a target without a range: fully inside the image it may get one."""
        self._point_at(target.elevation_rad, context)

    def keep_on(
        self, newest: Target | None, range_m: float, position: Vector3, context: BehaviourContext
    ) -> str | None:
        """Point at the object's estimated position, within the gimbal's range.

        Args:
            newest: its newest detection; None: none with a range.
            range_m: its estimated range now, horizontal metres.
            position: the vehicle's, local NED metres.
            context: for the gimbal's state.

        Returns:
            Why tracking has failed, in words; None: the gimbal follows.
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
            self._point_at(math.atan2(position[2] - self._down_m, range_m), context)
        return self.control_fault(context) or self._stuck(context)

    def _point_at(self, elevation_rad: float, context: BehaviourContext) -> None:
        pitch_rad = elevation_rad - context.gimbal.camera_pitch_rad
        gimbal = context.state.gimbal
        if gimbal is not None:  # else the gimbal is lost, which is reported
            self.aim = GimbalAim(gimbal.nearest_pitch_rad(pitch_rad))

    def _stuck(self, context: BehaviourContext) -> str | None:
        """The gimbal lags behind its aim for longer than `PATIENCE_S`, in words; None: it does not."""
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
