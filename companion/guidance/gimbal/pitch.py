"""The pitch that a behaviour requests of the gimbal: a sweep while searching, then kept on an object."""

from __future__ import annotations

import math
from typing import Annotated

from companion.guidance.behaviour import BehaviourContext
from companion.guidance.command import EnumArgument
from companion.guidance.motion import Lasting
from companion.guidance.objects.target import Target
from companion.vehicle.gimbal import GimbalAim
from companion.vehicle.state import Vector3

# A smaller sweep shows nothing that a fixed camera does not.
LEAST_SWEEP_DEG = 5.0
USUAL_RATE_DPS = 20.0
# Usable part of the image's width: boxes at its edge are cut.
USABLE_WIDTH = 0.8
# Lag of the gimbal that is tolerated before the sweep waits: angle, and time.
BEHIND_RAD, BEHIND_S = math.radians(8.0), 0.4
AT_END_RAD = math.radians(5.0)
# After waiting this long, the gimbal counts as stuck.
PATIENCE_S = 5.0


class GimbalSweep:
    """A sweep in pitch while the vehicle turns, and the turn rate at which nothing is missed.

    The camera returns to the same pitch after at most one full sweep there and back. If the vehicle turns by
    less than the image's width in that time, everything between level and the end pitch is seen. Pitches are
    radians above the horizon.

    Args:
        end_rad: the end pitch, below the horizon or above.
        rate_radps: pitch rate.
        field_rad: the camera's horizontal field of view.

    Attributes:
        waiting: the gimbal lags, and the vehicle should not turn.
    """

    def __init__(self, end_rad: float, rate_radps: float, field_rad: float) -> None:
        self.end_rad, self._rate_radps, self._field_rad = end_rad, rate_radps, field_rad
        self.waiting = False
        self._pitch_rad: float | None = None
        self._began_rad = 0.0
        self._goal_rad = end_rad
        self._waited_s = 0.0

    @property
    def turn_rate_radps(self) -> float:
        """Maximum turn rate of the vehicle."""
        there_and_back_s = 2.0 * abs(self.end_rad) / self._rate_radps
        return USABLE_WIDTH * self._field_rad / there_and_back_s

    @property
    def aim(self) -> GimbalAim | None:
        """Where to point the gimbal now; None before `begin`."""
        return None if self._pitch_rad is None else GimbalAim(self._pitch_rad)

    def begin(self, measured_rad: float) -> None:
        """Start from the gimbal's current pitch, towards the end."""
        limit = math.pi / 2
        self._pitch_rad = self._began_rad = max(-limit, min(limit, measured_rad))
        self._goal_rad, self._waited_s, self.waiting = self.end_rad, 0.0, False

    def step(self, dt_s: float, measured_rad: float) -> None:
        """Advance by `dt_s` with the gimbal at the measured pitch; reverse at the ends."""
        self.towards(self._goal_rad, dt_s, measured_rad)
        if self._pitch_rad == self._goal_rad and abs(measured_rad - self._goal_rad) <= AT_END_RAD:
            self._goal_rad = 0.0 if self._goal_rad == self.end_rad else self.end_rad

    def towards(self, pitch_rad: float, dt_s: float, measured_rad: float) -> None:
        """Move towards a pitch and stay there; wait while the gimbal lags."""
        assert self._pitch_rad is not None
        behind_rad = abs(self._pitch_rad - measured_rad)
        at_end = self._pitch_rad == pitch_rad
        allowed_rad = AT_END_RAD if at_end else max(BEHIND_RAD, BEHIND_S * self._rate_radps)
        self.waiting = behind_rad > allowed_rad
        self._waited_s = self._waited_s + dt_s if self.waiting else 0.0
        if not self.waiting:
            reach = self._rate_radps * dt_s
            self._pitch_rad += max(-reach, min(reach, pitch_rad - self._pitch_rad))

    def back(self, dt_s: float, measured_rad: float) -> bool:
        """Return to the initial pitch. True: reached."""
        self.towards(self._began_rad, dt_s, measured_rad)
        return self._pitch_rad == self._began_rad and not self.waiting

    def stuck(self, measured_rad: float) -> str | None:
        """Why the sweep has failed, in words; None: the gimbal follows."""
        if self._waited_s <= PATIENCE_S or self._pitch_rad is None:
            return None
        return f"the gimbal does not follow: {gap_text(self._pitch_rad, measured_rad)}"


def gap_text(asked_rad: float, measured_rad: float) -> str:
    """Commanded and measured pitch in words."""
    return f"commanded {math.degrees(asked_rad):.0f}°, measured {math.degrees(measured_rad):.0f}°"


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
    """Pitch aim that keeps an object vertically centred in the image; the vehicle's yaw keeps the bearing.

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
        self._behind = Lasting()

    def begin(self, context: BehaviourContext) -> None:
        """Hold the current pitch, so that control is acquired before the object is seen."""
        gimbal = context.state.gimbal
        self.aim = self._seen = self._down_m = None
        self._behind = Lasting()
        self._begun_ns = context.now_ns
        if gimbal is not None and gimbal.pitch_rad is not None:
            self.aim = GimbalAim(gimbal.nearest_pitch_rad(gimbal.pitch_rad))

    def control_fault(self, context: BehaviourContext) -> str | None:
        """Why the gimbal is not moved any more, in words; None: it is."""
        if context.now_ns <= self._begun_ns:  # the first update still shows the previous owner's problem
            return None
        return context.gimbal.problem or None

    def keep_on(
        self, newest: Target | None, range_m: float, position: Vector3, context: BehaviourContext
    ) -> str | None:
        """Point at the object's estimated position, within the gimbal's range.

        Args:
            newest: its newest detection; None: none.
            range_m: its estimated range now, horizontal metres; NaN: not known yet. Fully inside the image it
                may get one.
            position: the vehicle's, local NED metres.
            context: for the gimbal's state.

        Returns:
            Why tracking has failed, in words; None: the gimbal follows.
        """
        if newest is not None and math.isnan(range_m):
            self._point_at(newest.elevation_rad, context)
        elif newest is not None:
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
        if context.state.gimbal is not None:  # else the gimbal is lost, which is reported
            self.aim = GimbalAim(context.gimbal_pitch_to(elevation_rad))

    def _stuck(self, context: BehaviourContext) -> str | None:
        """The gimbal lags behind its aim for longer than `PATIENCE_S`, in words; None: it does not."""
        gimbal = context.state.gimbal
        measured_rad = None if gimbal is None else gimbal.pitch_rad
        off_rad = 0.0 if self.aim is None or measured_rad is None else abs(self.aim.pitch_rad - measured_rad)
        if self._behind.held_s(off_rad > BEHIND_RAD, context.now_ns) <= PATIENCE_S:
            return None
        assert self.aim is not None
        assert measured_rad is not None
        return f"it does not follow: {gap_text(self.aim.pitch_rad, measured_rad)}"
