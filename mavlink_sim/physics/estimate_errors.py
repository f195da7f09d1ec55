"""The vehicle's estimate of its motion: the truth with a navigation filter's errors, and noisy sensors.

Control and telemetry use the estimate; only the truth file and the camera use the truth. Magnitudes are from
a PX4 v1.18 on its own SIH physics: telemetry beside the simulation's truth, at rest and in flight. Errors are
Gauss-Markov processes with their own seed at fixed times, so that neither the number of links nor requests on
them change a flight.

The velocity is off by what a tilt error of some tenths of a degree integrates to; the position is off by what
the velocity error integrates to, and is pulled back by GNSS.
"""

from __future__ import annotations

import math
import random

from mavlink_sim.physics.airframe import Multirotor
from mavlink_sim.physics.gaussian import BITS, NORMAL
from mavlink_sim.physics.rotations import Quaternion, Vector

# Standard deviations, (north, east, down). Measured horizontally in three flights with manoeuvres, with 3, 0
# and 5 m/s of wind: 0.28, 0.39 and 0.25 m/s (p50), 0.53, 0.74 and 0.50 (p95); here 0.31 and 0.65. Down it is
# smaller than measured (0.15 m/s, and 0.33 m of position).
VELOCITY_ERROR_MPS = (0.27, 0.27, 0.06)
# Of the acceleration error, and again of the velocity error that follows it.
VELOCITY_TIME_CONSTANT_S = 1.8
POSITION_TIME_CONSTANT_S = (0.75, 0.75, 3.5)
# Smaller than measured in flight: 0.014 of tilt, 0.03 of heading.
TILT_ERROR_RAD = 0.003
YAW_ERROR_RAD = 0.008
ATTITUDE_TIME_CONSTANT_S = 4.0
RATE_NOISE_RADPS = (0.035, 0.020, 0.010)
ACCELEROMETER_NOISE_MPS2 = 0.3
GPS_NOISE_M = (0.13, 0.13, 0.20)
GPS_VELOCITY_NOISE_MPS = 0.012
BAROMETER_DRIFT_M = 0.2
BAROMETER_TIME_CONSTANT_S = 20.0
# At rest on the ground the filter knows that it does not move.
SHARE_ON_GROUND = 0.1

RATE_STEP_S = 0.008
DRIFT_STEP_S = 0.024  # velocity and position: steps of a millimetre
SLOW_STEP_S = 0.048  # attitude, barometer
GPS_STEP_S = 0.096  # a receiver of 10 Hz
# White noise is read cyclically from a table of 8 s; no time constant in a flight is as long.
_TABLE_LENGTH = 1009

_ZERO: Vector = (0.0, 0.0, 0.0)
# Share kept from one step to the next, and the excitation of the acceleration error per step and m/s of
# velocity error: two equal stages pass 1/√2 of the deviation, times their time constant.
_VELOCITY_KEEP = 1.0 - DRIFT_STEP_S / VELOCITY_TIME_CONSTANT_S
_VELOCITY_SPREAD = math.sqrt(2.0 * (1.0 - _VELOCITY_KEEP * _VELOCITY_KEEP)) / VELOCITY_TIME_CONSTANT_S


