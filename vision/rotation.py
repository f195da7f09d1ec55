"""Rotation matrices between the frames: camera (optical), body (FRD), world (NED).

A rotation matrix `a_from_b` maps a vector's coordinates in b to its coordinates in a. Angles and quaternions
are as in `vision.attitude`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from vision.attitude import Quaternion, unit_quaternion

# Optical axes (x right, y down, z forward) of a camera looking along the body's forward axis, in FRD.
BODY_FROM_OPTICAL: NDArray[np.float64] = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def matrix_from_euler(roll_rad: float, pitch_rad: float, yaw_rad: float) -> NDArray[np.float64]:
    """(3, 3) `parent_from_child` of a child frame rotated by yaw, then pitch, then roll."""
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


def matrix_from_quaternion(quaternion: Quaternion) -> NDArray[np.float64]:
    """(3, 3) rotation of a (w, x, y, z) quaternion, normalised first.

    Raises ValueError if it is zero or not finite.
    """
    w, x, y, z = unit_quaternion(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_from_matrix(rotation: NDArray[np.float64]) -> Quaternion:
    """The (w, x, y, z) quaternion of a (3, 3) rotation matrix, w not negative (Shepperd 1978)."""
    (a, b, c), (d, e, f), (g, h, i) = rotation.tolist()
    # Four times the square of each element: the largest one is the divisor.
    squares = (1 + a + e + i, 1 + a - e - i, 1 - a + e - i, 1 - a - e + i)
    rows = (
        (squares[0], h - f, c - g, d - b),
        (h - f, squares[1], b + d, c + g),
        (c - g, b + d, squares[2], f + h),
        (d - b, c + g, f + h, squares[3]),
    )
    row = rows[squares.index(max(squares))]
    w, x, y, z = unit_quaternion(row)
    return (w, x, y, z) if w >= 0.0 else (-w, -x, -y, -z)
