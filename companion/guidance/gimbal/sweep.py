"""Gimbal sweep in pitch while the vehicle turns, and the turn rate at which nothing is missed.

The camera returns to the same pitch after at most one full sweep there and back. If the vehicle turns by less
than the image's width in that time, everything between the end pitches is seen.
"""

from __future__ import annotations

import math

from companion.vehicle.gimbal import GimbalAim

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
    """A sweep between level and an end pitch. Pitches are radians above the horizon.

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
