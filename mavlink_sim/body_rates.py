"""Turning by body rates: quaternions (w, x, y, z) in plain floats, and one step of rotation.

Plain floats because this runs at 250 Hz a vehicle; `vision.rotation` has the same algebra on arrays.
"""

from __future__ import annotations

import math

from vision.rotation import Quaternion, quaternion_from_euler

Vector = tuple[float, float, float]

IDENTITY: Quaternion = (1.0, 0.0, 0.0, 0.0)


def product(first: Quaternion, second: Quaternion) -> Quaternion:
    """`first` after `second`: (a_from_b, b_from_c) gives a_from_c."""
    aw, ax, ay, az = first
    bw, bx, by, bz = second
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def inverse(quaternion: Quaternion) -> Quaternion:
    """Of a unit quaternion."""
    w, x, y, z = quaternion
    return (w, -x, -y, -z)


def unit(quaternion: Quaternion) -> Quaternion | None:
    """The quaternion at length one; None if it is no rotation (zero or not finite)."""
    norm = math.hypot(*quaternion)
    if not math.isfinite(norm) or norm < 1e-12:
        return None
    w, x, y, z = (value / norm for value in quaternion)
    return (w, x, y, z)


def third_axis(quaternion: Quaternion) -> Vector:
    """The body's down axis in the world, of a unit quaternion."""
    w, x, y, z = quaternion
    return (2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y))


def euler(quaternion: Quaternion) -> Vector:
    """(roll, pitch, yaw) in radians of a unit quaternion, aerospace sequence."""
    w, x, y, z = quaternion
    return (
        math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
        math.asin(min(max(2.0 * (w * y - z * x), -1.0), 1.0)),
        math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)),
    )


def turned(attitude: Vector, rates: Vector, dt_s: float) -> Vector:
    """(roll, pitch, yaw) after turning for `dt_s` at these body rates (FRD, rad/s), at any attitude."""
    p, q, r = rates
    speed = math.sqrt(p * p + q * q + r * r)
    half = 0.5 * speed * dt_s
    share = math.sin(half) / speed if speed > 1e-9 else 0.5 * dt_s
    step = (math.cos(half), p * share, q * share, r * share)
    return euler(unit(product(quaternion_from_euler(*attitude), step)) or IDENTITY)
