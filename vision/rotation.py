"""Rotations between the frames: camera (optical), body (FRD), world (NED).

A rotation matrix `a_from_b` turns a vector's coordinates in b into its coordinates in a.
Euler angles are the aerospace sequence yaw, pitch, roll (intrinsic z-y-x). Quaternions are (w, x, y, z).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Quaternion = tuple[float, float, float, float]

# Optical axes (x right, y down, z forward) of a camera looking along the body's forward axis, in FRD.
BODY_FROM_OPTICAL: NDArray[np.float64] = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def matrix_from_euler(roll_rad: float, pitch_rad: float, yaw_rad: float) -> NDArray[np.float64]:
    """(3, 3) `parent_from_child` of a child frame turned by yaw, then pitch, then roll."""
    cr, sr = math.cos(roll_rad), math.sin(roll_rad)
    cp, sp = math.cos(pitch_rad), math.sin(pitch_rad)
    cy, sy = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def matrix_from_quaternion(quaternion: tuple[float, float, float, float]) -> NDArray[np.float64]:
    """(3, 3) rotation of a (w, x, y, z) quaternion, normalised first. Raises ValueError if it is zero."""
    norm = math.sqrt(sum(value * value for value in quaternion))
    if norm == 0.0:
        raise ValueError("a zero quaternion is no rotation")
    w, x, y, z = (value / norm for value in quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_from_euler(
    roll_rad: float, pitch_rad: float, yaw_rad: float
) -> tuple[float, float, float, float]:
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


def euler_from_quaternion(quaternion: tuple[float, float, float, float]) -> tuple[float, float, float]:
    """(roll, pitch, yaw) in radians of a (w, x, y, z) quaternion; roll, yaw in -π..π, pitch in -π/2..π/2."""
    m = matrix_from_quaternion(quaternion)
    return (
        math.atan2(m[2, 1], m[2, 2]),
        math.asin(max(-1.0, min(1.0, -m[2, 0]))),
        math.atan2(m[1, 0], m[0, 0]),
    )


def turned_about_down(yaw_rad: float, quaternion: Quaternion) -> Quaternion:
    """The (w, x, y, z) attitude, turned by a yaw about the parent frame's own down axis."""
    c, s = math.cos(yaw_rad / 2), math.sin(yaw_rad / 2)
    w, x, y, z = quaternion
    return (c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w)


def slerp(first: Quaternion, second: Quaternion, fraction: float) -> Quaternion:
    """Between two attitudes along the shorter way (Shoemake 1985); a fraction above 1 goes on turning.

    Quaternions are (w, x, y, z).
    """
    a, b = (np.array(q) / math.sqrt(sum(v * v for v in q)) for q in (first, second))
    cosine = float(a @ b)
    if cosine < 0.0:
        b, cosine = -b, -cosine
    if cosine > 0.9995:
        mixed = a + (b - a) * fraction
    else:
        angle = math.acos(cosine)
        mixed = a * math.sin((1.0 - fraction) * angle) + b * math.sin(fraction * angle)
    w, x, y, z = (float(value) for value in mixed / np.linalg.norm(mixed))
    return (w, x, y, z)


def wrap_angle(angle_rad: float) -> float:
    """The same angle in -π..π (π itself stays π)."""
    wrapped = math.remainder(angle_rad, math.tau)
    return math.pi if wrapped == -math.pi else wrapped
