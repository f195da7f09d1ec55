"""Fusion of VISION_POSITION_ESTIMATE into the estimate, as PX4's EKF2 does it (`EKF2_EV_CTRL`).

A sample is compared with the estimate at its own time (arrival less EKF2_EV_DELAY), gated by EKF2_EVP_GATE
or EKF2_HDG_GATE sigmas, and fused with the larger of its own variance and EKF2_EVP_NOISE or EKF2_EVA_NOISE.
While GNSS is fused, the position only follows the bias between both, so vision moves nothing. Without GNSS
the position is reset to the first sample and follows the samples from then on; it stays valid. Fusion starts
with two samples within 0.2 s and ends 0.4 s after the last. After EKF2_NOAID_TOUT of rejected samples the
estimate is reset to them, five times in the air.

The height follows vision if EKF2_HGT_REF is 3. Less than PX4: velocities (bit 2 of EKF2_EV_CTRL) are not
fused, and VISION_POSITION_ESTIMATE has none. Time is that of the arrival, as by a PX4 whose clock
synchronization has not converged.
"""

from __future__ import annotations

import math

from mavlink_sim.physics.fallible_estimate import FallibleEstimate
from mavlink_sim.px4.parameters import Parameters

HORIZONTAL, VERTICAL, YAW = 1, 2, 8  # bits of EKF2_EV_CTRL
VISION_HEIGHT = 3  # EKF2_HGT_REF
MAX_INTERVAL_S, RESETS = 0.2, 5  # EV_MAX_INTERVAL
# Growth of the estimate's variance between samples; assumed, not measured. With samples at 20 Hz and 0.1 m of
# noise an error of the position is halved in 0.1 s. Position, m²/s; heading, rad²/s.
POSITION_GROWTH, YAW_GROWTH = 0.02, 1e-4
# The number of this error among those of the faults, which count from 1.
_NUMBER = -1


