"""Quaternions (w, x, y, z) of attitudes in plain floats, fast enough for every control step."""

from __future__ import annotations

import math

from vision.attitude import Quaternion

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
    w, x, y, z = quaternion
    norm = math.hypot(w, x, y, z)
    if not math.isfinite(norm) or norm < 1e-12:
        return None
    return (w / norm, x / norm, y / norm, z / norm)


def third_axis(quaternion: Quaternion) -> Vector:
    """The body's down axis in the world, of a unit quaternion."""
    w, x, y, z = quaternion
    return (2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y))
