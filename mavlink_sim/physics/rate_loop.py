"""From a demanded tilt to four rotors: PX4's attitude and rate controllers, and its mixer with saturation.

The gains are PX4's defaults. Its integral parts are replaced by their steady value on this balanced airframe:
the thrust that keeps a rotation against the drag.
The attitude loop compares thrust axes (the "reduced attitude" of Brescianini, Hehn, D'Andrea, 2013, which PX4
uses), so it knows no gimbal lock; the heading is held by the yaw rate that the caller derives.
"""

from __future__ import annotations

import math

Vector = tuple[float, float, float]
Matrix = tuple[float, float, float, float, float, float, float, float, float]
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


def demanded_rates(
    matrix: Matrix, tilt_x: float, tilt_y: float, tilt_z: float, yaw_rate_radps: float
) -> Vector:
    """Body rates (FRD, rad/s) that turn the thrust axis to the demanded direction.

    Args:
        matrix: the attitude, `ned_from_body`, row by row.
        tilt_x, tilt_y, tilt_z: the demanded body down axis in the heading frame (x along the vehicle's
            heading, z down), a unit vector.
        yaw_rate_radps: demanded yaw rate about the vertical.
    """
    a, b, c, d, e, f, g, h, i = matrix
    heading = math.sqrt(a * a + d * d)
    if heading > 1e-6:
        cosine, sine = a / heading, d / heading
    else:  # the nose points straight up or down: the heading is that of the right axis
        wing = math.sqrt(b * b + e * e)
        cosine, sine = e / wing, -b / wing
    north = cosine * tilt_x - sine * tilt_y
    east = sine * tilt_x + cosine * tilt_y
    # the demanded axis in the body frame
    x = a * north + d * east + g * tilt_z
    y = b * north + e * east + h * tilt_z
    z = c * north + f * east + i * tilt_z
    # 2 sin(angle / 2) about the axis e_z × wanted, as PX4 takes it from the error quaternion
    if z > -0.98:
        gain = ATTITUDE_GAIN_PER_S * math.sqrt(2.0 / (1.0 + z))
        p = -gain * y
        q = gain * x
    else:  # upside down: every direction is as short; exactly upside down one must be selected
        p = MAX_TILT_RATE_RADPS if y <= 0.0 else -MAX_TILT_RATE_RADPS
        q = 10.0 * ATTITUDE_GAIN_PER_S * x
    limit = MAX_TILT_RATE_RADPS
    p = (limit if p > limit else -limit if p < -limit else p) + yaw_rate_radps * g
    q = (limit if q > limit else -limit if q < -limit else q) + yaw_rate_radps * h
    return (p, q, yaw_rate_radps * i)


def mixed_thrusts(collective: float, wanted: Vector, rates: Vector, spin: Vector) -> Rotors:
    """The rate controller and the mixer: each rotor's command, 0..1 (order as `Multirotor`).

    At saturation, collective thrust is lowered first, then tilt is scaled down, and yaw gets the rest (PX4's
    sequential desaturation without air mode).

    Args:
        collective: demanded thrust, 0..1.
        wanted, rates: body rates, demanded and actual, rad/s; spin: angular acceleration, rad/s².
    """
    roll = RATE_P * (wanted[0] - rates[0]) - RATE_D * spin[0] + RATE_DRAG * wanted[0]
    pitch = RATE_P * (wanted[1] - rates[1]) - RATE_D * spin[1] + RATE_DRAG * wanted[1]
    yaw = YAW_RATE_P * (wanted[2] - rates[2]) + YAW_RATE_DRAG * wanted[2]
    base = 0.0 if collective < 0.0 else 1.0 if collective > 1.0 else collective
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