class VisionAiding:
    """Vision's part in one estimate.

    Attributes:
        position_fused: the horizontal position follows vision, so that it needs no GNSS.
        yaw_fused: the heading follows vision.
    """

    def __init__(self, estimate: FallibleEstimate, parameters: Parameters) -> None:
        self._estimate, self._parameters = estimate, parameters
        self._now_s, self._received_s = 0.0, -math.inf
        self._fused_s = self._yaw_fused_s = -math.inf
        self._variance, self._yaw_variance = 0.0, 0.0
        self._correction, self._yaw_correction = (0.0, 0.0, 0.0), 0.0
        self._resets_left = RESETS
        self._reset_counter = 0
        self.position_fused = self.yaw_fused = False

    def add(
        self,
        now_s: float,
        position_ned_m: tuple[float, float, float],
        yaw_rad: float,
        variances: tuple[float, float, float, float],
        reset_counter: int,
    ) -> None:
        """Process one sample.

        Args:
            now_s: time of its arrival.
            variances: of north, east and down, m², and of the yaw, rad². NaN: unknown.
            reset_counter: of the source; a change resets the estimate to it.
        """
        number, self._now_s = self._parameters.number, now_s
        control = int(number("EKF2_EV_CTRL"))
        since_s = now_s - self._received_s
        starting = since_s < MAX_INTERVAL_S
        reset = reset_counter != self._reset_counter
        self._received_s, self._reset_counter = now_s, reset_counter
        late_s = number("EKF2_EV_DELAY") / 1000.0
        estimate = self._estimate
        estimate.refresh()
        if control & YAW and math.isfinite(yaw_rad):
            then = estimate.yaw_rad - estimate.rates[2] * late_s  # nearly level
            off_rad = math.remainder(then - yaw_rad, math.tau)
            self._fuse_yaw(off_rad, variances[3], since_s, starting=starting, reset=reset)
        else:
            self.yaw_fused = False
        finite = all(math.isfinite(value) for value in position_ned_m)
        if not control & HORIZONTAL or not finite or not estimate.fix_lost:
            self.position_fused = False
            return
        before = zip(estimate.position, estimate.velocity, position_ned_m, strict=True)
        off = [place - speed * late_s - seen for place, speed, seen in before]
        if not (control & VERTICAL and int(number("EKF2_HGT_REF")) == VISION_HEIGHT):
            off[2] = 0.0
        self._fuse_position((off[0], off[1], off[2]), variances, since_s, starting=starting, reset=reset)

    def update(self, now_s: float) -> None:
        """End the fusion when no samples come."""
        if now_s - self._received_s > 2.0 * MAX_INTERVAL_S:
            self.position_fused = self.yaw_fused = False

    def on_gnss(self) -> None:
        """GNSS is fused again: the position is reset to it."""
        self.position_fused = False
        self._correction = (0.0, 0.0, 0.0)
        self._apply()

    def _fuse_position(
        self,
        off: tuple[float, float, float],
        variances: tuple[float, float, float, float],
        since_s: float,
        *,
        starting: bool,
        reset: bool,
    ) -> None:
        number, now_s = self._parameters.number, self._now_s
        stated = [value for value in variances[:2] if math.isfinite(value)]
        noise = max(*stated, number("EKF2_EVP_NOISE") ** 2, 1e-4)
        if not self.position_fused:
            if starting:
                self.position_fused, self._resets_left = True, RESETS
                self._reset_position(off, noise)
            return
        self._variance += POSITION_GROWTH * since_s
        spread = self._variance + noise
        if reset:
            self._reset_position(off, noise)
        elif max(abs(off[0]), abs(off[1])) <= max(number("EKF2_EVP_GATE"), 1.0) * math.sqrt(spread):
            gain = self._variance / spread
            self._variance *= 1.0 - gain
            self._fused_s = now_s
            self._correct(off, gain)
        elif now_s - self._fused_s > number("EKF2_NOAID_TOUT") / 1e6:
            if self._resets_left > 0:
                self._resets_left -= not self._estimate.on_ground
                self._reset_position(off, noise)
            else:
                self.position_fused = False

    def _reset_position(self, off: tuple[float, float, float], noise: float) -> None:
        self._variance, self._fused_s = noise, self._now_s
        estimate = self._estimate
        if estimate.held_xy_m is not None:
            # Off by what the frozen position is, not by what the estimate would be now.
            held, estimate.held_xy_m = estimate.held_xy_m, None
            estimate.refresh()
            moved = [now - then for now, then in zip(estimate.position, held, strict=False)]
            off = (off[0] + moved[0], off[1] + moved[1], off[2])
        self._correct(off, 1.0)
        estimate.count_reset()
        estimate.position_valid = True

    def _correct(self, off: tuple[float, float, float], gain: float) -> None:
        x, y, z = self._correction
        self._correction = (x - gain * off[0], y - gain * off[1], z - gain * off[2])
        self._apply()

    def _fuse_yaw(
        self, off_rad: float, variance: float, since_s: float, *, starting: bool, reset: bool
    ) -> None:
        number, now_s = self._parameters.number, self._now_s
        # EKF2 takes EKF2_EVA_NOISE for a variance here.
        noise = max(variance if math.isfinite(variance) else 0.0, number("EKF2_EVA_NOISE"))
        if not self.yaw_fused:
            if not starting:
                return
            self.yaw_fused, self._yaw_fused_s = True, now_s
            self._yaw_variance = number("EKF2_HEAD_NOISE") ** 2
        self._yaw_variance += YAW_GROWTH * since_s
        spread = self._yaw_variance + noise
        failing = now_s - self._yaw_fused_s > number("EKF2_NOAID_TOUT") / 1e6
        gain = self._yaw_variance / spread
        if reset or failing:
            gain, self._yaw_variance = 1.0, noise
        elif abs(off_rad) > max(number("EKF2_HDG_GATE"), 1.0) * math.sqrt(spread):
            return
        else:
            self._yaw_variance *= 1.0 - gain
        self._yaw_fused_s = now_s
        self._yaw_correction -= gain * off_rad
        self._apply()

    def _apply(self) -> None:
        self._estimate.set_error(_NUMBER, self._correction, yaw_rad=self._yaw_correction)
        self._estimate.refresh()
