"""Attitudes as Euler angles and quaternions, in plain floats without numpy.

Euler angles are the aerospace sequence yaw, pitch, roll (intrinsic z-y-x). Quaternions are (w, x, y, z).
The matrices of the same rotations are in `vision.rotation`.
"""

from __future__ import annotations

import math

Quaternion = tuple[float, float, float, float]

IDENTITY: Quaternion = (1.0, 0.0, 0.0, 0.0)


def quaternion_from_euler(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Quaternion:
    """The (w, x, y, z) quaternion of the same rotation as `matrix_from_euler`."""
    cr, sr = math.cos(roll_rad / 2), math.sin(roll_rad / 2)
    cp, sp = math.cos(pitch_rad / 2), math.sin(pitch_rad / 2)
    cy, sy = math.cos(yaw_rad / 2), math.sin(yaw_rad / 2)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def euler_from_quaternion(quaternion: Quaternion) -> tuple[float, float, float]:
    """(roll, pitch, yaw) in radians of a (w, x, y, z) quaternion; roll, yaw in -π..π, pitch in -π/2..π/2.

    Raises ValueError if it is zero or not finite.
    """
    w, x, y, z = unit_quaternion(quaternion)
    return (
        math.atan2(2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        math.asin(max(-1.0, min(1.0, -2 * (x * z - w * y)))),
        math.atan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z)),
    )


def quaternion_product(first: Quaternion, second: Quaternion) -> Quaternion:
    """`first` after `second`: (a_from_b, b_from_c) gives a_from_c."""
    aw, ax, ay, az = first
    bw, bx, by, bz = second
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def quaternion_inverse(quaternion: Quaternion) -> Quaternion:
    """Of a unit quaternion."""
    w, x, y, z = quaternion
    return (w, -x, -y, -z)


def body_down_axis(quaternion: Quaternion) -> tuple[float, float, float]:
    """The body's down axis in the parent frame, of a unit quaternion."""
    w, x, y, z = quaternion
    return (2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y))


def turned_about_down(yaw_rad: float, quaternion: Quaternion) -> Quaternion:
    """The (w, x, y, z) attitude, rotated by a yaw about the parent frame's down axis."""
    c, s = math.cos(yaw_rad / 2), math.sin(yaw_rad / 2)
    w, x, y, z = quaternion
    return (c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w)


def slerp(first: Quaternion, second: Quaternion, fraction: float) -> Quaternion:
    """Interpolate between two attitudes on the shorter arc (Shoemake 1985); above 1 it extrapolates.

    Raises ValueError if one is zero or not finite.
    """
    a, b = unit_quaternion(first), unit_quaternion(second)
    cosine = sum(p * q for p, q in zip(a, b, strict=True))
    sign = 1.0 if cosine >= 0.0 else -1.0  # q and -q are the same attitude
    if abs(cosine) > 0.9995:
        of_first, of_second = 1.0 - fraction, fraction
    else:
        angle = math.acos(abs(cosine))
        of_first, of_second = math.sin((1.0 - fraction) * angle), math.sin(fraction * angle)
    w, x, y, z = (of_first * p + sign * of_second * q for p, q in zip(a, b, strict=True))
    return unit_quaternion((w, x, y, z))


def wrap_angle(angle_rad: float) -> float:
    """The same angle in -π..π (π itself stays π)."""
    wrapped = math.remainder(angle_rad, math.tau)
    return math.pi if wrapped == -math.pi else wrapped


def unit_quaternion(quaternion: Quaternion) -> Quaternion:
    """The same rotation with length 1. Raises ValueError if it is none (zero or not finite)."""
    if (unit := unit_or_none(quaternion)) is None:
        raise ValueError(f"not a rotation: quaternion {quaternion}")
    return unit


def unit_or_none(quaternion: Quaternion) -> Quaternion | None:
    """The same rotation with length 1; None if it is none (zero or not finite)."""
    w, x, y, z = quaternion
    norm = math.hypot(w, x, y, z)
    if not math.isfinite(norm) or norm < 1e-12:
        return None
    return (w / norm, x / norm, y / norm, z / norm)
