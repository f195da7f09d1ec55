"""The airframe and its velocity control as numpy arrays: many vehicles side by side.

The rigid body, the rotors, the mixer, the attitude loop and the velocity loop are those of
`physics.airframe` and `flight.position_control`, with their constants, in steps of 12.5 ms instead of 4 and
12 ms. Left out: the ground, an estimate's errors, the hold of a heading between turns, and the state machine
around them. `docs/measurements.md` has the error against the whole autopilot.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mavlink_sim.environments.spaces import Array
from mavlink_sim.environments.task import STEP_S
from mavlink_sim.flight.position_control import ANTI_WINDUP, LEAST_LIFT_MPS2, MOST_LIFT_MPS2
from mavlink_sim.physics.airframe import (
    ANGULAR_DRAG_NMS,
    ARM_M,
    GRAVITY_MPS2,
    GUST_TIME_CONSTANT_S,
    LINEAR_DRAG_PER_S,
    MAX_THRUST_MPS2,
    ROTOR_THRUST_MPS2,
    ROTOR_TIME_CONSTANT_S,
    ROTOR_TORQUE_NM,
)
from mavlink_sim.physics.contact import INERTIA_XY_KGM2, INERTIA_Z_KGM2
from mavlink_sim.physics.rotor_control import (
    ATTITUDE_GAIN_PER_S,
    MAX_TILT_RATE_RADPS,
    RATE_D,
    RATE_DRAG,
    RATE_P,
    YAW_MARGIN,
    YAW_RATE_DRAG,
    YAW_RATE_P,
)
from mavlink_sim.px4.parameters import Parameters

SUBSTEPS = 4
_DT_S = STEP_S / SUBSTEPS
_BLEND = 1.0 - math.exp(-_DT_S / ROTOR_TIME_CONSTANT_S)
_TORQUE_M = ROTOR_TORQUE_NM / ROTOR_THRUST_MPS2
_COUPLING_KGM2 = INERTIA_XY_KGM2 - INERTIA_Z_KGM2
_GUST_KEEP = math.exp(-STEP_S / GUST_TIME_CONSTANT_S)
_TINY = 1e-9
_INERTIA = np.array([[INERTIA_XY_KGM2], [INERTIA_XY_KGM2], [INERTIA_Z_KGM2]])


class FastModel:
    """`count` airframes; all arrays have the vehicle as their last axis.

    Attributes:
        position, velocity: (3, count) NED, metres and m/s. acceleration: the same, kinematic.
        rotation: (3, 3, count) `ned_from_body`.
        rates: (3, count) body FRD, rad/s.
        wind: (3, count) NED m/s. gusts_m_s: (count,) their standard deviation on each axis.
        mass: (count,) relative to SIH's 1 kg: thrust and torque are divided by it.
        failed: (count,) the autopilot has left its mode, or the vehicle has crashed: never here.
    """

    def __init__(self, count: int) -> None:
        value = Parameters().number
        axes = ("XY", "XY", "Z")
        self._p, self._i, self._d = (
            np.array([[value(f"MPC_{axis}_VEL_{term}_ACC")] for axis in axes]) for term in "PID"
        )
        self._windup = ANTI_WINDUP / self._p
        self._max_sideways = GRAVITY_MPS2 * math.tan(math.radians(value("MPC_TILTMAX_AIR")))
        self.position, self.velocity, self.acceleration = (np.zeros((3, count)) for _ in range(3))
        self.rates, self.wind, self._spin, self._gust = (np.zeros((3, count)) for _ in range(4))
        self._integral = np.zeros((3, count))
        self._quaternion = np.zeros((4, count))
        self.rotation = np.zeros((3, 3, count))
        self.thrusts = np.zeros((4, count))
        self.gusts_m_s, self.mass = np.zeros(count), np.ones(count)
        self.failed = np.zeros(count, bool)

    def begin(
        self, which: NDArray[np.intp], position: Array, yaw_rad: Array, rng: np.random.Generator
    ) -> None:
        """Place vehicles at rest and level, hovering. `rng` is not used.

        Args:
            which: their indices. position: (3, len(which)) NED. yaw_rad: (len(which),).
        """
        self.position[:, which] = position
        for array in (self.velocity, self.acceleration, self.rates, self._spin, self._gust, self._integral):
            array[:, which] = 0.0
        self.thrusts[:, which] = GRAVITY_MPS2 / 4.0
        half = yaw_rad / 2.0
        zero = np.zeros_like(half)
        self._quaternion[:, which] = np.stack([np.cos(half), zero, zero, np.sin(half)])
        self.rotation = rotation_matrices(self._quaternion)

    @property
    def estimated_position(self) -> Array:
        """(3, count) the vehicle's own estimate: here the truth."""
        return self.position

    @property
    def estimated_velocity(self) -> Array:
        """(3, count) the same of the velocity."""
        return self.velocity

    @property
    def yaw_rad(self) -> Array:
        """(count,) clockwise from north."""
        yaw: Array = np.arctan2(self.rotation[1, 0], self.rotation[0, 0])
        return yaw

    def fly(self, velocity: Array, turn_rad_s: Array, rng: np.random.Generator) -> None:
        """Fly a velocity over ground, (3, count) NED m/s, and a yaw rate, (count,), for STEP_S."""
        air = self._blow(rng)
        for _ in range(SUBSTEPS):
            self._advance(self._mix(velocity, turn_rad_s), air)

    def fly_rotors(self, commands: Array, rng: np.random.Generator) -> None:
        """Run the rotors at these shares of their thrust, (4, count) 0..1, for STEP_S."""
        air = self._blow(rng)
        for _ in range(SUBSTEPS):
            self._advance(commands, air)

    def _blow(self, rng: np.random.Generator) -> Array:
        """(3, count) the wind of this step."""
        spread = self.gusts_m_s * math.sqrt(1.0 - _GUST_KEEP**2)
        self._gust = _GUST_KEEP * self._gust + spread * rng.standard_normal(self._gust.shape)
        return self.wind + self._gust

    def _mix(self, velocity: Array, turn_rad_s: Array) -> Array:
        """(4, count) rotor commands 0..1: velocity loop, attitude loop, rate loop and mixer."""
        error = velocity - self.velocity
        demand = self._p * error + self._integral - self._d * self.acceleration
        lift = np.clip(GRAVITY_MPS2 - demand[2], LEAST_LIFT_MPS2, MOST_LIFT_MPS2)
        sideways = np.hypot(demand[0], demand[1])
        level = demand[:2] * np.minimum(1.0, self._max_sideways / np.maximum(sideways, _TINY))
        length = np.sqrt(GRAVITY_MPS2**2 + level[0] ** 2 + level[1] ** 2)
        thrust = np.minimum(lift * length / GRAVITY_MPS2, MAX_THRUST_MPS2)
        achieved = np.concatenate([level, (GRAVITY_MPS2 - thrust * GRAVITY_MPS2 / length)[None]])
        self._integral += self._i * (error - (demand - achieved) * self._windup) * _DT_S
        np.clip(self._integral, -GRAVITY_MPS2, GRAVITY_MPS2, out=self._integral)

        # The demanded down axis of the body is (-north, -east, gravity) / length: its parts along the body's.
        axes = self.rotation
        x, y, z = (axes[2] * GRAVITY_MPS2 - axes[0] * level[0] - axes[1] * level[1]) / length
        gain = ATTITUDE_GAIN_PER_S * np.sqrt(2.0 / np.maximum(1.0 + z, 0.02))
        wanted = axes[2] * turn_rad_s
        tilt = np.clip(np.stack([-gain * y, gain * x]), -MAX_TILT_RATE_RADPS, MAX_TILT_RATE_RADPS)
        wanted[:2] += tilt

        off = wanted - self.rates
        tilts = RATE_P * off[:2] - RATE_D * self._spin[:2] + RATE_DRAG * wanted[:2]
        yaw = YAW_RATE_P * off[2] + YAW_RATE_DRAG * wanted[2]
        base = np.clip(thrust / MAX_THRUST_MPS2, 0.0, 1.0)
        asked = np.abs(tilts[0]) + np.abs(tilts[1])
        spread = np.minimum(asked, 0.5)
        base = np.minimum(base, 1.0 - spread)
        spread = np.minimum(spread, base)
        tilts *= spread / np.maximum(asked, _TINY)
        reserve = np.minimum(np.abs(yaw), YAW_MARGIN)
        base = np.maximum(np.minimum(base, 1.0 - spread - reserve), spread)
        margin = np.maximum(np.minimum(base, 1.0 - base) - spread, 0.0)
        yaw = np.clip(yaw, -margin, margin)
        roll, pitch = tilts
        return np.stack(
            [
                base - roll + pitch + yaw,
                base + roll - pitch + yaw,
                base + roll + pitch - yaw,
                base - roll - pitch - yaw,
            ]
        )

    def _advance(self, commands: Array, air: Array) -> None:
        self.thrusts += (commands * (ROTOR_THRUST_MPS2 / self.mass) - self.thrusts) * _BLEND
        front_right, rear_left, front_left, rear_right = self.thrusts
        one, other = front_right - rear_left, front_left - rear_right
        spin = front_right + rear_left - front_left - rear_right
        torques = np.stack([-ARM_M * (one - other), ARM_M * (one + other), _TORQUE_M * spin])
        torques -= ANGULAR_DRAG_NMS * self.rates
        p, q, r = self.rates
        torques[0] += _COUPLING_KGM2 * q * r
        torques[1] -= _COUPLING_KGM2 * p * r
        self._spin = torques / _INERTIA
        self.rates = self.rates + self._spin * _DT_S
        self.acceleration = LINEAR_DRAG_PER_S * (air - self.velocity) - self.rotation[
            :, 2
        ] * self.thrusts.sum(0)
        self.acceleration[2] += GRAVITY_MPS2
        self.velocity = self.velocity + self.acceleration * _DT_S
        self.position = self.position + self.velocity * _DT_S
        p, q, r = self.rates * (0.5 * _DT_S)
        w, x, y, z = self._quaternion
        turned = np.stack(
            [
                w - x * p - y * q - z * r,
                x + w * p + y * r - z * q,
                y + w * q + z * p - x * r,
                z + w * r + x * q - y * p,
            ]
        )
        self._quaternion = turned / np.sqrt((turned * turned).sum(0))
        self.rotation = rotation_matrices(self._quaternion)


def rotation_matrices(quaternion: Array) -> Array:
    """(3, 3, count) of (4, count) unit quaternions (w, x, y, z)."""
    w, x, y, z = quaternion
    dx, dy, dz = 2.0 * quaternion[1:]
    xx, yy, zz = dx * x, dy * y, dz * z
    xy, xz, yz = dx * y, dx * z, dy * z
    wx, wy, wz = dx * w, dy * w, dz * w
    rows = [1.0 - yy - zz, xy - wz, xz + wy, xy + wz, 1.0 - xx - zz, yz - wx, xz - wy, yz + wx, 1.0 - xx - yy]
    return np.stack(rows).reshape(3, 3, -1)
