"""The motion of a multirotor: a point mass under thrust, drag and wind, with attitude control.

World frame NED with its origin on the ground where the vehicle started, body frame FRD. Mass, drag and thrust
are those of PX4's own SIH quadrotor (SIH_MASS 1 kg, SIH_KDV 1 N/(m/s), 4 × SIH_T_MAX 5 N). Plain floats
throughout: numpy's scalars would make the 250 Hz step several times dearer.
"""

from __future__ import annotations

import math
import random

from mavlink_sim.body_rates import turned

Vector = tuple[float, float, float]

GRAVITY_MPS2 = 9.80665
MAX_THRUST_MPS2 = 20.0  # 4 rotors of SIH_T_MAX 5 N on SIH_MASS 1 kg
LINEAR_DRAG_PER_S = 1.0  # SIH_KDV / SIH_MASS
THRUST_TIME_CONSTANT_S = 0.05  # SIH_T_TAU
ATTITUDE_GAIN_PER_S = 4.0  # MC_ROLL_P, MC_PITCH_P
MAX_TILT_RATE_RADPS = math.radians(220.0)  # MC_ROLLRATE_MAX
RATE_TIME_CONSTANT_S = 0.05
YAW_RATE_TIME_CONSTANT_S = 0.15
MAX_YAW_RATE_RADPS = math.radians(200.0)  # MC_YAWRATE_MAX
GUST_TIME_CONSTANT_S = 1.5