class Estimate(Multirotor):
    """The airframe as its autopilot estimates it: has a `Multirotor`'s attributes; demands go to the true
    one.

    Args:
        truth: the airframe.
        seed: of the errors.
        noise: scale of the errors; 1: as measured, 0: the estimate is the truth.

    Attributes:
        position, velocity, acceleration, quaternion, rates…: the estimates, as `Multirotor`'s.
        offset: additional position error, NED metres (GPS drift, estimator reset); velocity_offset: m/s,
            yaw_offset_rad: the same of velocity and heading. Zero by default, also active without noise.
        gps_error: NED metres, of the receiver's newest fix. gps_velocity_error: m/s.
        baro_error_m: of the pressure altitude.
        accelerometer_noise: body FRD m/s².
    """

    __slots__ = (
        "_acceleration_error",
        "_drift_left_s",
        "_gps_left_s",
        "_index",
        "_noise",
        "_noise_source",
        "_rate_left_s",
        "_slow_left_s",
        "_table",
        "accelerometer_noise",
        "attitude_error",
        "baro_error_m",
        "drift",
        "gps_error",
        "gps_velocity_error",
        "offset",
        "rate_error",
        "truth",
        "velocity_error",
        "velocity_offset",
        "yaw_offset_rad",
    )

    def __init__(self, truth: Multirotor, seed: int = 0, noise: float = 1.0) -> None:
        self.truth = truth
        super().__init__(seed)
        self._noise = noise
        self._noise_source = random.Random(f"estimator {seed}")
        self._rate_left_s = self._drift_left_s = self._slow_left_s = self._gps_left_s = 0.0
        gauss = self._noise_source.gauss
        p, q, r = _scaled(RATE_NOISE_RADPS, noise)
        self._index = 0
        self._table = (
            [(gauss(0.0, p), gauss(0.0, q), gauss(0.0, r)) for _ in range(_TABLE_LENGTH)] if noise else []
        )
        self.rate_error: Vector = _ZERO
        self.drift: Vector = _ZERO
        self.offset: Vector = _ZERO
        self.velocity_offset: Vector = _ZERO
        self.yaw_offset_rad = 0.0
        self._acceleration_error: Vector = _ZERO
        self.velocity_error: Vector = _ZERO
        self.attitude_error: Vector = _ZERO
        self.gps_error: Vector = _ZERO
        self.gps_velocity_error = 0.0
        self.baro_error_m = 0.0
        self.accelerometer_noise: Vector = _ZERO
        self.update(0.0)

    def reseed(self, seed: int) -> None:
        """Draw the errors from now on with another seed; the current ones fade."""
        self._noise_source.seed(f"estimator {seed}")
        self._index = seed % _TABLE_LENGTH

    # ---- time -------------------------------------------------------------------------------------------

    def update(self, dt_s: float) -> None:
        """Advance the errors by `dt_s` and update from the truth."""
        self.age(dt_s)
        self.refresh()

    def age(self, dt_s: float, steps: int = 1) -> None:
        """Advance the errors by steps of `dt_s`; the attributes stay those of the last `refresh`."""
        if not self._noise:
            return
        for _ in range(steps):
            self._rate_left_s -= dt_s
            if self._rate_left_s <= 1e-9:
                self._shake()

    def refresh(self) -> None:
        """Update from the truth, with the current errors."""
        truth = self.truth
        self.on_ground = truth.on_ground
        self.acceleration = truth.acceleration
        self.rotor_thrusts = truth.rotor_thrusts
        self.crashed = truth.crashed
        north_m, east_m, down_m = truth.position
        north_mps, east_mps, down_mps = truth.velocity
        if self._noise:
            p, q, r = truth.rates
            noise_p, noise_q, noise_r = self.rate_error
            self.rates = (p + noise_p, q + noise_q, r + noise_r)
            north, east, down = self.drift
            north_m, east_m, down_m = north_m + north, east_m + east, down_m + down
            north, east, down = self.velocity_error
            north_mps, east_mps, down_mps = north_mps + north, east_mps + east, down_mps + down
        else:
            self.rates = truth.rates
        north, east, down = self.offset
        self.position = (north_m + north, east_m + east, down_m + down)
        north, east, down = self.velocity_offset
        self.velocity = (north_mps + north, east_mps + east, down_mps + down)

    def _shake(self) -> None:
        """Draw white noise of the rates; at every third call advance the errors of velocity and position."""
        self._rate_left_s += RATE_STEP_S
        self._index = index = (self._index + 1) % _TABLE_LENGTH
        share = SHARE_ON_GROUND if self.truth.on_ground else 1.0
        self.rate_error = self._table[index] if share == 1.0 else _scaled(self._table[index], share)
        self._drift_left_s -= RATE_STEP_S
        if self._drift_left_s <= 1e-9:
            self._drift(share)

    def _drift(self, share: float) -> None:
        """Advance all errors but the white noise.

        Those of velocity and position are a chain of low passes, so that none but the acceleration's has
        steps. `share`: of their excitation.
        """
        step_s = DRIFT_STEP_S
        self._drift_left_s += step_s
        self._acceleration_error = self._next_acceleration_error(share)
        north_mps2, east_mps2, down_mps2 = self._acceleration_error
        north_mps, east_mps, down_mps = self.velocity_error
        north_mps = _VELOCITY_KEEP * north_mps + north_mps2 * step_s
        east_mps = _VELOCITY_KEEP * east_mps + east_mps2 * step_s
        down_mps = _VELOCITY_KEEP * down_mps + down_mps2 * step_s
        self.velocity_error = (north_mps, east_mps, down_mps)
        north_m, east_m, down_m = self.drift
        north_s, east_s, down_s = POSITION_TIME_CONSTANT_S
        self.drift = (
            north_m + (north_mps - north_m / north_s) * step_s,
            east_m + (east_mps - east_m / east_s) * step_s,
            down_m + (down_mps - down_m / down_s) * step_s,
        )
        self._slow_left_s -= step_s
        if self._slow_left_s <= 1e-9:
            self._slow_left_s += SLOW_STEP_S
            self._drift_slowly()
        self._gps_left_s -= step_s
        if self._gps_left_s <= 1e-9:
            self._gps_left_s += GPS_STEP_S
            self._take_fix()

    def _next_acceleration_error(self, share: float) -> Vector:
        """NED, m/s²."""
        bits = self._noise_source.getrandbits
        north, east, down = self._acceleration_error
        spread = share * self._noise * _VELOCITY_SPREAD
        spread_north, spread_east, spread_down = VELOCITY_ERROR_MPS
        return (
            _VELOCITY_KEEP * north + spread * spread_north * NORMAL[bits(BITS)],
            _VELOCITY_KEEP * east + spread * spread_east * NORMAL[bits(BITS)],
            _VELOCITY_KEEP * down + spread * spread_down * NORMAL[bits(BITS)],
        )

    def _drift_slowly(self) -> None:
        """Advance the errors of attitude, barometer and accelerometer."""
        gauss = self._noise_source.gauss
        keep = 1.0 - SLOW_STEP_S / ATTITUDE_TIME_CONSTANT_S
        spread = self._noise * math.sqrt(1.0 - keep * keep)
        tilt_rad, turn_rad = spread * TILT_ERROR_RAD, spread * YAW_ERROR_RAD
        roll, pitch, yaw = self.attitude_error
        self.attitude_error = (
            keep * roll + gauss(0.0, tilt_rad),
            keep * pitch + gauss(0.0, tilt_rad),
            keep * yaw + gauss(0.0, turn_rad),
        )
        keep = 1.0 - SLOW_STEP_S / BAROMETER_TIME_CONSTANT_S
        spread = self._noise * math.sqrt(1.0 - keep * keep)
        self.baro_error_m = keep * self.baro_error_m + gauss(0.0, spread * BAROMETER_DRIFT_M)
        noise = self._noise * ACCELEROMETER_NOISE_MPS2
        self.accelerometer_noise = (gauss(0.0, noise), gauss(0.0, noise), gauss(0.0, noise))

    def _take_fix(self) -> None:
        """A new fix of the GPS receiver."""
        gauss = self._noise_source.gauss
        noise_north, noise_east, noise_down = _scaled(GPS_NOISE_M, self._noise)
        north, east, down = self.drift
        self.gps_error = (
            north + gauss(0.0, noise_north),
            east + gauss(0.0, noise_east),
            down + gauss(0.0, noise_down),
        )
        self.gps_velocity_error = gauss(0.0, self._noise * GPS_VELOCITY_NOISE_MPS)

    # ---- readings ---------------------------------------------------------------------------------------

    @property
    def quaternion(self) -> Quaternion:
        """The attitude with its error, a small turn about the body axes (to first order)."""
        w, x, y, z = self.truth.quaternion
        if self.yaw_offset_rad:
            cosine, sine = math.cos(self.yaw_offset_rad / 2), math.sin(self.yaw_offset_rad / 2)
            w, x, y, z = (
                cosine * w - sine * z,
                cosine * x - sine * y,
                cosine * y + sine * x,
                cosine * z + sine * w,
            )
        if not self._noise:
            return (w, x, y, z)
        a, b, c = (0.5 * error for error in self.attitude_error)
        return (
            w - x * a - y * b - z * c,
            x + w * a + y * c - z * b,
            y + w * b + z * a - x * c,
            z + w * c + x * b - y * a,
        )

    @quaternion.setter
    def quaternion(self, value: Quaternion) -> None:
        """Does nothing: the attitude is the airframe's."""

    @property
    def floor_down_m(self) -> float:
        """NED z of the surface the airframe stands or last stood on."""
        return self.truth.floor_down_m

    @floor_down_m.setter
    def floor_down_m(self, value: float) -> None:
        """Does nothing: the airframe has the surface."""

    @property
    def roll_rad(self) -> float:
        a, b, c = self.attitude_error
        _, _, _, _, _, _, x, y, z = self.truth.matrix
        return math.atan2(y + z * a - x * c, z + x * b - y * a)

    @property
    def pitch_rad(self) -> float:
        _, b, c = self.attitude_error
        _, _, _, _, _, _, x, y, z = self.truth.matrix
        return -math.asin(min(max(x + y * c - z * b, -1.0), 1.0))

    @property
    def yaw_rad(self) -> float:
        _, pitch, yaw = self.attitude_error
        a, b, c, d, e, f, _, _, _ = self.truth.matrix
        return math.remainder(
            math.atan2(d + e * yaw - f * pitch, a + b * yaw - c * pitch) + self.yaw_offset_rad, math.tau
        )

    @yaw_rad.setter
    def yaw_rad(self, yaw_rad: float) -> None:
        self.truth.yaw_rad = yaw_rad

    @property
    def specific_force(self) -> Vector:
        x, y, z = self.truth.specific_force
        a, b, c = self.accelerometer_noise
        return (x + a, y + b, z + c)

    @property
    def gps_position(self) -> Vector:
        """The GPS receiver's position, NED metres."""
        x, y, z = self.truth.position
        a, b, c = self.gps_error
        d, e, f = self.offset
        return (x + a + d, y + b + e, z + c + f)

    @property
    def pressure_height_m(self) -> float:
        """The barometer's height above the start."""
        return -self.truth.position[2] + self.baro_error_m

    # ---- demands ----------------------------------------------------------------------------------------

    def command(self, thrust_mps2: float, roll_rad: float, pitch_rad: float, yaw_rate_radps: float) -> None:
        """Send the demand to the airframe, whose attitude stands for the estimated one."""
        if self._noise:
            a, b, _ = self.attitude_error
            roll_rad, pitch_rad = roll_rad - a, pitch_rad - b
        self.truth.command(thrust_mps2, roll_rad, pitch_rad, yaw_rate_radps)

    def command_rates(self, thrust_mps2: float, rates_radps: Vector) -> None:
        self.truth.command_rates(thrust_mps2, rates_radps)

    def step_rates(self, dt_s: float, thrust_mps2: float, rates: Vector) -> None:
        """`command_rates` only, as `step`."""
        self.truth.command_rates(thrust_mps2, rates)

    def advance(self, dt_s: float, steps: int = 1) -> None:
        """Does nothing: only the true airframe moves."""

    def fail_motor(self, index: int, effectiveness: float = 0.0) -> None:
        self.truth.fail_motor(index, effectiveness)

    def step(
        self, dt_s: float, thrust_mps2: float, roll_rad: float, pitch_rad: float, yaw_rate_radps: float
    ) -> None:
        """`command` only: the vehicle advances the true airframe."""
        self.command(thrust_mps2, roll_rad, pitch_rad, yaw_rate_radps)


def _scaled(vector: Vector, share: float) -> Vector:
    x, y, z = vector
    return (x * share, y * share, z * share)
