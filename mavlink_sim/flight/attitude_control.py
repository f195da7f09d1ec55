"""Control by body rates, of ACRO, and PX4's ATTITUDE_TARGET with the rates of its attitude controller.

The control law is that of Brescianini, Hehn, D'Andrea, "Nonlinear Quadrocopter Attitude Control" (2013): the
thrust direction is corrected first, the heading with a smaller weight (MC_YAW_WEIGHT). Thrust 0..1 is the
share of the airframe's greatest thrust, as PX4 passes it to its mixer: MPC_THR_HOVER has no effect, and this
airframe hovers at 9.81 / 20 = 0.49.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from mavlink_sim.flight.position_control import Demand, PositionController
from mavlink_sim.physics.airframe import MAX_THRUST_MPS2, Multirotor
from mavlink_sim.physics.rotations import Vector
from mavlink_sim.px4.parameters import Parameters
from vision.attitude import (
    Quaternion,
    body_down_axis,
    quaternion_from_euler,
    quaternion_inverse,
    quaternion_product,
    unit_or_none,
)

NAN = math.nan
MAX_RATE_RADPS = math.radians(2000.0)  # the range of the gyroscopes; a setpoint may have any number


@dataclass(frozen=True, slots=True)
class RatesSetpoint:
    """Demanded body rates, FRD, rad/s; a rate that is not finite keeps the current one.

    `thrust`: collective, 0..1.
    """

    rates: Vector
    thrust: float


@dataclass(frozen=True, slots=True)
class AttitudeTarget:
    """ATTITUDE_TARGET: attitude (w, x, y, z), body rates in rad/s, collective thrust 0..1."""

    quaternion: Quaternion
    rates: Vector
    thrust: float


class AttitudeController:
    """The loop of body rates, and what ATTITUDE_TARGET has."""

    def __init__(self, parameters: Parameters) -> None:
        self._parameters = parameters
        self._revision = -1
        self._target: AttitudeTarget | None = None
        self._load()

    def _load(self) -> None:
        value = self._parameters.number
        self._revision = self._parameters.revision
        self._yaw_weight = min(max(value("MC_YAW_WEIGHT"), 0.0), 1.0)
        yaw_gain = value("MC_YAW_P")
        if self._yaw_weight > 1e-4:
            yaw_gain /= self._yaw_weight  # the weight must not slow down a pure yaw
        self._gains = (value("MC_ROLL_P"), value("MC_PITCH_P"), yaw_gain)

        def limit(name: str) -> float:
            return min(math.radians(self._parameters.positive(name)), MAX_RATE_RADPS)

        self._limits = (limit("MC_ROLLRATE_MAX"), limit("MC_PITCHRATE_MAX"), limit("MC_YAWRATE_MAX"))

    def release(self) -> None:
        """Another controller is active."""
        self._target = None

    @property
    def active(self) -> bool:
        """Rates are controlled, so there is no position target."""
        return self._target is not None

    def target(self, airframe: Multirotor, outer: PositionController, demand: Demand) -> AttitudeTarget:
        """For ATTITUDE_TARGET; `demand` is the output of the position controller `outer`, if that is active.

        While rates are controlled, attitude and thrust stay the last demanded ones, as in PX4.
        """
        if self._target is not None:
            return self._target
        quaternion = quaternion_from_euler(demand.roll_rad, demand.pitch_rad, outer.yaw_rad)
        thrust = demand.thrust_mps2 / MAX_THRUST_MPS2
        return AttitudeTarget(quaternion, self.rates(quaternion, outer.yaw_rate_radps, airframe), thrust)

    def fly(
        self,
        dt_s: float,
        setpoint: RatesSetpoint,
        airframe: Multirotor,
        outer: PositionController,
        demand: Demand,
    ) -> Demand:
        """One step of control and of the airframe. Returns the new demand; `demand` is the previous one."""
        before = self.target(airframe, outer, demand)
        rates = _possible(setpoint.rates, airframe.rates)
        self._target = AttitudeTarget(before.quaternion, setpoint.rates, before.thrust)
        outer.reset(airframe.yaw_rad)  # so that it restarts with the current heading
        thrust_mps2 = min(max(setpoint.thrust, 0.0), 1.0) * MAX_THRUST_MPS2
        airframe.step_rates(dt_s, thrust_mps2, rates)
        return Demand(thrust_mps2, airframe.roll_rad, airframe.pitch_rad, airframe.rates[2])

    def rates(self, ned_from_body: Quaternion, yaw_rate_radps: float, airframe: Multirotor) -> Vector:
        """The body rates (FRD, rad/s) that turn the airframe into an attitude; NaN if that is no rotation.

        `yaw_rate_radps`: feed-forward about the world's down axis.
        """
        if self._revision != self._parameters.revision:
            self._load()
        wanted = unit_or_none(ned_from_body)
        if wanted is None:
            return (NAN, NAN, NAN)
        attitude = quaternion_from_euler(airframe.roll_rad, airframe.pitch_rad, airframe.yaw_rad)
        back = quaternion_inverse(attitude)
        w, x, y, z = quaternion_product(back, _weighted(attitude, wanted, self._yaw_weight))
        sign = 2.0 if w >= 0.0 else -2.0
        feed_forward = yaw_rate_radps if math.isfinite(yaw_rate_radps) else 0.0
        down_x, down_y, down_z = body_down_axis(back)
        gain_p, gain_q, gain_r = self._gains
        limit_p, limit_q, limit_r = self._limits
        return (
            min(max(gain_p * sign * x + feed_forward * down_x, -limit_p), limit_p),
            min(max(gain_q * sign * y + feed_forward * down_y, -limit_q), limit_q),
            min(max(gain_r * sign * z + feed_forward * down_z, -limit_r), limit_r),
        )


def _possible(rates: Vector, now: Vector) -> Vector:
    p, q, r = (
        min(max(rate, -MAX_RATE_RADPS), MAX_RATE_RADPS) if math.isfinite(rate) else present
        for rate, present in zip(rates, now, strict=True)
    )
    return (p, q, r)


def _weighted(attitude: Quaternion, wanted: Quaternion, yaw_weight: float) -> Quaternion:
    """The demanded attitude with only a share of its rotation about the thrust axis."""
    reduced = _shortest(body_down_axis(attitude), body_down_axis(wanted))
    if reduced is None:
        return wanted  # upside down: every direction is as short
    reduced = quaternion_product(reduced, attitude)
    about_thrust = quaternion_product(quaternion_inverse(reduced), wanted)
    angle = 2.0 * math.atan2(about_thrust[3], about_thrust[0])
    half = 0.5 * yaw_weight * math.remainder(angle, math.tau)
    return quaternion_product(reduced, (math.cos(half), 0.0, 0.0, math.sin(half)))


def _shortest(first: Vector, second: Vector) -> Quaternion | None:
    """The shortest rotation that takes one unit vector to another; None if they are opposite."""
    ax, ay, az = first
    bx, by, bz = second
    cosine = ax * bx + ay * by + az * bz
    if cosine < -1.0 + 1e-9:
        return None
    return unit_or_none((1.0 + cosine, ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx))
