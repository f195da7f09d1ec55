"""The gimbal's way up and down while the vehicle turns, and how fast it may turn for nothing to be missed.

Between two visits of the camera to the same pitch lies at most one whole way there and back. As long as the
picture's width has not turned by in that time, everything between the ends comes into it.
"""

from __future__ import annotations

import math

from companion.vehicle.gimbal import GimbalAim

# A shorter way up and down shows nothing that a camera at rest does not.
LEAST_SWEEP_DEG = 5.0
USUAL_RATE_DPS = 20.0
# Of the picture's width a fifth is not counted on: boxes at its edge are cut.
COUNTED_ON = 0.8
# So far the gimbal may be behind what it is asked before it is waited for: in angle, and in time.
BEHIND_RAD, BEHIND_S = math.radians(8.0), 0.4
AT_END_RAD = math.radians(5.0)
# Waited for so long, it does not follow at all.
PATIENCE_S = 5.0


class GimbalSweep:
    """Between level and an end, at a rate. Pitches are radians above the horizon.

    Args:
        end_rad: the other end, below the horizon or above.
        rate_radps: how fast it pitches.
        field_rad: what the camera sees from its left edge to its right.

    Attributes:
        waiting: the gimbal is behind, and what turns should stand.
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
        """How fast the vehicle may turn."""
        there_and_back_s = 2.0 * abs(self.end_rad) / self._rate_radps
        return COUNTED_ON * self._field_rad / there_and_back_s

    @property
    def aim(self) -> GimbalAim | None:
        """Where the gimbal is to look now; None before `begin`."""
        return None if self._pitch_rad is None else GimbalAim(self._pitch_rad)

    def begin(self, measured_rad: float) -> None:
        """From where the gimbal looks now, towards the end."""
        limit = math.pi / 2
        self._pitch_rad = self._began_rad = max(-limit, min(limit, measured_rad))
        self._goal_rad, self._waited_s, self.waiting = self.end_rad, 0.0, False

    def step(self, dt_s: float, measured_rad: float) -> None:
        """Go on for `dt_s`, with the gimbal where it is measured to be; turn back at the ends."""
        self.towards(self._goal_rad, dt_s, measured_rad)
        if self._pitch_rad == self._goal_rad and abs(measured_rad - self._goal_rad) <= AT_END_RAD:
            self._goal_rad = 0.0 if self._goal_rad == self.end_rad else self.end_rad

    def towards(self, pitch_rad: float, dt_s: float, measured_rad: float) -> None:
        """Go towards a pitch and stay there; wait where the gimbal does not follow."""
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
        """Go back to where it began. True: it is there."""
        self.towards(self._began_rad, dt_s, measured_rad)
        return self._pitch_rad == self._began_rad and not self.waiting

    def stuck(self, measured_rad: float) -> str | None:
        """Why there is no use in going on, in words; None: the gimbal follows."""
        if self._waited_s <= PATIENCE_S or self._pitch_rad is None:
            return None
        return f"the gimbal does not follow: {gap_text(self._pitch_rad, measured_rad)}"


def gap_text(asked_rad: float, measured_rad: float) -> str:
    """What was asked of a gimbal and where it is, for people."""
    return f"asked for {math.degrees(asked_rad):.0f}°, it is at {math.degrees(measured_rad):.0f}°"