class Multirotor:
    """One airframe. Deterministic: the same seed and the same demands give the same flight.

    Attributes:
        position: NED metres; velocity: NED m/s; acceleration: NED m/s², kinematic.
        roll_rad, pitch_rad, yaw_rad: attitude, aerospace sequence.
        rates: body angular rates about FRD, rad/s.
        thrust_mps2: collective thrust per mass, along body up.
        on_ground: touching the ground.
        wind: NED m/s steady wind; gusts of `gusts_mps` (standard deviation per axis) come on top.
    """

    __slots__ = (
        "_gust",
        "_random",
        "acceleration",
        "gusts_mps",
        "on_ground",
        "pitch_rad",
        "position",
        "rates",
        "roll_rad",
        "thrust_mps2",
        "velocity",
        "wind",
        "yaw_rad",
    )

    def __init__(self, seed: int = 0, wind: Vector = (0.0, 0.0, 0.0), gusts_mps: float = 0.0) -> None:
        self.position: Vector = (0.0, 0.0, 0.0)
        self.velocity: Vector = (0.0, 0.0, 0.0)
        self.acceleration: Vector = (0.0, 0.0, 0.0)
        self.roll_rad = self.pitch_rad = self.yaw_rad = 0.0
        self.rates: Vector = (0.0, 0.0, 0.0)
        self.thrust_mps2 = 0.0
        self.on_ground = True
        self.wind = wind
        self.gusts_mps = gusts_mps
        self._gust: Vector = (0.0, 0.0, 0.0)
        self._random = random.Random(seed)

    @property
    def specific_force(self) -> Vector:
        """What an accelerometer feels, body FRD m/s²."""
        ax, ay, az = self.acceleration
        az -= GRAVITY_MPS2
        cr, sr = math.cos(self.roll_rad), math.sin(self.roll_rad)
        cp, sp = math.cos(self.pitch_rad), math.sin(self.pitch_rad)
        cy, sy = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return (
            cy * cp * ax + sy * cp * ay - sp * az,
            (cy * sp * sr - sy * cr) * ax + (sy * sp * sr + cy * cr) * ay + cp * sr * az,
            (cy * sp * cr + sy * sr) * ax + (sy * sp * cr - cy * sr) * ay + cp * cr * az,
        )

    def step(
        self, dt_s: float, thrust_mps2: float, roll_rad: float, pitch_rad: float, yaw_rate_radps: float
    ) -> None:
        """Advance by `dt_s` (at most ~10 ms) towards the demanded thrust, tilt and yaw rate."""
        self._turn(dt_s, roll_rad, pitch_rad, yaw_rate_radps)
        self._push(dt_s, thrust_mps2)

    def step_rates(self, dt_s: float, thrust_mps2: float, rates: Vector) -> None:
        """Advance towards demanded thrust and body rates (FRD, rad/s); NaN: go on turning as now."""
        if self.on_ground:
            self._turn(dt_s, 0.0, 0.0, 0.0)
        else:
            lags = (RATE_TIME_CONSTANT_S, RATE_TIME_CONSTANT_S, YAW_RATE_TIME_CONSTANT_S)
            p, q, r = (
                now if math.isnan(wanted) else now + (wanted - now) * min(1.0, dt_s / lag)
                for now, wanted, lag in zip(self.rates, rates, lags, strict=True)
            )
            self.rates = (p, q, r)
            attitude = (self.roll_rad, self.pitch_rad, self.yaw_rad)
            self.roll_rad, self.pitch_rad, self.yaw_rad = turned(attitude, self.rates, dt_s)
        self._push(dt_s, thrust_mps2)

    def _push(self, dt_s: float, thrust_mps2: float) -> None:
        demanded = min(max(thrust_mps2, 0.0), MAX_THRUST_MPS2)
        self.thrust_mps2 += (demanded - self.thrust_mps2) * min(1.0, dt_s / THRUST_TIME_CONSTANT_S)
        self._move(dt_s)

    def _turn(self, dt_s: float, roll_rad: float, pitch_rad: float, yaw_rate_radps: float) -> None:
        if self.on_ground:  # the landing gear keeps it level and its heading
            blend = min(1.0, dt_s / 0.1)
            self.roll_rad -= self.roll_rad * blend
            self.pitch_rad -= self.pitch_rad * blend
            self.rates = (0.0, 0.0, 0.0)
            return
        p, q, r = self.rates
        limit = MAX_TILT_RATE_RADPS
        blend = min(1.0, dt_s / RATE_TIME_CONSTANT_S)
        p += (min(max(ATTITUDE_GAIN_PER_S * (roll_rad - self.roll_rad), -limit), limit) - p) * blend
        q += (min(max(ATTITUDE_GAIN_PER_S * (pitch_rad - self.pitch_rad), -limit), limit) - q) * blend
        yaw_rate = min(max(yaw_rate_radps, -MAX_YAW_RATE_RADPS), MAX_YAW_RATE_RADPS)
        r += (yaw_rate - r) * min(1.0, dt_s / YAW_RATE_TIME_CONSTANT_S)
        self.rates = (p, q, r)
        self.roll_rad += p * dt_s
        self.pitch_rad += q * dt_s
        self.yaw_rad = math.remainder(self.yaw_rad + r * dt_s, math.tau)

    def _move(self, dt_s: float) -> None:
        x, y, z = self.position
        vx, vy, vz = self.velocity
        thrust = self.thrust_mps2
        if self.on_ground and thrust <= GRAVITY_MPS2:
            self.velocity = self.acceleration = (0.0, 0.0, 0.0)
            return
        wx, wy, wz = self._air(dt_s)
        cr, sr = math.cos(self.roll_rad), math.sin(self.roll_rad)
        cp, sp = math.cos(self.pitch_rad), math.sin(self.pitch_rad)
        cy, sy = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        drag = LINEAR_DRAG_PER_S
        ax = -thrust * (cy * sp * cr + sy * sr) + drag * (wx - vx)
        ay = -thrust * (sy * sp * cr - cy * sr) + drag * (wy - vy)
        az = GRAVITY_MPS2 - thrust * cp * cr + drag * (wz - vz)
        vx += ax * dt_s
        vy += ay * dt_s
        vz += az * dt_s
        x += vx * dt_s
        y += vy * dt_s
        z += vz * dt_s
        self.on_ground = z >= 0.0 and vz >= 0.0
        if self.on_ground:
            z = vx = vy = vz = 0.0
        self.position = (x, y, z)
        self.velocity = (vx, vy, vz)
        self.acceleration = (ax, ay, az)

    def _air(self, dt_s: float) -> Vector:
        """The air's velocity: the steady wind plus gusts (a first-order Gauss-Markov process)."""
        gx, gy, gz = self._gust
        if self.gusts_mps > 0.0:
            decay = dt_s / GUST_TIME_CONSTANT_S
            spread = self.gusts_mps * math.sqrt(2.0 * decay)
            gauss = self._random.gauss
            gx += -gx * decay + gauss(0.0, spread)
            gy += -gy * decay + gauss(0.0, spread)
            gz += -gz * decay + gauss(0.0, spread)
            self._gust = (gx, gy, gz)
        wx, wy, wz = self.wind
        return (wx + gx, wy + gy, wz + gz)
