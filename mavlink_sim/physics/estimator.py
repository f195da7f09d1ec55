"""The vehicle's estimate of its motion: the truth with a navigation filter's errors, and noisy sensors.

Control and telemetry use the estimate; only the truth file and the camera use the truth. Magnitudes are from
a PX4 on its own SIH physics: telemetry at rest and in flight, and the covariances of its ODOMETRY. Errors are
Gauss-Markov processes with their own seed at fixed times, so that neither the number of links nor requests on
them change a flight.
"""

from __future__ import annotations

import math
import random

from mavlink_sim.physics.airframe import Multirotor, Quaternion, Vector
from mavlink_sim.physics.gaussian import BITS, NORMAL

# Standard deviations. Position: metres, the smoothed drift of the filter, (north, east, down).
POSITION_DRIFT_M = (0.16, 0.16, 0.06)
VELOCITY_TIME_CONSTANT_S = 1.5
POSITION_TIME_CONSTANT_S = 6.0
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
# Excitation of the velocity error per step and metre of drift, so that the drift has the deviation above.
_VELOCITY_KEEP = 1.0 - DRIFT_STEP_S / VELOCITY_TIME_CONSTANT_S
_VELOCITY_SPREAD = math.sqrt(
    (VELOCITY_TIME_CONSTANT_S + POSITION_TIME_CONSTANT_S)
    / (VELOCITY_TIME_CONSTANT_S * POSITION_TIME_CONSTANT_S**2)
    * (1.0 - _VELOCITY_KEEP * _VELOCITY_KEEP)
)


class Estimate(Multirotor):
    """The airframe as its autopilot estimates it: has a `Multirotor`'s attributes; demands go to the true
    one.

    Args:
        truth: the airframe.
        seed: of the errors.
        noise: False: the estimate is the truth.

    Attributes:
        position, velocity, acceleration, quaternion, rates…: the estimates, as `Multirotor`'s.
        offset: additional position error, NED metres (GPS drift, estimator reset); velocity_offset: m/s,
            yaw_offset_rad: the same of velocity and heading. Zero by default, also active without noise.
        gps_error: NED metres, of the receiver's newest fix. gps_velocity_error: m/s.
        baro_error_m: of the pressure altitude.
        accelerometer_noise: body FRD m/s².
    """

    __slots__ = (
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

    def __init__(self, truth: Multirotor, seed: int = 0, noise: bool = True) -> None:
        self.truth = truth
        super().__init__(seed)
        self._noise = noise
        self._noise_source = random.Random(f"estimator {seed}")
        self._rate_left_s = self._drift_left_s = self._slow_left_s = self._gps_left_s = 0.0
        gauss = self._noise_source.gauss
        p, q, r = RATE_NOISE_RADPS
        self._index = 0
        self._table = (
            [(gauss(0.0, p), gauss(0.0, q), gauss(0.0, r)) for _ in range(_TABLE_LENGTH)] if noise else []
        )
        self.rate_error: Vector = _ZERO
        self.drift: Vector = _ZERO
        self.offset: Vector = _ZERO
        self.velocity_offset: Vector = _ZERO
        self.yaw_offset_rad = 0.0
        self.velocity_error: Vector = _ZERO
        self.attitude_error: Vector = _ZERO
        self.gps_error: Vector = _ZERO
        self.gps_velocity_error = 0.0
        self.baro_error_m = 0.0
        self.accelerometer_noise: Vector = _ZERO
        self.update(0.0)

    # ---- time -------------------------------------------------------------------------------------------

    def update(self, dt_s: float) -> None:
        """Advance the errors by `dt_s` and update from the truth."""
        self.age(dt_s)
        self.refresh()

    def age(self, dt_s: float) -> None:
        """Advance the errors; the attributes stay those of the last `refresh`."""
        if self._noise:
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
        if self._noise:
            p, q, r = truth.rates
            dx, dy, dz = self.rate_error
            self.rates = (p + dx, q + dy, r + dz)
            dx, dy, dz = self.drift
            x, y, z = truth.position
            ox, oy, oz = self.offset
            self.position = (x + dx + ox, y + dy + oy, z + dz + oz)
            ex, ey, ez = self.velocity_error
            vx, vy, vz = truth.velocity
            ox, oy, oz = self.velocity_offset
            self.velocity = (vx + ex + ox, vy + ey + oy, vz + ez + oz)
        else:
            x, y, z = truth.position
            ox, oy, oz = self.offset
            self.position = (x + ox, y + oy, z + oz)
            x, y, z = truth.velocity
            ox, oy, oz = self.velocity_offset
            self.velocity = (x + ox, y + oy, z + oz)
            self.rates = truth.rates

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
        """The position's error is a low-passed velocity error, so that it has no steps."""
        dt = DRIFT_STEP_S
        self._drift_left_s += dt
        bits = self._noise_source.getrandbits
        ex, ey, ez = self.velocity_error
        nx, ny, nz = POSITION_DRIFT_M
        spread = share * _VELOCITY_SPREAD
        ex = _VELOCITY_KEEP * ex + spread * nx * NORMAL[bits(BITS)]
        ey = _VELOCITY_KEEP * ey + spread * ny * NORMAL[bits(BITS)]
        ez = _VELOCITY_KEEP * ez + spread * nz * NORMAL[bits(BITS)]
        self.velocity_error = (ex, ey, ez)
        dx, dy, dz = self.drift
        hold = 1.0 - dt / POSITION_TIME_CONSTANT_S
        self.drift = (hold * dx + ex * dt, hold * dy + ey * dt, hold * dz + ez * dt)
        gauss = self._noise_source.gauss
        self._slow_left_s -= dt
        if self._slow_left_s <= 1e-9:
            self._slow_left_s += SLOW_STEP_S
            keep = 1.0 - SLOW_STEP_S / ATTITUDE_TIME_CONSTANT_S
            spread = math.sqrt(1.0 - keep * keep)
            tilt, turn = spread * TILT_ERROR_RAD, spread * YAW_ERROR_RAD
            a, b, c = self.attitude_error
            self.attitude_error = (
                keep * a + gauss(0.0, tilt),
                keep * b + gauss(0.0, tilt),
                keep * c + gauss(0.0, turn),
            )
            keep = 1.0 - SLOW_STEP_S / BAROMETER_TIME_CONSTANT_S
            self.baro_error_m = keep * self.baro_error_m + gauss(
                0.0, BAROMETER_DRIFT_M * math.sqrt(1.0 - keep * keep)
            )
            noise = ACCELEROMETER_NOISE_MPS2
            self.accelerometer_noise = (gauss(0.0, noise), gauss(0.0, noise), gauss(0.0, noise))
        self._gps_left_s -= dt
        if self._gps_left_s <= 1e-9:
            self._gps_left_s += GPS_STEP_S
            north, east, down = GPS_NOISE_M
            dx, dy, dz = self.drift
            self.gps_error = (dx + gauss(0.0, north), dy + gauss(0.0, east), dz + gauss(0.0, down))
            self.gps_velocity_error = gauss(0.0, GPS_VELOCITY_NOISE_MPS)

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

    def advance(self, dt_s: float) -> None:
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
