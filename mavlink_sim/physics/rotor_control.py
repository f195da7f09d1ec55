"""From a demanded tilt, or demanded body rates, to rotor commands: PX4's inner loops.

PX4's attitude and rate controllers, with its default gains, and its mixer with saturation. The integral parts
are replaced by their steady value on this balanced airframe. The attitude loop compares thrust axes (the
"reduced attitude" of Brescianini, Hehn, D'Andrea, 2013), so it knows no gimbal lock.

Body frame FRD, world frame NED. Body rates (p, q, r) are in rad/s about the forward, right and down axes.
"""

from __future__ import annotations

import math

from mavlink_sim.physics.rotations import Matrix, Vector

Rotors = tuple[float, float, float, float]

ATTITUDE_GAIN_PER_S = 4.0  # MC_ROLL_P, MC_PITCH_P
MAX_TILT_RATE_RADPS = math.radians(220.0)  # MC_ROLLRATE_MAX, MC_PITCHRATE_MAX
MAX_YAW_RATE_RADPS = math.radians(200.0)  # MC_YAWRATE_MAX
# Share of full thrust per rad/s: MC_ROLLRATE_P 0.15 through PX4's allocation of a roll to rotors (1/sqrt 2).
RATE_P = 0.15 * math.sqrt(0.5)
RATE_D = 0.003 * math.sqrt(0.5)
# MC_YAWRATE_P 0.2 alone turns SIH's weak rotor torque into 0.4 s of lag, which PX4's integral part shortens;
# this gain gives a lag of 0.15 s without one.
YAW_RATE_P = 0.5
# Share of full thrust per rad/s that angular drag (SIH_KDW) takes, of rotors on their arms and by torque.
RATE_DRAG = 0.025 / (4 * 5.0 * 0.2)
YAW_RATE_DRAG = 0.025 / (4 * 0.1)
# Yaw is served last, but PX4 keeps this share of the range for it by lowering the thrust.
YAW_MARGIN = 0.15

_VERTICAL_NOSE = 1e-6  # horizontal part of the forward axis below which it has no heading
_UPSIDE_DOWN_COSINE = -0.98
_UPSIDE_DOWN_GAIN_PER_S = 10.0 * ATTITUDE_GAIN_PER_S


def attitude_loop(ned_from_body: Matrix, down_axis: Vector, yaw_rate_radps: float) -> Vector:
    """The body rates that turn the thrust axis into the demanded direction.

    Args:
        ned_from_body: the attitude.
        down_axis: the demanded direction of the body's down axis: ahead, to the right and down, in the frame
            that is level and has the vehicle's heading. Of length 1.
        yaw_rate_radps: demanded, about the vertical.
    """
    # the body's axes in NED: forward_n is the north part of the forward axis
    forward_n, right_n, down_n, forward_e, right_e, down_e, forward_d, right_d, down_d = ned_from_body
    ahead, aside, wanted_d = down_axis
    level = math.sqrt(forward_n * forward_n + forward_e * forward_e)
    if level > _VERTICAL_NOSE:
        cosine, sine = forward_n / level, forward_e / level
    else:  # the nose points straight up or down: the heading is that of the right axis
        level = math.sqrt(right_n * right_n + right_e * right_e)
        cosine, sine = right_e / level, -right_n / level
    wanted_n = cosine * ahead - sine * aside
    wanted_e = sine * ahead + cosine * aside
    # the demanded down axis in the body frame
    to_forward = forward_n * wanted_n + forward_e * wanted_e + forward_d * wanted_d
    to_right = right_n * wanted_n + right_e * wanted_e + right_d * wanted_d
    along = down_n * wanted_n + down_e * wanted_e + down_d * wanted_d

    limit = MAX_TILT_RATE_RADPS
    # 2 sin(angle / 2) about the axis "down × wanted", as PX4 takes it from the error quaternion
    if along > _UPSIDE_DOWN_COSINE:
        gain = ATTITUDE_GAIN_PER_S * math.sqrt(2.0 / (1.0 + along))
        p = -gain * to_right
        q = gain * to_forward
    else:  # every direction is as short; exactly upside down one must be selected
        p = limit if to_right <= 0.0 else -limit
        q = _UPSIDE_DOWN_GAIN_PER_S * to_forward
    p = limit if p > limit else -limit if p < -limit else p
    q = limit if q > limit else -limit if q < -limit else q
    return (p + yaw_rate_radps * forward_d, q + yaw_rate_radps * right_d, yaw_rate_radps * down_d)


def rate_loop(demanded: Vector, rates: Vector, angular_acceleration: Vector) -> Vector:
    """The torques that bring the body rates to the demanded ones.

    Args:
        demanded, rates: rad/s. angular_acceleration: rad/s², for the D part.

    Returns:
        Roll, pitch and yaw, as shares of a rotor's full thrust that each rotor adds or takes.
    """
    demanded_p, demanded_q, demanded_r = demanded
    p, q, r = rates
    roll_acceleration, pitch_acceleration, _ = angular_acceleration
    return (
        RATE_P * (demanded_p - p) - RATE_D * roll_acceleration + RATE_DRAG * demanded_p,
        RATE_P * (demanded_q - q) - RATE_D * pitch_acceleration + RATE_DRAG * demanded_q,
        YAW_RATE_P * (demanded_r - r) + YAW_RATE_DRAG * demanded_r,
    )


def mix(collective: float, torques: Vector) -> Rotors:
    """The rotors' commands, each 0..1 of its thrust.

    At saturation, collective thrust is lowered first, then tilt is scaled down, and yaw gets the rest (PX4's
    sequential desaturation without air mode).

    Args:
        collective: share of full thrust. torques: see `rate_loop`.
    """
    roll, pitch, yaw = torques
    base = 0.0 if collective < 0.0 else 1.0 if collective > 1.0 else collective
    # what tilting adds to the strongest rotor and takes from the weakest
    spread = (roll if roll >= 0.0 else -roll) + (pitch if pitch >= 0.0 else -pitch)
    if spread > 0.5:
        scale = 0.5 / spread
        roll *= scale
        pitch *= scale
        spread = 0.5
    if base + spread > 1.0:
        base = 1.0 - spread
    if base < spread:
        scale = base / spread
        roll *= scale
        pitch *= scale
        spread = base
    reserve = (yaw if yaw >= 0.0 else -yaw) if -YAW_MARGIN < yaw < YAW_MARGIN else YAW_MARGIN
    if base + spread + reserve > 1.0:
        base = max(1.0 - spread - reserve, spread)
    margin = (1.0 - base if base > 0.5 else base) - spread
    if margin < 0.0:
        margin = 0.0
    yaw = margin if yaw > margin else -margin if yaw < -margin else yaw
    return (
        base - roll + pitch + yaw,
        base + roll - pitch + yaw,
        base + roll + pitch - yaw,
        base - roll - pitch - yaw,
    )
